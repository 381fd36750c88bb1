"""`examples/learned_material.py` learns what its model lacks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from examples.loading import load

example = load("learned_material")
WEIGHTS = np.array([[0.5, 1.2, 2.0], [-1.0, 0.0, 1.0], [0.3, 0.2, -0.1]])


@pytest.mark.slow
def test_gradients_through_rest_and_motion_agree_with_differences():
    way = np.random.default_rng(0).normal(size=WEIGHTS.shape)

    def along(share):
        made = example.seen(example.Learned(WEIGHTS + share * way), (0.1,), 200)
        return jnp.stack([made["poses"][0, -1, 2], made["swing"][-1, 2]])

    run = jax.jit(along)
    slopes = jax.jit(jax.jacfwd(along))(0.0)
    differences = (run(1e-4) - run(-1e-4)) / 2e-4
    np.testing.assert_allclose(slopes, differences, rtol=1e-6)


@pytest.mark.slow
def test_poses_and_motions_that_were_not_shown_are_right_with_the_network():
    learned = example.learn()["weights"]
    without, found = example.errors(0 * learned), example.errors(learned)
    assert found["poses"] < 0.05 * without["poses"]
    assert found["swing"] < 0.3 * without["swing"]
