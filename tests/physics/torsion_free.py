"""Rods without twist, for the tests of what they do and of what they go with."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from physics.rods import arm, perturb


def swinging(n=8, dtype=jnp.float64, end="base", sideways=0.0):
    """A tapered arm clamped at one end, loaded, and pushed sideways; scene, state."""
    rod, state = arm(n, dtype, radius=(0.05, 0.03), direction=(1.0, 0.0, 0.0))
    s = jnp.linspace(0, 1, n + 1, dtype=dtype)
    s = s if end == "base" else 1 - s
    velocities = jnp.zeros((3, n + 1), dtype).at[1].set(sideways * s**2)
    effects = (
        jaxrod.clamp(state, end),
        jaxrod.gravity((0.0, 0.0, -9.81)),
        jaxrod.exponential_damping(0.5, 3.0),
        jaxrod.end_load((0.0, 0.0, 4.0), end="tip" if end == "base" else "base"),
        jaxrod.uniform_load((1.0, 0.0, 2.0)),
    )
    scene = jaxrod.make_scene(rod, *effects, method=jaxrod.torsion_free())
    return scene, replace(state, velocities=velocities)


def with_twist(scene):
    return replace(scene, method=jaxrod.consistent())


def free(n=6, dtype=jnp.float64):
    """A free rod, bent and tumbling; every motion of its elements is there."""
    rod, state = arm(n, dtype)
    random = np.random.default_rng(3)
    moves = (0.01 * random.normal(size=(3, n + 1)), 0.2 * random.normal(size=(3, n)))
    state = perturb(state, tuple(jnp.asarray(m, dtype) for m in moves))
    velocities = jnp.asarray(random.normal(size=(3, n + 1)), dtype)
    momenta = jnp.asarray(1e-2 * random.normal(size=(3, n)), dtype)
    state = replace(state, velocities=velocities, angular_momenta=momenta)
    scene = jaxrod.make_scene(rod, method=jaxrod.torsion_free())
    # The state without the twist that a scene without twist does not see.
    integrator = scene.method.stepper(scene, state, jnp.asarray(1e-4, dtype))
    return scene, integrator.leave(integrator.enter(state))


def largest_gap(one, other):
    """Over all leaves of two states, each in units of the largest entry."""
    return max(
        float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b)))
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )
