"""Tangent stiffness of effects: derivatives of loads with respect to configuration.

An effect may have it in closed form (`Effect.turning_tangent`). Any other effect is
differentiated. If its loads depend on neighbours only (`Effect.reach`), every third
node and element is perturbed together (colouring), for second neighbours every fifth.
Otherwise each is perturbed by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect, Reach
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix, add
from jaxrod.geometry.rotations import directors, multiply_quaternions, to_world
from jaxrod.loaded_rod import LoadedRod, external_loads
from jaxrod.rods.motion import Loads, Motion
from jaxrod.statics.block_matrices import (
    BlockTridiagonal,
    Dense,
    PairedBlocks,
    as_dense,
    in_pairs,
    matrix_of,
    of_five_bands,
)
from jaxrod.statics.degrees_of_freedom import stack_dofs, unstack_dofs

Tangent = BlockTridiagonal | PairedBlocks | Dense
"""Tangent stiffness of a rod: block-tridiagonal; in pairs of blocks if effects couple
second neighbours; dense if they couple distant parts."""


Matrices = TypeVar("Matrices", BlockTridiagonal, PairedBlocks, Dense)


def has_closed_form(effect: Effect) -> bool:
    """Whether an effect has no loads, or has their derivative as `turning_tangent`."""
    kind = type(effect)
    knows = kind.turning_tangent is not Effect.turning_tangent
    return knows or kind.loads is Effect.loads


def reaches_any(scene: LoadedRod) -> bool:
    """Whether effects couple distant parts of the rod, so that its tangent is dense."""
    return any(
        not has_closed_form(effect) and effect.actual_reach == "any"
        for effect in scene.effects
    )


def with_turning_tangents(turning: Matrix, scene: LoadedRod, motion: Motion) -> Matrix:
    """Adds the `turning_tangent` of all effects to `turning` [N m].

    Both are derivatives of the residual couple on each element with respect to its
    rotation.
    """
    for effect in scene.effects:
        if type(effect).turning_tangent is not Effect.turning_tangent:
            own = effect.turning_tangent(scene.rod, motion)
            turning = turning if own is None else add(turning, own)
    return turning


def with_differentiated(
    chain: BlockTridiagonal,
    scene: LoadedRod,
    motion: Motion,
    pace: Array,
    momentum: Matrix,
    free: Float[Array, "n+1 6"],
) -> Tangent:
    """Tangent that includes effects without a closed form, differentiated by JAX.

    Args:
        chain: Tangent without them.
        scene: The scene.
        motion: Configuration of the rod.
        pace: Velocities per displacement [1/s].
        momentum: Derivative of the angular momenta with respect to the rotations
            [kg m^2/s].
        free: Flags of the components: 1 if free, 0 if held by the scene.
    """
    others = tuple(effect for effect in scene.effects if not has_closed_form(effect))
    ranges: tuple[Reach, ...] = ("neighbours", "second neighbours", "any")
    near, second, far = (
        tuple(effect for effect in others if effect.actual_reach == reach)
        for reach in ranges
    )
    # Without a barrier XLA fuses it 18 times with the computation of the motion and
    # compiles for minutes.
    barrier = lax.optimization_barrier

    def push_of(effects: tuple[Effect, ...]) -> Callable[[Array], Array]:
        there, inertia = jax.tree.map(barrier, (motion, momentum))
        push = change_of_loads(replace(scene, effects=effects), there, pace, inertia)
        return lambda step: free * push(free * step)

    def without(matrix: Matrices, part: Matrices) -> Matrices:
        found: Matrices = jax.tree.map(
            jnp.subtract, matrix, jax.tree.map(barrier, part)
        )
        return found

    if second and not far:
        bands = bands_by_colouring(push_of((*near, *second)), free, 2)
        return without(in_pairs(chain), of_five_bands(bands, spare=0.0))
    if near:
        bands = bands_by_colouring(push_of(near), free, 1)
        chain = without(chain, BlockTridiagonal(*bands))
    if not far:
        return chain
    return without(as_dense(chain), matrix_of(push_of((*second, *far)), free))


def change_of_loads(
    scene: LoadedRod, motion: Motion, pace: Array, momentum: Matrix
) -> Callable[[Float[Array, "n+1 6"]], Float[Array, "n+1 6"]]:
    """Linear map from a step to the change of the loads of all effects, world frame.

    A step displaces nodes and rotates elements. Velocities then change by `pace` times
    the displacements, angular momenta by `momentum` times the rotations.
    """
    none = Loads(*jax.tree.map(jnp.zeros_like, (motion.position, motion.spin)))
    _, push = jax.linearize(lambda there: total_loads(scene, there, none), motion)

    def change(step: Array) -> Array:
        displacement, turn = unstack_dofs(step)
        half = vectors.scale(0.5, turn)
        still = jnp.zeros_like(half[0])
        turned = multiply_quaternions((still, *half), motion.orientation)
        x, y, z = (vectors.dot(row, turn) for row in momentum)
        return push(
            replace(
                jax.tree.map(jnp.zeros_like, motion),
                position=displacement,
                orientation=turned,
                velocity=vectors.scale(pace, displacement),
                spin=(x, y, z),
            )
        )

    return change


def total_loads(
    scene: LoadedRod, motion: Motion, others: Loads
) -> Float[Array, "n+1 6"]:
    """Loads `others` plus those of all effects; rows of force and couple (world)."""
    assert others.forces is not None and others.couples is not None
    loads = external_loads(scene, motion, others.forces, others.couples)
    # Without barriers XLA's CPU compiler takes minutes over the derivative. There is
    # one barrier per array, so that reverse mode leaves out loads that do not depend on
    # the differentiated variables.
    loads = jax.tree.map(lax.optimization_barrier, loads)
    assert loads.forces is not None and loads.couples is not None
    return stack_dofs(
        loads.forces, to_world(directors(motion.orientation), loads.couples)
    )


def bands_by_colouring(
    push: Callable[[Float[Array, "n m"]], Float[Array, "n m"]],
    like: Float[Array, "n m"],
    reach: int,
) -> tuple[Float[Array, "n m m"], ...]:
    """Bands of the matrix of a linear function with a short reach, by colouring.

    Every third block is perturbed together, or every fifth for two neighbours on either
    side, so `(2 reach + 1) m` evaluations are enough.

    Args:
        push: The linear function.
        like: An array like its argument, `n` blocks of size `m`.
        reach: Number of neighbours on either side on which a block depends.

    Returns:
        Blocks of each row, from the farthest neighbour before it to the farthest after.
    """
    n, m = like.shape
    colours = 2 * reach + 1
    colour = jnp.arange(n) % colours
    moved = colour[None, None, :, None] == jnp.arange(colours)[:, None, None, None]
    seeds = moved & jnp.eye(m, dtype=bool)[None, :, None, :]
    answers = jax.vmap(jax.vmap(push))(seeds.astype(like.dtype))
    # Axes: colour moved, block loaded, component loaded, component moved.
    columns = jnp.moveaxis(answers, 1, 3)

    def answers_to(shift: int) -> Array:
        mover = (colour[:, None, None] + shift) % colours
        answer = columns[0]
        for k in range(1, colours):
            answer = jnp.where(mover == k, columns[k], answer)
        return answer

    return tuple(answers_to(shift) for shift in range(-reach, reach + 1))
