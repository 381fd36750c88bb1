"""Laws on rods that are not round, not uniform, and along no axis of the world."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.analysis.frequency import Vibration, free_motions
from jaxrod.analysis.stability import MODE_NAMES, limiting
from jaxrod.geometry.rotations import directors, to_world
from jaxrod.rods.drag import Drag, drag_loads
from jaxrod.rods.motion import motion_of

MATERIAL = {"density": 1000.0, "youngs_modulus": 1e6}
OBLIQUE = (1.0, 1.0, 1.0)


def test_couples_of_drag_are_rates_times_angular_momenta_of_a_strip():
    strip = jaxrod.rectangle(0.05, 0.02)
    rod, state = jaxrod.straight_rod(
        3, length=0.3, section=strip, direction=OBLIQUE, **MATERIAL
    )
    spins = np.random.default_rng(0).normal(size=(3, 3))
    motion = motion_of(jaxrod.with_angular_velocities(rod, state, spins))
    rate = jnp.asarray([1.0, 2.0, 3.0])
    still = jnp.zeros(4)
    loads = drag_loads(rod, motion, Drag(still, still, turning=(rate, rate)))
    couples = to_world(directors(motion.orientation), loads.couples)
    for couple, momentum in zip(couples, motion.spin, strict=True):
        np.testing.assert_allclose(couple, -rate * momentum, rtol=1e-12)


@pytest.mark.parametrize("batched", [False, True])
def test_a_taper_is_linear_in_length_whatever_the_elements(batched):
    places = jnp.asarray([0.0, 0.1, 0.3, 1.0])

    def radii(nodes):
        positions = jnp.stack([nodes, 0 * nodes, 0 * nodes])
        return jaxrod.rod_along(positions, radius=(0.1, 0.05), **MATERIAL)[0].radii

    found = jax.jit(radii)(places) if batched else radii(places)
    middles = 0.5 * (places[1:] + places[:-1])
    np.testing.assert_allclose(found, 0.1 - 0.05 * middles, rtol=1e-12)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), OBLIQUE])
def test_motion_along_a_rod_is_stretch_whatever_the_direction(direction):
    _, state = jaxrod.straight_rod(
        3, length=1.0, radius=0.2, direction=direction, **MATERIAL
    )
    along = jnp.asarray([0.0, 0.3, 0.8, 0.5])[None] * state.directors[2][:, :1]
    mode, element = limiting(Vibration(jnp.ones(()), along, jnp.zeros((3, 3))), state)
    assert (MODE_NAMES[int(mode)], int(element)) == ("stretch", 1)


@pytest.mark.slow
@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), OBLIQUE])
def test_the_motion_that_limits_a_step_does_not_depend_on_the_direction(direction):
    # So soft in shear that stretch is the fastest motion.
    rod, state = jaxrod.straight_rod(
        3, length=1.0, radius=0.2, shear_modulus=1e3, direction=direction, **MATERIAL
    )
    found = jaxrod.stable_dt(jaxrod.make_scene(rod), state=state)
    assert found.limiting_mode.startswith("stretch")


def held_without_twist():
    rod, state = jaxrod.straight_rod(3, length=1.0, radius=0.02, **MATERIAL)
    method = jaxrod.torsion_free()
    return jaxrod.make_scene(rod, jaxrod.clamp(state), method=method), state


def test_a_rod_without_twist_is_not_free_to_twist():
    # Four nodes, of which one is held, in three directions; elements about two axes.
    assert np.count_nonzero(free_motions(*held_without_twist())) == 3 * 3 + 2 * 3


@pytest.mark.slow
def test_frequencies_without_twist_begin_with_that_of_bending():
    found = jaxrod.natural_frequencies(*held_without_twist())
    # Three elements err by some ten per cent of Euler and Bernoulli's frequency.
    euler = 1.8751**2 * 0.01 * np.sqrt(1e6 / 1000.0)
    assert found[:2] == pytest.approx(euler, rel=0.1)


def test_the_travel_of_a_node_counts_in_its_own_radii():
    rod, state = jaxrod.straight_rod(4, length=1.0, radius=(0.1, 0.001), **MATERIAL)
    scene = jaxrod.make_scene(rod, jaxrod.pin_support(state, 2))

    shares = jnp.asarray([0.49, 0.51, 0.51])
    nodes, radii = jnp.asarray([0, 0, 4]), rod.radii[jnp.asarray([0, 0, 3])]

    def flag(node, speed):
        velocities = state.velocities.at[0, node].set(speed)
        moving = replace(state, velocities=velocities)
        return jaxrod.health(scene, moving, 1e-3).speed

    found = jax.jit(jax.vmap(flag))(nodes, shares * radii / 1e-3)
    assert found.tolist() == [False, True, True]


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("held", [True, False])
def test_frequencies_in_a_plane_are_those_in_space_that_stay_in_it(held):
    """A strip that is bent in its plane, with frames turned about the axis."""
    s = np.linspace(0, 1, 5)
    places = np.stack([np.sin(s), 0 * s, 1 - np.cos(s)])
    rod, state = jaxrod.rod_along(
        places,
        section=jaxrod.rectangle(width=0.02, height=0.07),
        normal=(0.0, 1.0, 0.0),
        **MATERIAL,
    )
    support = (jaxrod.clamp(state),) if held else ()
    space = jaxrod.make_scene(rod, *support)
    plane = jaxrod.make_scene(rod, *support, method=jaxrod.planar("zx"))
    found = jaxrod.natural_frequencies(plane, state)
    every = jaxrod.natural_frequencies(space, state)
    assert found.size == (2 * 5 + 4) - (2 if held else 0) and every.size > found.size
    apart = np.min(np.abs(found[:, None] - every[None]), axis=1)
    assert np.max(apart) < 1e-7 * found[-1]
    rigid = np.sum(found < 1e-6 * found[-1])
    assert rigid == (0 if held else 3)
