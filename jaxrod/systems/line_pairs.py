"""The line law on pairs of elements: points of the first against the second segment.

`jaxrod.systems.near_segments` has the same law for rows of all points. Here each
element of a pair has its own points along a leading axis, `(points, pairs)`. The next
node is one more point, which counts only at the end of a rod.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.structure import pytree
from jaxrod.systems.element_pairs import Elements


@pytree
class ElementPoints:
    """Contact points of the elements of pairs."""

    fractions: Array
    """Places of the points on their element, over its length [1]."""
    lengths: Array
    """Rest length that each point stands for [m]."""
    radii: Array
    """Radius at each point [m]."""
    places: Array
    """Rest arc length of each point along its rod [m]."""


def points_on(own: Elements, per_element: int) -> ElementPoints:
    """Contact points of elements that have a leading axis of length one for points."""
    assert own.first_radii is not None and own.first_lengths is not None
    assert own.starts is not None and own.rest_lengths is not None
    assert own.last is not None
    counts = np.arange(per_element + 1).reshape(-1, *[1] * (own.radii.ndim - 1))
    fractions = jnp.asarray(counts / per_element, own.radii.dtype)
    spacing = own.rest_lengths / per_element
    at_end = 0.5 * own.last * spacing
    within = jnp.where(counts == per_element, at_end, spacing)
    return ElementPoints(
        fractions=fractions,
        lengths=jnp.where(counts == 0, own.first_lengths, within),
        radii=jnp.where(counts == 0, own.first_radii, own.radii),
        places=own.starts + fractions * own.rest_lengths,
    )
