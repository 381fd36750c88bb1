"""Smooth axes: their curves and the bound of their stiffness, against splines."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

import jaxrod
from jaxrod.rods.motion import motion_of
from jaxrod.systems.contact.element_pairs import elements_at
from jaxrod.systems.contact.rod_segments import rod_segments
from jaxrod.systems.contact.smooth_axes import smooth_nodes, stiffest
from jaxrod.systems.coupling import Seen
from jaxrod.systems.members.rods import parts_of


def spline_of(nodes):
    """The curve of a field on the nodes of an open rod, by elements from its start."""
    open_rod = np.zeros((1, 1), bool)
    places, tangents = np.stack(
        [np.concatenate(smooth_nodes(row[None], open_rod)) for row in nodes], axis=-1
    )
    return CubicHermiteSpline(np.arange(len(places)), places, tangents)


def test_elements_of_a_bent_rod_are_pieces_of_one_spline():
    """Places, slopes and curvatures, and the velocities of the places."""
    n = 7
    rod, state = jaxrod.straight_rod(
        n, length=1.0, radius=0.01, density=1e3, youngs_modulus=1e6
    )
    rng = np.random.default_rng(0)
    state = dataclasses.replace(
        state,
        positions=state.positions + 0.05 * rng.normal(size=(3, n + 1)),
        velocities=jnp.asarray(rng.normal(size=(3, n + 1))),
    )
    parts = parts_of(rod)
    pieces = elements_at(
        rod_segments(parts, 1), Seen(parts, motion_of(state)), moves=True, smooth=True
    )
    axis, velocity = spline_of(state.positions), spline_of(state.velocities)
    for share in (0.0, 0.3, 0.8, 0.999999):
        at, along = jnp.full(n, share), np.arange(n) + share
        for found, expected in (
            (np.add(pieces.first, pieces.on_axis(at)), axis(along)),
            (pieces.tangent(at), axis(along, 1)),
            (pieces.bend(at), axis(along, 2)),
            (pieces.velocity_at(at), velocity(along)),
        ):
            np.testing.assert_allclose(np.transpose(found), expected, atol=1e-13)


@pytest.mark.fast_sets(1)
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
