"""Twist, writhe and link of random curves beside PyElastica's knot theory."""

import numpy as np
import pytest
from elastica.rod import knot_theory

import jaxrod

LONGER = 5.0

# Numba compiles theirs where it is first called, and says how it could be faster.
pytestmark = pytest.mark.filterwarnings("ignore:.*faster on contiguous arrays")


@pytest.fixture(scope="module")
def ribbon():
    """Nodes, normals and radii; PyElastica's "net_tangent" is right if the nodes of
    the second half have their mean at the origin."""
    random = np.random.default_rng(1)
    nodes = random.normal(size=(3, 21)).cumsum(axis=1)
    nodes -= nodes[:, 11:].mean(axis=1)[:, None]
    return nodes, random.normal(size=(3, 20)), random.uniform(0.05, 0.1, 20)


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["next_tangent", "net_tangent"])
def test_writhe(ribbon, ends):
    nodes, _, _ = ribbon
    theirs = knot_theory.compute_writhe(nodes[None], LONGER, ends)[0]
    ours = jaxrod.topology.writhe(nodes, ends=ends, extension=LONGER)
    np.testing.assert_allclose(ours, theirs, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["next_tangent", "end_to_end", "net_tangent"])
def test_link(ribbon, ends):
    """Their arcsines lose half of the digits where elements are close."""
    nodes, normals, radii = ribbon
    theirs = knot_theory.compute_link(
        nodes[None], normals[None], radii[None], LONGER, ends
    )[0]
    # Theirs is the radius of the element before a node, the first's for the first.
    ours = jaxrod.topology.link(
        nodes, normals, offset=radii, ends=ends, extension=LONGER
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-7)


@pytest.mark.slow
def test_twist(ribbon):
    nodes, normals, _ = ribbon
    theirs = knot_theory.compute_twist(nodes[None], normals[None])[0][0]
    np.testing.assert_allclose(
        jaxrod.topology.twist(nodes, normals), theirs, atol=1e-11
    )
