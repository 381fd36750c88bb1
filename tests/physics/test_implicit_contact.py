"""Implicit steps through contact: what explicit steps find, and beyond their limit."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import AREA, DENSITY, RADIUS, arm

# One program for both, which takes long to compile: a Newton step through contact.
pytestmark = pytest.mark.slow

G = 9.81
LINE = DENSITY * AREA  # mass per length [kg/m]
DEPTH = 0.05 * RADIUS  # at which the arm rests on the floor [m]
GAP = 0.2 * RADIUS  # through which it falls [m]


def dropped(radius=0.5):
    """An arm above a floor, one end higher than the other: scene, state."""
    rod, state = arm(4, youngs_modulus=1e6)
    floor = jaxrod.shapes.plane((0.0, -RADIUS - GAP, 0.0), (0.0, 1.0, 0.0))
    lift = jnp.linspace(0.0, 0.1 * RADIUS, 5)
    positions = state.positions.at[1].add(lift)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, -G, 0.0)),
        jaxrod.contact(
            floor, stiffness=LINE * G / DEPTH, damping=60.0 * LINE, onset=0.1
        ),
        jaxrod.exponential_damping(2.0),
        method=jaxrod.implicit(radius),
    )
    return scene, replace(state, positions=positions)


def explicit_limit(scene):
    return float(jaxrod.stable_dt(replace(scene, method=jaxrod.consistent()), 1.0).dt)


def test_implicit_steps_converge_to_what_explicit_ones_find_through_an_impact(record):
    scene, state = dropped()
    dt, steps = 0.125 * explicit_limit(scene), 240

    def end(scene, refined):
        return jaxrod.advance(scene, state, dt / refined, refined * steps).positions

    def largest_gap(one, other):
        return float(jnp.max(jnp.abs(one - other)))

    coarse, fine, finer = (end(scene, 2**k) for k in range(3))
    assert jnp.min(finer[1]) < -GAP, "it never touched the floor"
    record(
        "Order in dt, implicit, of an arm that hits a floor",
        "2",
        np.log2(largest_gap(coarse, fine) / largest_gap(fine, finer)),
        between=(1.7, 2.3),
    )
    explicit = replace(scene, method=jaxrod.consistent())
    rough, exact = end(explicit, 16), end(explicit, 64)
    assert largest_gap(exact, finer) < 0.5 * largest_gap(rough, finer)
    record(
        "Position of an arm that hits a floor, implicit steps [m]",
        "explicit steps",
        largest_gap(exact, finer),
        at_most=2e-6,
    )


def test_an_arm_comes_to_rest_on_the_floor_in_steps_far_beyond_the_explicit_limit(
    record,
):
    scene, state = dropped(0.2)
    dt = 50 * explicit_limit(scene)
    state = jaxrod.advance(scene, state, dt, int(2.0 / dt))
    depth = -GAP - np.asarray(state.positions[1])
    record(
        "Depth of an arm at rest on a floor, implicit, 50 times the explicit limit",
        "weight over stiffness",
        np.max(np.abs(depth / DEPTH - 1)),
        at_most=1e-6,
    )
