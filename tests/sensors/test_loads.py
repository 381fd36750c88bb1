"""Supports, tendons, chambers and contact, against closed forms."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import sensors
from sensors.rods import LENGTH, MODULUS, MOMENT_OF_AREA, RADIUS, arc, straight


def upright():
    return straight(direction=(0.0, 0.0, 1.0))


def test_a_wall_holds_the_end_of_a_bent_rod_with_its_moment():
    rod, state = upright()
    scene = jaxrod.make_scene(rod, jaxrod.end_load((0, 0, 0.0)), jaxrod.clamp(state))
    kappa = 0.6
    bent = MODULUS * MOMENT_OF_AREA * kappa
    couple = sensors.support_couple().read(scene, arc(rod, kappa))
    # The rod bends towards +x: the wall turns its end the other way.
    np.testing.assert_allclose(couple, [0, -bent, 0], rtol=1e-9, atol=1e-14)
    with pytest.raises(ValueError, match="no support at the tip"):
        sensors.support_couple("tip").read(scene, state)


def test_a_support_of_both_ends_is_refused():
    """Its reaction is that of both together."""

    class Vice(jaxrod.extend.Effect):
        def held(self, rod):
            return tuple(jaxrod.extend.Held(node) for node in (0, -1))

        def reaction(self, rod, motion, needed):
            both = tuple(part[0] + part[-1] for part in needed.forces)
            return jaxrod.extend.Reaction.of(both)

    rod, state = upright()
    scene = jaxrod.make_scene(rod, jaxrod.gravity(), jaxrod.extend.pytree(Vice)())
    for end in ("base", "tip"):
        with pytest.raises(ValueError, match=f"Vice holds the {end} of the rod and an"):
            sensors.support_force(end).read(scene, state)


def test_a_cable_is_shorter_on_the_inner_side():
    rod, _ = upright()
    offset, n = 0.015, rod.n_elements
    cables = jaxrod.actuation.tendon(
        rod, [(offset, 0.0), (-offset, 0.0)], length=0.7, stiffness=40.0, onset=1e-6
    )
    scene = jaxrod.make_scene(rod, jaxrod.gravity(), cables)
    kappa = 0.8
    half = 0.5 * kappa * LENGTH / n
    # Eyelets are on chords of the circle through the nodes.
    middle = 0.5 * LENGTH / n / np.tan(half)
    long = (n - 1) * 2 * np.sin(half) * (middle - np.asarray([offset, -offset]))
    state = arc(rod, kappa)
    np.testing.assert_allclose(
        sensors.tendon_length(1).read(scene, state), long, rtol=1e-12
    )
    pull = sensors.tendon_tension(1).read(scene, state)
    np.testing.assert_allclose(pull, 40.0 * (long - 0.7), rtol=1e-12)
    with pytest.raises(TypeError, match="effect 0 of the scene must be a jaxrod Tend"):
        sensors.tendon_length(0).read(scene, state)
    with pytest.raises(ValueError, match="effect must be at most 1, got 2"):
        sensors.tendon_length(2).read(scene, state)


def test_pressures_are_those_at_the_time_of_the_scene():
    rod, state = upright()
    chambers = jaxrod.actuation.chamber(
        rod,
        jaxrod.schedules.ramp((0.0, 1e4), (2e4, 1e4), 2.0),
        1e-4,
        offsets=[(0.01, 0.0), (-0.01, 0.0)],
    )
    scene = jaxrod.make_scene(rod, chambers)
    gauge = sensors.chamber_pressure(0)
    np.testing.assert_allclose(gauge.read(scene.at(1.5), state), [1.5e4, 1e4])
    with pytest.raises(ValueError, match=r"give scene\.at\(time\)"):
        gauge.read(scene, state)


@pytest.mark.slow
def test_a_rod_on_the_ground_is_pushed_in_proportion_to_its_depth():
    rod, state = straight(direction=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    depth, stiffness = 0.1 * RADIUS, 5e4
    ground = jaxrod.shapes.plane((0.0, 0.0, depth - RADIUS), (0.0, 0.0, 1.0))
    pushed = jaxrod.contact(ground, stiffness=stiffness)
    scene = jaxrod.make_scene(rod, jaxrod.gravity(), pushed)
    total = sensors.contact_force().read(scene, state)
    up = stiffness * depth * LENGTH
    np.testing.assert_allclose(total, [0, 0, up], rtol=1e-12, atol=1e-14)
    each = sensors.contact_force(per_node=True).read(scene, state)
    share = np.asarray([0.5, 1, 1, 1, 0.5]) / 4
    np.testing.assert_allclose(each[2], up * share, rtol=1e-12)
    lifted = replace(state, positions=state.positions + jnp.asarray([[0], [0], [0.1]]))
    np.testing.assert_array_equal(sensors.contact_force().read(scene, lifted), 0)
    with pytest.raises(ValueError, match="no contact"):
        sensors.contact_force().read(jaxrod.make_scene(rod), state)
