"""How the loads of effects change with the configuration: their part of the tangent.

Constant loads have none. Effects that turn with an element or join it to a wall have
theirs in closed form; any other is differentiated, whatever it does.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import vectors
from jaxrod.actuation import ElementCouples
from jaxrod.block_tridiagonal import BlockTridiagonal
from jaxrod.clamps import Clamp
from jaxrod.effects import Effect, EndLoad, Gravity, UniformLoad
from jaxrod.ends import End
from jaxrod.motion import Motion
from jaxrod.rod import Rod
from jaxrod.rotations import (
    Quaternion,
    conjugate,
    directors,
    multiply_quaternions,
    rotation_log_and_coupling,
    split_quaternion,
    to_world,
)
from jaxrod.tangents import Matrix, skew, subtract, turned_joint
from jaxrod.vectors import Vec3

CLOSED_FORMS: tuple[type[Effect], ...] = (
    Clamp,
    ElementCouples,
    EndLoad,
    Gravity,
    UniformLoad,
)


def has_closed_form(effect: Effect) -> bool:
    """Whether `turning_tangent` knows all there is; subclasses may do anything."""
    return type(effect) in CLOSED_FORMS or type(effect).loads is Effect.loads


def turning_tangent(effect: Effect, rod: Rod, motion: Motion) -> Matrix | None:
    """Derivative of minus the couples (world frame) by the elements' own turns.

    For effects of a closed form, which have no other derivative; `None` for zero.
    """
    if isinstance(effect, ElementCouples):
        couples = vectors.split(effect.couples)
        return skew(to_world(directors(motion.orientation), couples))
    if isinstance(effect, EndLoad) and effect.follower:
        frame = directors(_at_end(motion.orientation, effect.end))
        couple = to_world(frame, vectors.split(effect.couple))
        return _placed(skew(couple), rod.n_elements, effect.end)
    if isinstance(effect, Clamp):
        return _placed(_wall_tangent(effect, rod, motion), rod.n_elements, effect.end)
    return None


def _wall_tangent(wall: Clamp, rod: Rod, motion: Motion) -> Matrix:
    """Of the joint between the wall and the end element."""
    index = 0 if wall.end == "start" else -1
    orientation = _at_end(motion.orientation, wall.end)
    rotation, coupling = rotation_log_and_coupling(
        multiply_quaternions(conjugate(split_quaternion(wall.orientation)), orientation)
    )
    stiffness = vectors.split(
        rod.bend_twist_stiffness[:, index] / (0.5 * rod.rest_lengths[index])
    )
    moment = vectors.multiply(stiffness, rotation)
    joint = turned_joint(orientation, rotation, coupling, stiffness, moment)
    return subtract(joint.stiffness, skew(joint.couple))


def coloured(
    push: Callable[[Float[Array, "n m"]], Float[Array, "n m"]],
    like: Float[Array, "n m"],
) -> BlockTridiagonal:
    """The matrix of a linear function whose blocks see no further than neighbours.

    Then every third block can be moved at once: `3 m` directions, whatever the number
    of blocks.
    """
    n, m = like.shape
    colour = jnp.arange(n) % 3
    moved = colour[None, None, :, None] == jnp.arange(3)[:, None, None, None]
    seeds = moved & jnp.eye(m, dtype=bool)[None, :, None, :]
    answers = jax.vmap(jax.vmap(push))(seeds.astype(like.dtype))
    # Axes: colour moved, block loaded, component loaded, component moved.
    columns = jnp.moveaxis(answers, 1, 3)

    def answers_to(shift: int) -> Array:
        mover = (colour[:, None, None] + shift) % 3
        answer = jnp.where(mover == 0, columns[0], columns[1])
        return jnp.where(mover == 2, columns[2], answer)

    return BlockTridiagonal(answers_to(-1), answers_to(0), answers_to(1))


def _at_end(field: Quaternion, end: End) -> Quaternion:
    index = 0 if end == "start" else -1
    w, x, y, z = (component[index] for component in field)
    return w, x, y, z


def _placed(matrix: Matrix, size: int, end: End) -> Matrix:
    """A field that is zero but for one end."""
    before, after = (0, size - 1) if end == "start" else (size - 1, 0)

    def one(row: Vec3) -> Vec3:
        x, y, z = (vectors.pad(entry[None], before, after) for entry in row)
        return x, y, z

    return one(matrix[0]), one(matrix[1]), one(matrix[2])
