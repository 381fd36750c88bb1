"""The robot arm swings its cable, whose energy grows by the work of the hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from examples.loading import load


@pytest.mark.slow
def test_the_energy_grows_by_the_work_of_the_hand():
    example = load("robot_arm")
    arm, _, state, _ = example.build()
    tips, force, growth, work = example.swing()
    np.testing.assert_allclose(growth, work, rtol=1e-3)
    assert 0.05 < float(work) < 0.2 and float(force) > 0.4
    assert arm.joints == ("waist", "shoulder", "elbow")
    start, end = (arm.pose(jnp.asarray(at))[0] for at in (example.START, example.END))
    np.testing.assert_allclose(state.positions[:, 0], start, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(tips[-1] - end), 0.4, rtol=0.1)
