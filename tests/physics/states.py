"""Sound and unsound states of rods, and what the rods may be tied to.

A case is a function that gives a rod, its state, and the state in which it is where it
belongs: at its wall, touching the ball. All in NumPy, float64.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from physics.rods import deformed
from physics.worlds import product

N = 10

# What a rod may be tied to: effects, of where the rod belongs and the world.


def nothing(home, world):
    return ()


def clamp(home, world):
    return (jaxrod.clamp(world.state(home)),)


def fixed_end(home, world):
    return (jaxrod.fixed_end(world.state(home)),)


def ball(home, world):
    """Of 0.3 m, below the middle of the rod; they touch."""
    sphere = jaxrod.shapes.sphere(
        world.place([0.5, 0.0, -0.349]), 0.3 * world.unit(length=1)
    )
    return (jaxrod.contact(sphere, stiffness=1e6 * world.unit(-1, 1, -2)),)


@functools.cache
def straight():
    """A metre along x, 5 cm in radius, 1 MPa."""
    rod, state = jaxrod.straight_rod(
        N,
        length=1.0,
        radius=0.05,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
    )
    rod, state = jax.tree.map(np.asarray, (rod, state))
    return rod, state, state


def along(nodes, **options):
    """A rod that is unstressed as it lies."""
    rod, state = jaxrod.rod_along(
        nodes,
        radius=0.05,
        density=1000.0,
        youngs_modulus=1e6,
        dtype=jnp.float64,
        **options,
    )
    rod, state = jax.tree.map(np.asarray, (rod, state))
    return rod, state, state


def with_positions(change):
    rod, home, _ = straight()
    return rod, replace(home, positions=change(home.positions)), home


def with_norm(norm):
    rod, home, _ = straight()
    return rod, replace(home, orientations=norm * home.orientations), home


def inside_out():
    return with_positions(lambda x: -x)


def zigzag():
    return with_positions(
        lambda x: np.stack([0.1 * (np.arange(N + 1) % 2), x[1], x[2]])
    )


def moved(*by):
    return lambda: with_positions(lambda x: x + np.asarray(by)[:, None])


def stretched(stretch):
    return lambda: with_positions(lambda x: stretch * x)


def about_z(angle):
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])[:, None]


def sheared(angle):
    """Every element's frame turned against its edge."""

    def state():
        rod, home, _ = straight()
        turned = product(about_z(angle), home.orientations)
        return rod, replace(home, orientations=turned), home

    return state


def swung(angle, first=0):
    """The rod turned about z, from a node on."""

    def state():
        rod, home, _ = straight()
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        hinge = home.positions[:, first : first + 1]
        positions, orientations = np.array(home.positions), np.array(home.orientations)
        positions[:, first:] = hinge + turn @ (positions[:, first:] - hinge)
        orientations[:, first:] = product(about_z(angle), orientations[:, first:])
        return rod, replace(home, positions=positions, orientations=orientations), home

    return state


def hairpin(angle=2.88):
    """Unstressed, with one joint of 2.88 rad."""
    return along(swung(angle, N // 2)()[1].positions)


def hairpin_shut():
    """The hairpin bent on by 0.1 rad."""
    rod, home, _ = hairpin()
    _, state, _ = hairpin(2.98)
    return rod, state, home


def sheared_at_rest():
    """Unstressed, its frames at 50 degrees to its edges."""
    rod, state, _ = sheared(0.87)()
    return jax.tree.map(np.asarray, jaxrod.unstressed(rod, state)), state, state


def stretched_at_rest():
    rod, state, _ = stretched(3.0)()
    return jax.tree.map(np.asarray, jaxrod.unstressed(rod, state)), state, state


def bent():
    rod, home, _ = straight()
    state = deformed(rod, 3, largest_angle=1.0, largest_strain=0.2, speed=0.5)
    return rod, jax.tree.map(np.asarray, state), home


def moving_fast():
    """A kilometre per second."""
    rod, home, _ = straight()
    wind = np.array([300.0, -900.0, 316.0])[:, None]
    return rod, replace(home, velocities=home.velocities + wind), home


UNSOUND = {
    "inside out": (inside_out, nothing, "stretch"),
    "inside out at a wall": (inside_out, clamp, "stretch"),
    "zigzag": (zigzag, nothing, "stretch"),
    "sheared flat": (sheared(np.pi / 2), nothing, "stretch"),
    "sheared by 80 degrees": (sheared(1.4), nothing, "stretch"),
    "compressed": (stretched(0.29), nothing, "stretch"),
    "drawn out": (stretched(2.6), nothing, "stretch"),
    "quaternions of zero": (lambda: with_norm(0.0), nothing, "norm"),
    "quaternions of 1e-3": (lambda: with_norm(1e-3), nothing, "norm"),
    "quaternions of 1.001": (lambda: with_norm(1.001), nothing, "norm"),
    "quaternions of 5": (lambda: with_norm(5.0), nothing, "norm"),
    "10 m off its wall": (moved(0.0, 0.0, 10.0), clamp, "violation"),
    "6 cm off its wall": (moved(0.06, 0.0, 0.0), clamp, "violation"),
    "10 m off its fixed end": (moved(0.0, 10.0, 0.0), fixed_end, "violation"),
    "turned at its fixed end": (swung(1.1), fixed_end, "violation"),
    "folded at its wall": (swung(2.6), clamp, "violation"),
    "folded": (swung(2.6, N // 2), nothing, "joint_angle"),
    "6 cm into a ball": (moved(0.0, 0.0, -0.061), ball, "violation"),
    "in the middle of a ball": (moved(0.0, 0.0, -0.349), ball, "violation"),
}
"""Case, tie, and the flag that must rise."""

SOUND = {
    "at rest": (moved(0.0, 0.0, 0.0), clamp),
    "at rest, held": (moved(0.0, 0.0, 0.0), fixed_end),
    "on a ball": (moved(0.0, 0.0, 0.0), ball),
    "pressed on a ball": (moved(0.0, 0.0, -0.04), ball),
    "4 cm off its wall": (moved(0.04, 0.0, 0.0), clamp),
    "10 m from where it was": (moved(0.0, 10.0, 0.0), nothing),
    "swung at its wall": (swung(2.4), clamp),
    "bent and sheared": (bent, nothing),
    "compressed": (stretched(0.31), nothing),
    "drawn out": (stretched(2.4), nothing),
    "a hairpin at rest": (hairpin, nothing),
    "a hairpin shut": (hairpin_shut, nothing),
    "sheared at rest": (sheared_at_rest, nothing),
    "stretched at rest": (stretched_at_rest, nothing),
    "moving at 1 km/s": (moving_fast, nothing),
}
"""Case and tie."""
