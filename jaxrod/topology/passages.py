r"""Passages of curves through each other between two moments.

Nodes are assumed to move in straight lines between the moments. The vector from a point
of one segment to a point of another is then a map of a cube, whose coordinates are the
positions along both segments and time. Segments pass through each other where the
vector is zero. The signed number of passages is the solid angle of the image of the
cube's surface, divided by that of a sphere. It is an integer for motions of any size.
The sum over all pairs is the jump of the Gauss integral.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod.geometry.vectors import Vec3, dot, split, subtract
from jaxrod.topology.curves import Curve, nodes_of, quadrilateral, unit


def crossings(
    before: Curve,
    after: Curve,
    other_before: Curve | None = None,
    other_after: Curve | None = None,
) -> Float[Array, "n m"]:
    """Passages of each element of a curve through elements of another curve or itself.

    They are signed: +1 where the Gauss integral grows, and half of that where elements
    touch at one of the two moments. Between the moments nodes move in straight lines:
    compare states between which no element rotates by more than a right angle. Elements
    that share a node do not count. For a rollout, use `jax.vmap` over pairs of
    consecutive states.

    Args:
        before: First curve at the first moment: a state, or nodes `(3, n + 1)` [m].
        after: First curve at the second moment.
        other_before: Second curve at the first moment, with `m + 1` nodes; by default
            the first curve.
        other_after: Second curve at the second moment.

    Returns:
        Counts per pair of elements `(n, m)`; for a curve with itself every pair occurs
        twice.

    Raises:
        ValueError: If numbers of nodes do not agree, or only one of `other_before` and
            `other_after` is given.

    Example:
        >>> other = jnp.array([[-1.0, 1.0], [0.0, 0.0], [0.0, 0.0]])  # along x
        >>> above = jnp.array([[0.0, 0.0], [-1.0, 1.0], [0.1, 0.1]])  # along y
        >>> below = jnp.array([[0.0, 0.0], [-1.0, 1.0], [-0.1, -0.1]])
        >>> passages = topology.crossings(above, below, other, other)
        >>> passages.shape, round(float(passages[0, 0]), 3)
        ((1, 1), 1.0)
    """
    if (other_before is None) != (other_after is None):
        raise ValueError("other_before and other_after must be given together")
    one = _moving("before", before, "after", after)
    if other_before is None or other_after is None:
        two = one
    else:
        two = _moving("other_before", other_before, "other_after", other_after)
    corners = [[split(x[:, k : x.shape[1] - 1 + k]) for x in two] for k in (0, 1)]
    span = jnp.max(jnp.abs(two[0][:, 1:] - two[0][:, :-1]))
    same = jnp.finfo(span.dtype).eps * span * span

    def seen_from(segment: tuple[Array, Array, Array, Array]) -> Array:
        places = split(segment[0]), split(segment[1])
        places_later = split(segment[2]), split(segment[3])
        # Indices: end of the first segment, end of the second, moment.
        vector = {
            (s, u, t): subtract(corners[u][t], (places, places_later)[t][s])
            for s in (0, 1)
            for u in (0, 1)
            for t in (0, 1)
        }
        joined = jnp.zeros(vector[0, 0, 0][0].shape, bool)
        for s in (0, 1):
            for u in (0, 1):
                pair = vector[s, u, 0], vector[s, u, 1]
                joined |= (dot(pair[0], pair[0]) < same) & (
                    dot(pair[1], pair[1]) < same
                )
        return jnp.where(joined, 0, _winding({k: unit(v) for k, v in vector.items()}))

    # First and next nodes of the elements at the first moment, then at the second.
    rows = [x[:, k : x.shape[1] - 1 + k].T for x in one for k in (0, 1)]
    return lax.map(seen_from, (rows[0], rows[1], rows[2], rows[3]))


def crossed(
    before: Curve,
    after: Curve,
    other_before: Curve | None = None,
    other_after: Curve | None = None,
) -> Bool[Array, ""]:
    """Whether a curve passed through itself, or another, between two moments.

    Arguments are those of `crossings`, which returns counts per pair of elements.

    Raises:
        ValueError: If numbers of nodes do not agree, or only one of `other_before` and
            `other_after` is given.

    Example:
        >>> other = jnp.array([[-1.0, 1.0], [0.0, 0.0], [0.0, 0.0]])  # along x
        >>> above = jnp.array([[0.0, 0.0], [-1.0, 1.0], [0.1, 0.1]])  # along y
        >>> below = jnp.array([[0.0, 0.0], [-1.0, 1.0], [-0.1, -0.1]])
        >>> bool(topology.crossed(above, below, other, other))
        True
        >>> bool(topology.crossed(above, above, other, other))
        False
    """
    counts = crossings(before, after, other_before, other_after)
    return jnp.any(jnp.abs(counts) > 0.25)


def _moving(
    name: str, before: Curve, name_after: str, after: Curve
) -> tuple[Array, Array]:
    """Nodes of one curve at the first and at the second moment [m].

    Raises a ValueError if their numbers differ; `name` and `name_after` are for its
    message.
    """
    first, last = nodes_of(name, before), nodes_of(name_after, after)
    if first.shape != last.shape:
        raise ValueError(
            f"{name_after} must have as many nodes as {name}, {first.shape[1]}, got "
            f"{last.shape[1]}"
        )
    return first, last


def _winding(d: dict[tuple[int, int, int], Vec3]) -> Array:
    """Solid angle of a cube's surface seen from the origin, divided by 4 pi [1].

    The arguments are unit vectors to its corners, with indices 0 or 1 along each edge.
    Opposite faces are cut along the same diagonal, so that a point on a face belongs to
    one of the two cubes that share it.
    """
    total = jnp.zeros_like(d[0, 0, 0][0])
    for k in (0, 1):
        sign = 2 * k - 1
        total += sign * (
            quadrilateral(d[0, 0, k], d[1, 0, k], d[1, 1, k], d[0, 1, k])
            + quadrilateral(d[k, 0, 0], d[k, 1, 0], d[k, 1, 1], d[k, 0, 1])
            + quadrilateral(d[0, k, 0], d[0, k, 1], d[1, k, 1], d[1, k, 0])
        )
    return total / (4 * jnp.pi)
