"""The published muscles: how fast control values follow, and what couples they make."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.envs.arm.published import MuscleParams, contract, relaxed

N, BOUND = 6, 0.1


def arm():
    return jaxrod.straight_rod(
        N, length=1.0, radius=0.05, density=1e3, youngs_modulus=1e6
    )[0]


def muscles(rod, bound):
    params = MuscleParams(
        spline=jaxrod.actuation.control_spline(4, 1.0),
        torque=jnp.asarray(0.7),
        largest_change=None if bound is None else jnp.asarray(bound),
    )
    return params, relaxed(rod, params)


@pytest.mark.parametrize("bound", [None, BOUND])
def test_control_values_follow_either_way_by_no_more_than_they_may(bound):
    rod = arm()
    params, begun = muscles(rod, bound)
    asked = np.array([[0.05, -0.05, 0.25], [-0.25, 1.0, -1.0], [0.0, 0.3, -0.3]])
    commanded = jnp.asarray(np.column_stack([asked, asked[:, :1]]))
    lengths = jnp.asarray(np.linspace(0.1, 0.2, N))
    now, values = begun, np.zeros((3, 4))
    for k in range(4):
        now = contract(now, commanded, lengths, jnp.asarray(k == 0), params)
        way = np.asarray(commanded) - values
        values = values + (way if bound is None else np.clip(way, -bound, bound))
        np.testing.assert_allclose(now.applied, values, atol=1e-12)
    still = contract(now, now.applied, 2 * lengths, jnp.asarray(False), params)
    # Couples are read off the spline at the far ends, and then held.
    ends = jnp.cumsum(lengths)
    expected = 0.7 * np.asarray(params.spline(jnp.asarray(values), ends))
    if bound is not None:
        np.testing.assert_allclose(now.couples, expected, rtol=1e-12)
        assert np.ptp(expected) > 0.1
    np.testing.assert_array_equal(still.couples, now.couples)
