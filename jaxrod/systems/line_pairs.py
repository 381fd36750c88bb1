"""The line law on pairs of elements: points of the one against the other segment.

As `jaxrod.systems.near_segments` has it for rows of all points: here each element has
its own points along the axis before the pairs, `(points, others, own)`, the next node
being one more that counts only at the end of a rod.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.structure import pytree
from jaxrod.systems.strands import Strands


@pytree
class ElementPoints:
    """Contact points of elements, `(points, 1, elements)`."""

    fractions: Array
    """Where they are on their element [1]."""
    lengths: Array
    """Rest length that each stands for [m]."""
    radii: Array
    """Radius at each [m]."""
    places: Array
    """Rest arc length of each along its rod [m]."""


def element_points(strand: Strands) -> ElementPoints:
    """The points of a member's elements."""
    per, dtype = strand.per_element, strand.lengths.dtype
    fractions = jnp.asarray(np.arange(per + 1) / per, dtype)[:, None, None]
    at_end = jnp.asarray(strand.is_last, dtype)

    def of(row: Array) -> Array:
        rods = row.reshape(strand.count, -1)
        within = rods[:, :-1].reshape(-1, per).T
        following = rods[:, per::per].reshape(1, -1)
        return jnp.concatenate([within, following])[:, None, :]

    lengths = of(strand.lengths)
    counts = jnp.concatenate([jnp.ones((per, *at_end.shape), dtype), at_end[None]])
    return ElementPoints(
        fractions=fractions,
        lengths=lengths * counts[:, None, :],
        radii=of(strand.point_radii),
        places=of(strand.places),
    )
