r"""Accelerations of a state under the consistent law: $\dot v = f/m$, $\dot P = Rc$.

Forces and couples are all loads, damping included. Supports then give the components
that they hold the acceleration of the support.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    directors,
    multiply_quaternions,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import (
    LoadedRod,
    damping_rates,
    dissipate,
    dissipates,
    external_loads,
)
from jaxrod.rods.elasticity import elastic_law, internal_loads
from jaxrod.rods.motion import Loads, Motion


def total_loads(scene: LoadedRod, motion: Motion) -> Loads:
    """All loads under the consistent law, including the damping by decay rates.

    Returns:
        Forces on nodes (world frame) [N], couples on elements (material frame) [N m].
    """
    internal = internal_loads(elastic_law(scene.rod), motion)
    assert internal.forces is not None and internal.couples is not None
    total = external_loads(scene, motion, internal.forces, internal.couples)
    rates = damping_rates(scene)
    if rates is None:
        return total
    assert total.forces is not None and total.couples is not None
    slowing = vectors.scale(rates[0] * scene.rod.node_masses, motion.velocity)
    frame = directors(motion.orientation)
    braking = to_material(frame, vectors.scale(rates[1], motion.spin))
    return Loads(
        vectors.subtract(total.forces, slowing),
        vectors.subtract(total.couples, braking),
    )


def rates_of_change(scene: LoadedRod, motion: Motion) -> Motion:
    """Time derivative of a motion, in which spins are angular momenta.

    Damping by `Effect.dissipate` counts with its rate in an infinitesimal step. A
    filter that removes the same fraction in every step, however short, has no such
    rate.
    """
    # A barrier: without it XLA's CPU compiler fuses the loads with all that follows.
    total = lax.optimization_barrier(total_loads(scene, motion))
    assert total.forces is not None and total.couples is not None
    change = Motion(
        position=motion.velocity,
        orientation=_turning(motion.orientation, motion.angular_velocities(scene.rod)),
        velocity=vectors.scale(1 / scene.rod.node_masses, total.forces),
        spin=to_world(directors(motion.orientation), total.couples),
        remainder=jax.tree.map(jnp.zeros_like, motion.remainder),
    )
    if dissipates(scene):
        one = jnp.ones((), change.velocity[0].dtype)
        _, slowed = jax.jvp(lambda dt: dissipate(scene, motion, dt), (0 * one,), (one,))
        change = replace(
            change,
            velocity=vectors.add(change.velocity, slowed.velocity),
            spin=vectors.add(change.spin, slowed.spin),
        )
    for effect in scene.effects:
        change = effect.constrain_accelerations(scene.rod, motion, change)
    return change


def _turning(orientation: Quaternion, spin: Vec3) -> Quaternion:
    """Time derivative of quaternions, 1/2 (0, w) q, with w in the world frame."""
    half = vectors.scale(0.5, spin)
    return multiply_quaternions((jnp.zeros_like(half[0]), *half), orientation)
