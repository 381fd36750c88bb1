"""Soft rods that swing up, stand, and are caught by feedback when they are pushed."""

import jax
import numpy as np
import pytest

import jaxrod
from examples.loading import load


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize(
    ("name", "rod", "bends"),
    [
        ("soft_pendulum", lambda states: states, 0.3),
        ("soft_cart_pole", lambda states: states["rod"], 0.1),
    ],
)
def test_a_soft_rod_swings_up_and_stands_though_it_is_pushed(name, rod, bends):
    example = load(name)
    found = example.swing_up()
    problem = found.problem
    step = example.INTERVAL / example.STEPS
    assert step <= float(jaxrod.stable_dt(problem.data["scene"]).dt)
    upright = np.array([0, 0, example.LENGTH])
    hung = np.asarray(rod(problem.start).tip)
    np.testing.assert_allclose(hung, -upright, atol=1e-6)

    def missed(states):
        return np.linalg.norm(rod(states).tip[-1] - upright)

    assert missed(found.states) < 0.03
    # It is soft: on its way some element turns away from the straight line by much.
    along = np.diff(np.asarray(rod(found.states).positions), axis=2)
    angles = np.unwrap(np.arctan2(along[:, 0], along[:, 2]), axis=1)
    assert np.max(np.ptp(angles, axis=1)) > bends
    caught, lost = (
        jax.jit(
            lambda p=policy: jaxrod.control.rolled_out(problem, p, example.pushed)
        )()
        for policy in (found.policy, found.open_loop)
    )
    assert missed(caught.states) < 0.05
    assert missed(lost.states) > 0.3
    assert np.all(np.abs(caught.controls) <= example.LIMIT)
