"""Smooth axes: the bound of their stiffness, against splines and brute force."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from jaxrod.systems.contact.smooth_axes import smooth_nodes, stiffest


@pytest.mark.fast_sets(3)
@pytest.mark.parametrize("n", [3, 7, 12, 13, 20])
def test_the_stiffest_springs_are_those_of_cubic_splines(n):
    """Sums of stiffness entries of each node, with each spring at its worst place."""
    places, tangents = map(
        np.asarray, smooth_nodes(jnp.eye(n + 1), np.zeros((n + 1, 1), bool))
    )
    most = np.zeros(n + 1)
    for element in range(n):
        axes = CubicHermiteSpline(
            [0.0, 1.0],
            places[:, element : element + 2].T,
            tangents[:, element : element + 2].T,
        )
        share = np.abs(axes(np.linspace(0, 1, 101)))
        most += np.max(share * np.sum(share, axis=1, keepdims=True), axis=0)
    np.testing.assert_allclose(stiffest(n), most, rtol=1e-12)
