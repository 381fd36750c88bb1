"""Rods that are reeled in and paid out, by drums that turn."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import schedules, shapes

DRUM, ROPE, DENSITY, MODULUS = 0.05, 0.001, 1000.0, 2e7
AROUND = DRUM + ROPE
LINE = DENSITY * np.pi * ROPE**2
STRETCH = MODULUS * np.pi * ROPE**2
WEIGHT, GRAVITY = 0.5, 9.81
ALONG_Y = np.array([0.0, 0.1, 0.0])


def rope(n=60, length=0.6):
    """A rope that hangs from a drum, and its state."""
    return jaxrod.straight_rod(
        n,
        length=length,
        radius=ROPE,
        density=DENSITY,
        youngs_modulus=MODULUS,
        start=(AROUND, 0.0, 0.0),
        direction=(0.0, 0.0, -1.0),
        normal=(0.0, 1.0, 0.0),
        dtype=jnp.float64,
    )


def hung(n=60):
    """A rope that hangs from a drum, its state, and contact of both."""
    rod, state = rope(n)
    free = jaxrod.stable_dt(jaxrod.make_scene(rod), state=state).dt
    stiffness = LINE * float(0.5 / free) ** 2
    rough = jaxrod.contact(
        shapes.cylinder(-ALONG_Y, ALONG_Y, DRUM),
        stiffness=stiffness,
        damping=np.sqrt(stiffness * LINE),
        friction=0.3,
    )
    return rod, state, jaxrod.sticking_contact(rough, rod, state)


def winch(rod, state, rough, angle):
    """A drum about y that winds up a rope with a weight at its tip.

    The base of the rope is fixed on the drum, at the height of its axis.
    """
    turns = {"axis": (0.0, 1.0, 0.0), "angle": angle, "about": (0.0, 0.0, 0.0)}
    return jaxrod.make_scene(
        rod,
        jaxrod.driven(state, axes="xz", **turns),
        jaxrod.moving_contact(rough, **turns),
        jaxrod.end_load((0.0, 0.0, -WEIGHT)),
        jaxrod.gravity(),
        jaxrod.internal_damping(1e-3),
        method=jaxrod.planar("zx"),
    )


def wound_up(turned, seconds=2.0):
    """An angle that grows without a jerk to `turned` within half a period."""
    half = -0.5 * turned
    return schedules.sine(half, 2 * seconds, mean=half, phase=-0.25)


def hanging(free):
    """Length of the rope under the drum, of which `free` are not stretched."""
    return free * (1 + (WEIGHT + 0.5 * GRAVITY * LINE * free) / STRETCH)


@pytest.mark.slow
def test_a_drum_reels_a_rope_in_and_pays_it_out(record):
    turned, seconds = 2.5 * np.pi, 1.0
    rod, state, rough = hung()
    scene = winch(rod, state, rough, wound_up(turned, seconds))
    dt = float(jaxrod.stable_dt(scene).dt)
    n = round(seconds / dt)
    dt = seconds / n
    end = jaxrod.advance(scene, state, dt, n)
    left = float(-end.positions[2, -1])
    # Length at rest of the part that hangs.
    free = np.linspace(0, 0.6, 6001)
    free = np.interp(left, hanging(free), free)
    record(
        "A rope on a drum after 1.25 turns: length wound up",
        "radius of drum and rope, times the angle, less the stretch",
        abs((0.6 - free) * (1 + WEIGHT / STRETCH) / (turned * AROUND) - 1),
        at_most=0.01,
    )
    held, drum = jaxrod.reactions(scene.at(seconds), end)[:2]
    torque = drum.couple + held.couple + jnp.cross(end.positions[:, 0], held.force)
    masses = scene.rod.node_masses
    needed = WEIGHT * end.positions[0, -1] + GRAVITY * masses @ end.positions[0]
    record(
        "Torque on the drum that holds the weight",
        "weights times lever arms",
        abs(float(-torque[1] / needed) - 1),
        at_most=0.01,
    )
    record(
        "Lever arm of the weight",
        "radius of drum and rope",
        abs(float(end.positions[0, -1]) / AROUND - 1),
        at_most=0.01,
    )
    out = jaxrod.advance(scene, end, dt, n, first=n)
    low = float(-out.positions[2, -1])
    record(
        "The same rope paid out again: where its end is, over the way",
        "as low as it would hang",
        abs(low - hanging(0.6)) / 0.4,
        at_most=0.01,
    )


FRICTION, CAPSTAN, CORD = 0.3, 0.2, 0.0005


def over_a_drum(rate, n=80, leg=0.1):
    """A cord over a drum that turns: its base is held, a weight is at its tip."""
    around = CAPSTAN + CORD
    path = np.linspace(-leg, np.pi * around + leg, n + 1)
    angle = np.clip(path / around, 0, np.pi)
    below = np.minimum(path, 0) - np.maximum(path - np.pi * around, 0)
    places = np.stack(
        [-around * np.cos(angle), 0 * path, around * np.sin(angle) + below]
    )
    rod, state = jaxrod.rod_along(
        places,
        radius=CORD,
        density=DENSITY,
        youngs_modulus=8e7,
        normal=(0.0, 1.0, 0.0),
        dtype=jnp.float64,
    )
    rod = replace(rod, rest_curvatures=0 * rod.rest_curvatures)
    rough = jaxrod.contact(
        shapes.cylinder(-ALONG_Y, ALONG_Y, CAPSTAN),
        stiffness=3e5,
        damping=10.0,
        friction=FRICTION,
    )
    drum = jaxrod.moving_contact(
        rough, axis=(0.0, 1.0, 0.0), angle=schedules.ramp(-rate, rate, 2.0, start=-1.0)
    )
    scene = jaxrod.make_scene(
        rod,
        jaxrod.pin_support(state),
        drum,
        jaxrod.end_load((0.0, 0.0, -WEIGHT)),
    )
    return scene, state


@pytest.mark.slow
@pytest.mark.parametrize("way", [1, -1])
def test_a_drum_that_slips_pulls_by_eulers_law(way, record):
    scene, state = over_a_drum(way * 100.0)
    rest = jaxrod.equilibrium(scene.at(0.0), state, max_iterations=300)
    assert rest.converged
    held = jaxrod.reactions(scene.at(0.0), rest.state)[0]
    record(
        f"Force that holds a rope on a capstan that turns {way:+d}",
        "weight times exp(friction times angle)",
        abs(float(-held.force[2]) / (WEIGHT * np.exp(way * FRICTION * np.pi)) - 1),
        at_most=0.01,
    )


def test_an_end_on_a_drum_moves_on_a_circle():
    rod, state = rope(n=2)
    rate, way = 3.0, np.array([0.1, 0.0, 0.2])
    fixed = jaxrod.driven(
        state,
        displacement=schedules.ramp(0 * way, way, 1.0),
        axis=(0.0, 2.0, 0.0),
        angle=schedules.ramp(0.0, rate, 1.0),
        about=(0.0, 0.3, 0.0),
    )
    place = jaxrod.make_scene(rod, fixed).at(0.4).effects[0].place
    cosine, sine = np.cos(0.4 * rate), np.sin(0.4 * rate)
    arm = AROUND * np.array([cosine, 0.0, -sine])
    across = AROUND * np.array([-sine, 0.0, -cosine])
    np.testing.assert_allclose(place.position, 0.4 * way + arm, atol=1e-12)
    np.testing.assert_allclose(place.velocity, way + rate * across, atol=1e-12)
    np.testing.assert_allclose(place.acceleration, -(rate**2) * arm, atol=1e-12)


def test_bad_input():
    _, state = rope(n=2)
    with pytest.raises(ValueError, match="axis must be given with about"):
        jaxrod.driven(state, about=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="about"):
        jaxrod.driven(state, axis=(0.0, 1.0, 0.0), about=(0.0, 0.0))
    pinned = jaxrod.driven(
        state, axis=(0.0, 1.0, 0.0), about=(0.0, 0.0, 0.0), free_to_turn=True
    )
    assert pinned.turn is None


@pytest.mark.slow
def test_gradients_with_respect_to_the_turn_agree_with_differences():
    rod, state, rough = hung(n=12)

    def lifted(numbers):
        scene = winch(rod, state, rough, wound_up(*numbers))
        end = jaxrod.advance(scene, state, 2e-5, 600)
        return end.positions[2].sum()

    at, h = jnp.array([0.2, 0.02]), 1e-6
    lifted = jax.jit(lifted)
    slopes = [(lifted(at + h * e) - lifted(at - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(jax.grad(lifted)(at), slopes, rtol=1e-5)
