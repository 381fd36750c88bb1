"""A body that fits between the points where contact is looked for is warned of."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

import jaxrod

RADIUS, WIRE = 0.01, 0.002


def across(spacing):
    """A rod above a wire that runs across it, in the middle between two nodes."""
    n = 31
    return jaxrod.straight_rod(
        n,
        length=n * spacing,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e8,
        start=(-0.5 * n * spacing, 0.025, 0.0),
        direction=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
    )


def wire(points_per_element=1):
    """Stiff enough for the whole rod to be stopped within half a radius at a node."""
    body = jaxrod.shapes.capsule((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), WIRE)
    return jaxrod.contact(body, stiffness=8e5, points_per_element=points_per_element)


def passes(rod, state, touch):
    """Whether a rod thrown at the wire at 2 m/s comes out behind it."""
    thrown = replace(state, velocities=state.velocities.at[1].set(-2.0))
    scene = jaxrod.make_scene(rod, touch)
    dt = jaxrod.stable_dt(scene).dt
    after = jaxrod.advance(scene, thrown, dt, int(0.04 / dt))
    middle = rod.n_elements // 2
    return bool(jnp.mean(after.positions[1, middle : middle + 2]) < -RADIUS - WIRE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spacing", "points", "slips"), [(1.8, 1, True), (1.8, 2, False), (1.0, 1, False)]
)
def test_what_slips_through_is_warned_of(spacing, points, slips):
    """Spacing in units of the radii of rod and wire together."""
    rod, state = across(spacing * (RADIUS + WIRE))
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", jaxrod.ThinBodyWarning)
        assert passes(rod, state, wire(points)) == slips
    assert bool(heard) == slips


def test_the_warning_says_how_many_points_see_the_body():
    rod, _ = across(0.1)
    with pytest.warns(
        jaxrod.ThinBodyWarning, match=r"0\.1 m .*0\.002 m .*points_per_element=9,"
    ):
        jaxrod.make_scene(rod, wire())
    jaxrod.make_scene(rod, wire(9))


def bodies(size):
    """One of every kind, as thin as that."""
    bottom, top = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)
    yield jaxrod.shapes.sphere(bottom, size)
    yield jaxrod.shapes.capsule(bottom, top, size)
    yield jaxrod.shapes.cylinder(bottom, top, size)
    yield jaxrod.shapes.cylinder((0.0, 0.0, -size), (0.0, 0.0, size), 1.0)
    yield jaxrod.shapes.box(bottom, (1.0, size, 1.0))
    yield jax.vmap(lambda r: jaxrod.shapes.sphere(top, r))(jnp.asarray([0.1, size]))


def test_bodies_of_every_kind_are_known_to_be_thin():
    rod, _ = across(0.1)
    for thin, thick in zip(bodies(WIRE), bodies(0.1), strict=True):
        with pytest.warns(jaxrod.ThinBodyWarning, match="a body of radius 0.002 m"):
            jaxrod.make_scene(rod, jaxrod.contact(thin, stiffness=1e5))
        jaxrod.make_scene(rod, jaxrod.contact(thick, stiffness=1e5))


def test_what_cannot_be_seen_through_is_not_warned_of():
    """A plane, a body that is known by its distance alone, and traced numbers."""
    rod, _ = across(0.1)
    jaxrod.make_scene(rod, jaxrod.contact(jaxrod.shapes.plane(), stiffness=1e5))
    body = jaxrod.shapes.signed_distance(lambda x, r: jnp.linalg.norm(x) - r, WIRE)
    jaxrod.make_scene(rod, jaxrod.contact(body, stiffness=1e5))

    @jax.jit
    def traced(radius):
        body = jaxrod.shapes.sphere((0.0, 0.0, 0.0), radius)
        return jaxrod.make_scene(rod, jaxrod.contact(body, stiffness=1e5))

    traced(WIRE)
