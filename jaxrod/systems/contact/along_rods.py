"""Shares of contact between places that are near to each other along rods.

A rod bent to a curvature of one over its radius just touches itself half a turn away.
So places nearer than pi times the radius along the rod do not touch. From there the
share of contact rises, and is one an element's length farther on. The same holds near
nodes that are tied together, with the distance measured along both rods. All arguments
broadcast.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.systems.contact.strands import Strands


def share_of_gap(gap: Array, radius: Array, length: Array) -> Array:
    """Share of contact of places on one rod with a gap between them [1].

    Args:
        gap: Rest arc length between the places; negative where they overlap [m].
        radius: Radius of the rod [m].
        length: Length over which the share rises [m].
    """
    return jnp.clip((gap - math.pi * radius) / length, 0, 1)


def from_node(starts: Array, ends: Array, place: Array) -> Array:
    """Rest arc length from intervals of a rod to a place on it; zero inside [m]."""
    return jnp.maximum(jnp.maximum(starts - place, place - ends), 0)


def tied_share(
    along: tuple[Array, Array],
    concerned: Array,
    radii: tuple[Array, Array],
    length: Array,
) -> Array:
    """Share of contact near nodes that are tied together [1].

    Args:
        along: Rest arc lengths from the tied node on the first rod and on the second
            [m].
        concerned: Whether both places are on the tied rods.
        radii: Radii of both [m].
        length: Length over which the share rises [m].
    """
    reach = 0.5 * math.pi * (radii[0] + radii[1])
    share = jnp.clip((along[0] + along[1] - reach) / length, 0, 1)
    return jnp.where(concerned, share, 1)


def rod_and_place(strand: Strands, node: int) -> tuple[int, Array]:
    """Number of the rod of a node, and the node's rest arc length along it [m]."""
    return node // (strand.n_elements + 1), strand.node_places[node]
