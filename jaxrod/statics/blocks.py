"""Fields of a rod as blocks of a chain: a node and the element that follows it."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3


def blocks(nodes: Vec3, elements: Vec3) -> Float[Array, "n+1 6"]:
    """Node and element fields side by side; the last node has zeros for an element."""
    padded = [vectors.pad(entry, 0, 1) for entry in elements]
    return jnp.stack([*nodes, *padded], axis=-1)


def unblocked(step: Float[Array, "n+1 6"]) -> tuple[Vec3, Vec3]:
    """Node and element fields of an array of blocks."""
    return (
        (step[:, 0], step[:, 1], step[:, 2]),
        (step[:-1, 3], step[:-1, 4], step[:-1, 5]),
    )
