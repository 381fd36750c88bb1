"""A snake on the ground: a travelling wave of couples and friction with directions.

The scene of PyElastica's continuum snake (Gazzola et al., R. Soc. Open Sci. 5 (2018)
171628). PyElastica 1.0.0 with its own friction, steps of 0.1 ms and its optimised gait
moves 0.15923 lengths in a period, the mean of periods 3 to 9.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elastica.external_forces import _bspline

import jaxrod
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.structure import pytree

N, LENGTH, PERIOD, G, FROUDE = 50, 0.35, 2.0, 9.80665, 0.1
RADIUS, DENSITY, YOUNG = 0.011 * LENGTH, 1000.0, 1e6
GAIT = np.array([3.4e-3, 3.3e-3, 4.2e-3, 2.6e-3, 3.6e-3, 3.5e-3])  # [N m]
PYELASTICA = 0.15923  # lengths per period


@pytree
class Wave(jaxrod.extend.Effect):
    """Couples about the vertical between neighbours, from the last element on."""

    sizes: jax.Array
    places: jax.Array
    time: jax.Array

    def loads(self, rod, motion):
        angle = 2 * jnp.pi * (self.time / PERIOD - self.places)
        wave = jnp.minimum(self.time / PERIOD, 1) * self.sizes * jnp.sin(angle)
        inner = wave[::-1][1:]
        up = jnp.pad(inner, (1, 0)) - jnp.pad(inner, (0, 1))
        still = jnp.zeros_like(up)
        frame = directors(motion.orientation)
        return jaxrod.extend.Loads(couples=to_material(frame, (still, up, still)))


def snake():
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 1.5,
        normal=(0.0, 1.0, 0.0),
        dtype=jnp.float64,
    )
    line, depth = float(rod.linear_density[0]), 0.05 * RADIUS
    friction = LENGTH / (PERIOD**2 * G * FROUDE) * np.array([1.0, 1.5, 2.0])
    ground = jaxrod.contact(
        jaxrod.shapes.plane((0.0, -RADIUS, 0.0), (0.0, 1.0, 0.0)),
        stiffness=line * G / depth,
        damping=300.0 * line,
        friction=friction,
        friction_drag=1000.0 * line,
    )
    places = np.cumsum(rod.rest_lengths) / LENGTH
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, -G, 0.0)),
        Wave(_bspline(GAIT)[0](places), places, jaxrod.schedules.time()),
        ground,
        # PyElastica's damping of 2e-3, which it multiplies by m / J for spins.
        jaxrod.exponential_damping(2e-3, 2e-3 * 4 / RADIUS**2),
    )
    sunk = jnp.asarray([[0.0], [-depth], [0.0]])
    return scene, replace(state, positions=state.positions + sunk)


@pytest.mark.slow
def test_a_snake_is_as_fast_as_pyelastica_s(record):
    scene, state = snake()
    steps = int(np.ceil(PERIOD / float(jaxrod.stable_dt(scene, 0.9).dt)))
    shares = scene.rod.node_masses[None] / jnp.sum(scene.rod.node_masses)
    places = []
    for period in range(10):
        places.append(np.sum(shares * state.positions, axis=1))
        dt = PERIOD / steps
        state = jaxrod.advance(scene, state, dt, steps, first=period * steps)
    places.append(np.sum(shares * state.positions, axis=1))
    moved = np.diff(places, axis=0) / LENGTH
    # From period to period the same; theirs jitter by a thousandth.
    assert np.ptp(moved[3:], axis=0).max() < 1e-6
    speed = np.linalg.norm(np.mean(moved[3:], axis=0))
    record(
        "Speed of a snake on the ground, over PyElastica's",
        "PyElastica 1.0: 0.15923 lengths per period",
        abs(speed / PYELASTICA - 1),
        at_most=0.02,
    )
