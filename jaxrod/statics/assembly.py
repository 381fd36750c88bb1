"""Tangent of a whole rod, assembled from those of its elements and joints."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry.matrices import Matrix, add, scaled_identity, skew, stacked
from jaxrod.rods.elastic_tangents import ElementTangent, JointTangent
from jaxrod.statics.block_tridiagonal import BlockTridiagonal


def assembled(
    element: ElementTangent, joint: JointTangent, masses: Array, turning: Matrix
) -> BlockTridiagonal:
    """Matrix of the whole rod.

    Block `k` is node `k` (its displacement) and element `k` (its rotation); the last
    node has no element, and zeros in its place.

    Args:
        element: Tangents of the elements.
        joint: Tangents of the joints.
        masses: Terms to add on the diagonal of the nodes, `(n + 1,)`.
        turning: Matrices to add to the elements' diagonal blocks.
    """
    bend = stacked(joint.stiffness)
    carried = bend - stacked(skew(joint.couple))
    stretch, couple = stacked(element.stretching), stacked(element.coupling)
    own = stacked(add(element.turning, turning))
    own = _placed(own, 0, 1) + _placed(bend, 0, 2) + _placed(carried, 1, 1)
    before, after = _placed(stretch, 1, 0), _placed(stretch, 0, 1)
    nodes = before + after + stacked(scaled_identity(masses))
    couple_after, none = _placed(couple, 0, 1), jnp.zeros_like(nodes)
    couple_transposed = jnp.swapaxes(couple_after, 1, 2)
    return BlockTridiagonal(
        lower=_quarters(-before, _placed(couple, 1, 0), none, _placed(-bend, 1, 1)),
        diagonal=_quarters(nodes, -couple_after, -couple_transposed, own),
        upper=_quarters(-after, none, couple_transposed, _placed(-carried, 0, 2)),
    )


def _placed(blocks: Array, before: int, after: int) -> Array:
    """Blocks padded with zeros at the ends of the chain."""
    return jnp.pad(blocks, ((before, after), (0, 0), (0, 0)))


def _quarters(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Blocks of 6 by 6 from their quarters."""
    return jnp.concatenate(
        [jnp.concatenate([a, b], axis=2), jnp.concatenate([c, d], axis=2)], axis=1
    )
