"""Hinges beside the centres of what they join: angles, frequencies, decay."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.structure import pytree
from jaxrod.systems.stepping.assembly import seen_at_rest

MASS, INERTIA, ARM = 1.0, (0.1, 0.2, 0.25), 0.3
"""Of the body that turns, and how far its centre is from the hinge [m]."""
AXIS_STIFFNESS, STIFFNESS = 50.0, 1e7


@pytree
class Couple(jaxrod.extend.Effect):
    """A couple about x, world frame, on a body that has not turned far [N m]."""

    size: jnp.ndarray

    def loads(self, rod, motion):
        none = jnp.zeros_like(motion.spin[0])
        _, x, y, z = motion.orientation
        w = motion.orientation[0]
        # First row of the rotation: the world's x in the body's frame.
        own = (
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
        )
        return jaxrod.extend.Loads(couples=tuple(self.size * one + none for one in own))


def hinged(effects=(), turning=(0.0, 0.0, 0.0), **numbers):
    """A body on a hinge about z at the origin, on a base that is as good as fixed."""
    base, of_base = jaxrod.systems.rigid_body(
        mass=1e9, inertia=(1e9,) * 3, position=(0.0, -0.5, 0.2), dtype=jnp.float64
    )
    body, of_body = jaxrod.systems.rigid_body(
        mass=MASS,
        inertia=INERTIA,
        position=(0.0, ARM, 0.0),
        velocity=np.cross(turning, (0.0, ARM, 0.0)),
        angular_velocity=turning,
        effects=effects,
        dtype=jnp.float64,
    )
    state = {"base": of_base, "body": of_body}
    joint = jaxrod.systems.hinge_joint(
        ("base",),
        ("body",),
        state,
        axis=(0, 0, 1),
        at=(0.0, 0.0, 0.0),
        stiffness=STIFFNESS,
        axis_stiffness=AXIS_STIFFNESS,
        **numbers,
    )
    return jaxrod.make_system({"base": base, "body": body}, joint), state


def turned(state):
    """Vector part of the body's quaternion, twice: small angles [rad]."""
    return 2 * np.asarray(state["body"].orientations)[1:, 0]


def test_a_motor_has_its_couple_about_the_mean_of_both_axes():
    """On a body whose axis is tilted by an angle: so is the mean, by half of it."""
    couple, tilt = 0.2, 0.3
    system, state = hinged(motor=couple)
    turned = jnp.asarray([np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0])[:, None]
    state["body"] = replace(state["body"], orientations=turned)
    seen, (_, axes) = seen_at_rest(system, state)
    driven, free = (one.loads(seen) for one in (axes, replace(axes, motor=None)))
    # The sum of two unit vectors is no unit vector; both axes are across x.
    mean = couple * np.cos(tilt / 2)
    for name, sign, angle in (("body", 1, -tilt / 2), ("base", -1, tilt / 2)):
        made = np.subtract(driven[name].couples, free[name].couples)[:, 0]
        # In its own frame: the axis of the one is turned from the mean either way.
        expected = sign * mean * np.array([0.0, -np.sin(angle), np.cos(angle)])
        np.testing.assert_allclose(made, expected, atol=1e-12)


@pytest.mark.slow
def test_a_motor_turns_what_is_beside_the_hinge(record):
    """c t^2 / 2 (J + m p^2)."""
    couple = 0.2
    system, state = hinged(motor=couple)
    dt = 0.2 * jaxrod.stable_dt(system).dt
    steps = int(1.0 / dt)
    after = jaxrod.advance(system, state, dt, jnp.asarray(steps))["body"]
    w, _, _, z = np.asarray(after.orientations[:, 0])
    expected = couple * (steps * float(dt)) ** 2 / (2 * (INERTIA[2] + MASS * ARM**2))
    record(
        "angle of a motor's hinge beside the body's centre",
        "c t^2 / 2 (J + m p^2)",
        abs(2 * np.arctan2(z, w) / expected - 1),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_a_couple_across_the_axis_tilts_it(record):
    """Off its axis a hinge is a spring: sin(angle) = c / kt, wherever the centre is."""
    couple = 5.0
    system, state = hinged(
        effects=(Couple(jnp.asarray(couple)),), axis_damping=2.0, damping=100.0
    )
    dt = 0.4 * jaxrod.stable_dt(system).dt
    end = jaxrod.advance(system, state, dt, jnp.asarray(int(4.0 / dt)))
    w, x, y, z = np.asarray(end["body"].orientations[:, 0])
    assert np.hypot(y, z) < 1e-9
    record(
        "tilt of a hinge by a couple across its axis, sine",
        "c / kt",
        abs(2 * x * w / (couple / AXIS_STIFFNESS) - 1),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_a_tilt_swings_and_decays(record):
    """With (J + m p^2) and the hinge's stiffness and damping against tilts."""
    damping, rate = 0.5, 0.01
    system, state = hinged(turning=(rate, 0.0, 0.0), axis_damping=damping)
    dt = 0.2 * float(jaxrod.stable_dt(system).dt)
    steps = int(0.02 / dt)
    inertia = INERTIA[0] + MASS * ARM**2
    decay = damping / (2 * inertia)
    swing = np.sqrt(AXIS_STIFFNESS / inertia - decay**2)
    times = np.arange(1, 41) * steps * dt
    now, found = state, []
    for k in range(len(times)):
        now = jaxrod.advance(system, now, dt, jnp.asarray(steps), first=k * steps)
        found.append(turned(now)[0])
    expected = rate / swing * np.exp(-decay * times) * np.sin(swing * times)
    assert np.exp(-decay * times[-1]) < 0.5
    record(
        "tilt of a hinge beside the centre, swinging and decaying, over its size",
        "a damped oscillator of J + m p^2",
        np.max(np.abs(found - expected)) / (rate / swing),
        at_most=1e-3,
    )
