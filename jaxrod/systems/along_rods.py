"""Shares of contact between places that are near to each other along rods.

A rod bent to a curvature of one over its radius just touches itself half a turn away:
nearer than pi times the radius along the rod nothing touches, and from an element's
length farther on all of it counts. Near nodes that are tied together the same holds,
counted along both rods. All arguments broadcast.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.systems.strands import Strands


def share_of_gap(gap: Array, radius: Array, length: Array) -> Array:
    """Share that counts of places on one rod with a gap between them [1].

    Args:
        gap: Rest arc length between them; negative where they overlap [m].
        radius: Of the rod [m].
        length: Over which the share rises [m].
    """
    return jnp.clip((gap - math.pi * radius) / length, 0, 1)


def from_node(starts: Array, ends: Array, place: Array) -> Array:
    """Rest arc length from stretches of a rod to a place on it [m]."""
    return jnp.maximum(jnp.maximum(starts - place, place - ends), 0)


def tied_share(
    along: tuple[Array, Array],
    concerned: Array,
    radii: tuple[Array, Array],
    length: Array,
) -> Array:
    """Share that counts near nodes that are tied together [1].

    Args:
        along: From the node on the one rod and from that on the other [m].
        concerned: Whether both are on the rods that are tied.
        radii: Of both [m].
        length: Over which the share rises [m].
    """
    reach = 0.5 * math.pi * (radii[0] + radii[1])
    share = jnp.clip((along[0] + along[1] - reach) / length, 0, 1)
    return jnp.where(concerned, share, 1)


def rod_and_place(strand: Strands, node: int) -> tuple[int, Array]:
    """Rod of a node of a member, and its rest arc length along it [m]."""
    return node // (strand.n_elements + 1), strand.node_places[node]
