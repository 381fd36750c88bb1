"""One of every actuator, on a rod of no particular shape."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.effects.time import at_clock, clock_at
from physics.rods import arm, deformed, random_rod, turn

N = 6


def uneven_rod(seed=5, n=N):
    """A tapered, curved, uneven rod, its rest state, and a deformed moving one."""
    rod, rest = random_rod(seed, n)
    moving = deformed(rod, seed, largest_angle=0.6, largest_strain=0.2, speed=0.3)
    return rod, rest, moving


def actuators(rod, rest):
    """Every actuator with an energy, strong enough to matter, by name."""
    n = rod.n_elements
    radius = float(rod.radii[0])
    pull = 0.1 * float(rod.shear_stretch_stiffness[2, 0])
    bend = float(rod.bend_twist_stiffness[0, 0])
    random = np.random.default_rng(1)
    start, finish = jaxrod.clamp(rest), jaxrod.clamp(rest, "tip")
    winding = jaxrod.actuation.helical_offsets(rod, 0.8 * radius, 1.5, (0.3, 2.4))
    offsets = random.uniform(-radius, radius, (3, 2))
    return {
        "wave of bending": jaxrod.actuation.travelling_wave(
            rod,
            bend * np.array([0.5, 2.0, 3.0, 1.0]),
            period=1.0,
            wavelength=0.7,
            axis=(1.0, 2.0, 0.5),
            phase=0.3,
            into=start,
        ),
        "longitudinal muscles": jaxrod.actuation.muscle(
            rod,
            pull * random.uniform(0.5, 1.0, (3, n)),
            (0.2, 0.7, 1.0),
            offsets=offsets,
            into=(start, finish),
        ),
        "helical muscles": jaxrod.actuation.muscle(
            rod,
            pull,
            random.uniform(0.0, 1.0, (2, n)),
            offsets=winding,
            curve=jaxrod.actuation.gaussian_force(),
        ),
        "muscle across": jaxrod.actuation.muscle(rod, pull, 0.6, across=True),
        "chambers": jaxrod.actuation.chamber(
            rod, (2.0, -1.0, 0.5), pull, offsets=offsets, into=finish
        ),
        "wound chambers": jaxrod.actuation.wound_chamber(
            rod,
            pull / (np.pi * radius**2),
            0.4 * radius,
            (0.7, -1.2),
            offsets=offsets[:2],
            into=start,
        ),
        "tendon pulled with a force": jaxrod.actuation.tendon(
            rod,
            offsets[:2],
            tension=(pull, 0.3 * pull),
            elements=(1, n - 2),
            anchor=(0.1, -0.1, -0.2),
        ),
        "tendon on a winch": jaxrod.actuation.tendon(
            rod, offsets[:2], length=(0.6, 0.61), stiffness=10 * pull, onset=0.05
        ),
        "active shape": jaxrod.actuation.active_shape(
            rod, curvature=(1.0, -2.0, 0.5), strain=(0.02, 0.0, 0.1), into=start
        ),
        "magnet in a uniform field": jaxrod.actuation.magnetisation(
            rod, (bend, 0.3 * bend, 2 * bend), (0.3, 1.0, -0.4)
        ),
        "magnet in a nonuniform field": jaxrod.actuation.magnetisation(
            rod,
            bend * random.normal(size=(3, n)),
            jaxrod.actuation.linear_field(
                (0.3, 1.0, -0.4),
                [[1.0, 0.2, 0.0], [0.2, -0.4, 0.3], [0.0, 0.3, -0.6]],
                extent=1.5,
            ),
        ),
    }


def strained(rod, curvature, strain, into=None):
    """A rod along z that is bent, twisted and stretched evenly, from a wall or not."""
    n = rod.n_elements
    _, state = arm(n)
    joints = np.asarray(rod.joint_lengths)
    first = 0.0 if into is None else 0.5 * float(rod.rest_lengths[0])
    places = first + np.concatenate([[0.0], np.cumsum(joints)])
    turns = jnp.asarray(np.outer(curvature, places))
    state = replace(state, orientations=turn(state.orientations, turns))
    edges = (1 + strain) * rod.rest_lengths[None, :] * state.directors[2]
    nodes = jnp.concatenate([jnp.zeros((3, 1)), jnp.cumsum(edges, axis=1)], axis=1)
    return replace(state, positions=nodes)


def at_once(effects):
    """Effects with the schedules of a wave at one moment."""
    return at_clock(effects, clock_at(0.2, jnp.float64))
