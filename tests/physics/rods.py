"""Rods and states that several laws are tested on."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    join_quaternion,
    multiply_quaternions,
    rotation_exp,
    split_quaternion,
)
from jaxrod.loaded_rod import external_loads
from jaxrod.methods.laws import IN_SPACE
from jaxrod.rods.elasticity import elastic_law, internal_loads
from jaxrod.rods.motion import Motion

LENGTH, RADIUS, DENSITY, YOUNG = 1.0, 0.05, 1000.0, 1e7
SHEAR = YOUNG / 3
AREA = np.pi * RADIUS**2
SECOND_MOMENT = AREA**2 / (4 * np.pi)
BENDING = YOUNG * SECOND_MOMENT  # EI [N m^2]
SHEARING = 27 / 28 * SHEAR * AREA  # alpha_c G A [N]


def arm(n_elements=20, dtype=jnp.float64, **changes):
    """The benchmark arm: 1 m long, 5 cm in radius, 10 MPa, along z."""
    properties = {
        "length": LENGTH,
        "radius": RADIUS,
        "density": DENSITY,
        "youngs_modulus": YOUNG,
    }
    return jaxrod.straight_rod(n_elements, dtype=dtype, **properties | changes)


def turn(orientations, rotations):
    """Turns elements by rotation vectors in their material frames."""
    turned = multiply_quaternions(
        split_quaternion(orientations), rotation_exp(tuple(rotations))
    )
    return join_quaternion(turned)


def perturb(state, moves):
    """Moves nodes by `moves[0]` (3, n+1) and turns elements by `moves[1]` (3, n)."""
    displacements, rotations = moves
    return replace(
        state,
        positions=state.positions + displacements,
        orientations=turn(state.orientations, rotations),
    )


def no_moves(state):
    """The argument of `perturb` that changes nothing."""
    return jnp.zeros_like(state.positions), jnp.zeros_like(state.angular_momenta)


def loads(scene, state):
    """All loads on a rod: forces (3, n+1) [N] and material couples (3, n) [N m]."""
    motion = Motion(
        position=vectors.split(state.positions),
        orientation=split_quaternion(state.orientations),
        velocity=vectors.split(state.velocities),
        spin=vectors.split(state.angular_momenta),
    )
    internal = internal_loads(elastic_law(scene.rod), motion)
    total = external_loads(scene, motion, internal.forces, internal.couples)
    return vectors.join(total.forces), vectors.join(total.couples)


def random_rod(seed, n_elements=None, length=1.0):
    """A tapered, uneven, pre-curved rod with random properties, and its rest state."""
    random = np.random.default_rng(seed)
    n = int(random.integers(2, 30)) if n_elements is None else n_elements
    edges = random.normal(0.0, 0.3, (3, n)).cumsum(axis=1) / np.sqrt(n)
    edges += np.array([[0.0], [0.0], [1.0]])
    edges *= length / n * random.uniform(0.7, 1.3, n) / np.linalg.norm(edges, axis=0)
    nodes = np.concatenate([np.zeros((3, 1)), np.cumsum(edges, axis=1)], axis=1)
    radius = length * 10 ** random.uniform(-2.5, -1.0)
    taper = random.uniform(0.0, 0.6) * np.arange(n) / n
    return jaxrod.rod_along(
        nodes,
        # Of two elements two radii could be those of the ends: they are refused.
        radius=radius if n == 2 else radius * (1 - taper),
        density=random.uniform(800, 1200, n),
        youngs_modulus=10 ** random.uniform(5, 8) * random.uniform(0.8, 1.2, n),
        poisson_ratio=random.uniform(0.2, 0.5),
        dtype=jnp.float64,
    )


def deformed(rod, seed, largest_angle=1.0, largest_strain=0.2, speed=0.0):
    """A state with joints bent and twisted by up to an angle [rad], and moving."""
    random = np.random.default_rng(seed)
    n = rod.n_elements
    axes = random.normal(size=(3, n))
    angles = random.uniform(0.0, largest_angle, n)
    angles[n // 2] = largest_angle
    turns = axes / np.linalg.norm(axes, axis=0) * angles
    orientations = [jnp.array([1.0, 0.0, 0.0, 0.0])]
    for one in turns.T:
        orientations.append(turn(orientations[-1][:, None], one[:, None])[:, 0])
    orientations = jnp.stack(orientations[1:], axis=1)
    still = jaxrod.RodState(
        positions=jnp.zeros((3, n + 1)),
        orientations=orientations,
        velocities=speed * random.normal(size=(3, n + 1)),
        angular_momenta=jnp.zeros((3, n)),
    )
    strains = random.uniform(-largest_strain, largest_strain, (3, n))
    strains += np.array([[0.0], [0.0], [1.0]])
    edges = np.einsum("ijk,ik->jk", still.directors, strains)
    edges = edges * np.asarray(rod.rest_lengths)
    nodes = jnp.concatenate([jnp.zeros((3, 1)), jnp.cumsum(edges, axis=1)], axis=1)
    moving = replace(still, positions=nodes)
    spins = 10 * speed * random.normal(size=(3, n))
    return jaxrod.with_angular_velocities(rod, moving, jnp.asarray(spins))


def mixed_load(scene_rod, mode="consistent", state=None):
    """A scene with one of every effect: clamp, gravity, loads, couples, damping."""
    n = scene_rod.n_elements
    held = jaxrod.clamp if mode == "consistent" else jaxrod.fixed_end
    wave = np.sin(np.arange(3 * n).reshape(3, n))
    return jaxrod.make_scene(
        scene_rod,
        jaxrod.gravity((1.0, -2.0, -9.0)),
        jaxrod.end_load((3.0, 5.0, -2.0), (1.0, -2.0, 0.5)),
        jaxrod.uniform_load((2.0, 0.0, 1.0), (0.5, 1.0, -1.0)),
        jaxrod.actuation.ElementCouples(jnp.asarray(wave)),
        held(state),
        jaxrod.exponential_damping(0.7, 1.9),
        method=IN_SPACE[mode],
    )


def largest(tree):
    """The largest absolute value in a pytree."""
    return max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(tree))


def difference(a, b):
    """The largest absolute difference between two pytrees of equal structure."""
    return largest(jax.tree.map(jnp.subtract, a, b))
