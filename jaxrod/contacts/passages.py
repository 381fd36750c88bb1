r"""Points of a rod that went through a body between two states.

A point is taken to move in a straight line from $x_0$ to $x_1$, as the body sees it.
From either end of this way the nearest place is searched at which the body is reached,
by steps as long as the distance to it: no step leads past a surface, however thin the
body is. There the body has the normals $n_0$ and $n_1$. The point went through if it
enters at one place and leaves at the other, and the normals there are more than a
right angle apart,

$$(x_1 - x_0)\cdot n_0 < 0, \qquad (x_1 - x_0)\cdot n_1 > 0, \qquad n_0\cdot n_1 < 0.$$

So a rod that slides over an edge, or a little way around a post, did not go through.
The body counts as reached at half a radius from the centreline, where a rod in contact
never gets. So also a wire that is thinner than the rod is found.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3

REACHED = 0.5
"""Distance of the centreline at which a body is reached, divided by the radius [1]."""
_NEAR = 0.01
"""Distance at which the search for this place ends, divided by the radius [1]."""
_SEARCHES = 48
"""Steps of the search. Where a way and a surface meet at 30 degrees, each halves the
distance; ways that are more oblique hardly go through anything."""


def passages(
    surface: Callable[[Vec3], tuple[Array, Vec3]],
    radii: Float[Array, " points"],
    before: Vec3,
    after: Vec3,
) -> Float[Array, ""]:
    """Number of points whose straight ways lead through a body; see `passed`."""
    through = passed(surface, radii, before, after)
    return jnp.sum(through.astype(radii.dtype))


def passed(
    surface: Callable[[Vec3], tuple[Array, Vec3]],
    radii: Float[Array, " points"],
    before: Vec3,
    after: Vec3,
) -> Bool[Array, " points"]:
    """Whether the straight way of each point leads through a body.

    Args:
        surface: Signed distance [m] and outward normal of the body at points.
        radii: Radius of the rod at each point [m].
        before: Points at the earlier moment, as the body sees them [m].
        after: The same points at the later moment [m].
    """
    way = vectors.subtract(after, before)
    length = vectors.safe_norm(way)

    def gap(share: Array) -> tuple[Array, Vec3]:
        distance, normal = surface(vectors.add(before, vectors.scale(share, way)))
        return distance - REACHED * radii, normal

    def searched(_: int, shares: tuple[Array, Array]) -> tuple[Array, Array]:
        first, last = shares
        further = jnp.maximum(gap(first)[0], 0) / length
        nearer = jnp.maximum(gap(last)[0], 0) / length
        return jnp.minimum(first + further, 1), jnp.maximum(last - nearer, 0)

    none = jnp.zeros_like(length)
    first, last = lax.fori_loop(0, _SEARCHES, searched, (none, none + 1))
    (entry, inwards), (exit_, outwards) = gap(first), gap(last)
    near = _NEAR * radii
    return (
        (entry <= near)
        & (exit_ <= near)
        & (first <= last)
        & (vectors.dot(way, inwards) < 0)
        & (vectors.dot(way, outwards) > 0)
        & (vectors.dot(inwards, outwards) < 0)
    )
