"""Degrees of freedom: free components of positions and rates in a scene.

Fields of a rod are stacked as blocks of a chain: a node and the element that follows
it. A component is held if `Effect.constrain_rates` gives it the same rate whatever its
rate before, or if `Effect.constrain` gives it the same value whatever its value before.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import Quaternion, multiply_quaternions
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod, constrain, free_velocity_mask
from jaxrod.rods.motion import Motion

_TURN = (0.8, 0.36, 0.48, 0.0)
"""Rotation by 74 degrees, applied to an element to find out whether it is held."""


def degrees_of_freedom(scene: LoadedRod, motion: Motion) -> tuple[Vec3, Vec3]:
    """Flags of all components: 1 if free, 0 if held.

    Args:
        scene: The scene.
        motion: Configuration of the rod.

    Returns:
        Flags of the nodes, for the components of velocity, and of the elements, for the
        components of spin (world frame).
    """
    nodes, elements = free_velocity_mask(scene, motion)
    placed = free_position_mask(scene, motion)
    if placed is None:
        return nodes, elements
    return vectors.multiply(nodes, placed[0]), vectors.multiply(elements, placed[1])


def free_position_mask(scene: LoadedRod, motion: Motion) -> tuple[Vec3, Vec3] | None:
    """Flags of positions and orientations: 1 if free under `constrain`, 0 if held.

    Returns `None` if no effect constrains positions or orientations.
    """
    here = constrain(scene, motion)
    if here is motion:
        return None
    there = constrain(scene, _elsewhere(scene, motion))
    x, y, z = (
        (a != b).astype(a.dtype)
        for a, b in zip(here.position, there.position, strict=True)
    )
    turns = _differ(here.orientation, there.orientation)
    return (x, y, z), (turns, turns, turns)


def _elsewhere(scene: LoadedRod, motion: Motion) -> Motion:
    """Motion with every node displaced along all axes and every element rotated.

    Components to which `constrain` gives the same value in both motions are held.
    """
    length = scene.rod.length
    moved = vectors.add(motion.position, (length, length, length))
    turn = tuple(jnp.full_like(motion.orientation[0], part) for part in _TURN)
    w, x, y, z = turn
    turned = multiply_quaternions(motion.orientation, (w, x, y, z))
    return replace(motion, position=moved, orientation=turned)


def _differ(one: Quaternion, other: Quaternion) -> Array:
    """Flags of quaternions: 1 where any of their components differ, else 0."""
    differs = one[0] != other[0]
    for a, b in zip(one[1:], other[1:], strict=True):
        differs |= a != b
    return differs.astype(one[0].dtype)


def stack_dofs(nodes: Vec3, elements: Vec3) -> Float[Array, "n+1 6"]:
    """Stacks the components of each node and of the element after it into a row.

    The last node has no element after it: zeros take its place.
    """
    padded = [vectors.pad(entry, 0, 1) for entry in elements]
    return jnp.stack([*nodes, *padded], axis=-1)


def unstack_dofs(step: Float[Array, "n+1 6"]) -> tuple[Vec3, Vec3]:
    """Fields of nodes and of elements from the rows that `stack_dofs` makes."""
    return (
        (step[:, 0], step[:, 1], step[:, 2]),
        (step[:-1, 3], step[:-1, 4], step[:-1, 5]),
    )
