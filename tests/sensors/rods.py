"""Rods in poses that are known in closed form, for tests of sensors."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import jaxrod

LENGTH, RADIUS, DENSITY, MODULUS = 1.0, 0.02, 1e3, 1e6
AREA = np.pi * RADIUS**2
MOMENT_OF_AREA = np.pi * RADIUS**4 / 4
PER_LENGTH = DENSITY * AREA


def straight(n=4, direction=(0.0, 0.0, -1.0), normal=(1.0, 0.0, 0.0)):
    """A straight rod from the origin, and its state at rest."""
    return jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=MODULUS,
        direction=direction,
        normal=normal,
    )


def arc(rod, curvature):
    """State along a circle in the xz plane from the z axis, unstretched: kappa_2.

    Elements are chords, as long as at rest.
    """
    turn = curvature * LENGTH / rod.n_elements
    angle = turn * (np.arange(rod.n_elements) + 0.5)
    steps = np.stack([np.sin(angle), 0 * angle, np.cos(angle)])
    steps *= np.asarray(rod.rest_lengths)
    nodes = np.concatenate([np.zeros((3, 1)), np.cumsum(steps, axis=1)], axis=1)
    none = 0 * angle
    turned = np.stack([np.cos(angle / 2), none, np.sin(angle / 2), none])
    return jaxrod.RodState(
        positions=jnp.asarray(nodes),
        orientations=jnp.asarray(turned),
        velocities=jnp.zeros((3, rod.n_elements + 1)),
        angular_momenta=jnp.zeros((3, rod.n_elements)),
    )


def hanging(rod, state, spin=0.0, weight=9.81):
    """State below the pivot at the lowest point of a swing about y, in balance.

    The elements are stretched by what hangs on them and by centrifugal force.
    """
    masses, h = np.asarray(rod.node_masses), np.asarray(rod.rest_lengths)
    down = np.concatenate([[0.0], np.cumsum(h)])
    for _ in range(60):
        pull = np.cumsum((masses * (weight + spin**2 * down))[::-1])[::-1][1:]
        down = np.concatenate([[0.0], np.cumsum(h * (1 + pull / (MODULUS * AREA)))])
    none = 0 * down
    moving = jaxrod.with_angular_velocities(rod, state, about_y(rod, state, spin))
    return replace(
        moving,
        positions=jnp.asarray(np.stack([none, none, -down])),
        velocities=jnp.asarray(np.stack([-spin * down, none, none])),
    )


def about_y(rod, state, spin):
    """Angular velocity about the world's y axis, in the material frames."""
    return spin * np.asarray(state.directors)[:, 1]
