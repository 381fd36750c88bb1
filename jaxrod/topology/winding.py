r"""Twist and link of a ribbon, writhe of a curve, linking number of two curves.

The Gauss integral of two curves is a sum over pairs of their segments, of the signed
solid angle $\Omega_{ij}$ under which segment j is seen from all points of segment i:

$$\mathrm{Lk} = \frac1{4\pi}\sum_{i,j}\Omega_{ij}, \qquad
  \mathrm{Wr} = \frac1{4\pi}\sum_{i \ne j}\Omega_{ij},$$

exact for polygons (Klenin and Langowski, Biopolymers 54, 2000). For a closed ribbon
$\mathrm{Lk} = \mathrm{Tw} + \mathrm{Wr}$.

The twist is the angle by which the normals of a ribbon turn about its centreline. From
each element to the next the normal $u$ is carried without twist, by the smallest
rotation that takes the tangent $t$ to the next one $t'$,

$$\tilde u = u - \frac{u\cdot t'}{1 + t\cdot t'}\,(t + t'), \qquad
  \mathrm{Tw} = \frac1{2\pi}\sum \mathrm{atan2}\big(t'\cdot(\tilde u\times u'),\
  \tilde u\cdot u'\big).$$

The angles are those of Klenin and Langowski's method 2a, without their special case for
collinear elements.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod.geometry.vectors import (
    Vec3,
    add,
    cross,
    dot,
    inner_difference,
    scale,
    split,
    subtract,
)
from jaxrod.topology.curves import (
    ROUNDING,
    Curve,
    Ends,
    across,
    check_ends,
    completed,
    element_lengths,
    end_directions,
    nodes_of,
    normals_of,
    quadrilateral,
    seamless,
    unit,
)
from jaxrod.validation import Numbers, as_array


def twist(
    curve: Curve, normals: Numbers | None = None, *, ends: Ends = "open"
) -> Float[Array, ""]:
    """Twist of a ribbon in whole turns, right-handed positive [1].

    For a closed ribbon (`ends="joined"`) it is `link` minus `writhe`, as long as no
    joint is twisted by half a turn. For several frames, use `jax.vmap`.

    Args:
        curve: A state, or nodes `(3, n + 1)` [m].
        normals: Normals `(3, n)` of the elements; by default d1 of the state. Only
            their components perpendicular to the elements count, because d1 of a
            sheared rod is not perpendicular.
        ends: "open" or "joined".

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> turn = jnp.linspace(0.0, jnp.pi, 10)  # half a turn along the rod
        >>> normals = jnp.stack([0 * turn, jnp.cos(turn), jnp.sin(turn)])
        >>> round(float(topology.twist(state, normals)), 3)
        0.5
        >>> round(float(topology.twist(state)), 3)
        0.0
    """
    check_ends(ends, ("open", "joined"))
    nodes = nodes_of("curve", curve)
    if ends == "joined":
        nodes = seamless(nodes)
    tangents = unit(inner_difference(split(nodes)))
    sides = across(split(normals_of(curve, normals)), tangents)
    before, after = _inner(sides, slice(None, -1)), _inner(sides, slice(1, None))
    t, following = _inner(tangents, slice(None, -1)), _inner(tangents, slice(1, None))
    total = jnp.sum(_angle(_carried(before, t, following), after, following))
    if ends == "joined":
        u, v = _inner(sides, slice(-1, None)), _inner(sides, slice(0, 1))
        last, first = _inner(tangents, slice(-1, None)), _inner(tangents, slice(0, 1))
        gap = unit(split(nodes[:, :1] - nodes[:, -1:]))
        # Without a gap the direction of the bridge is that of the last element.
        bridge = subtract(gap, scale(dot(gap, gap) - 1, last))
        u = _carried(_carried(u, last, bridge), bridge, first)
        total = total + _angle(u, v, first)[0]
    return total / (2 * jnp.pi)


def _inner(a: Vec3, part: slice) -> Vec3:
    return a[0][part], a[1][part], a[2][part]


def _carried(u: Vec3, start: Vec3, end: Vec3) -> Vec3:
    """Normal vectors after the smallest rotation that takes `start` to `end`."""
    versed = 1 + dot(start, end)
    folded = versed < ROUNDING * jnp.finfo(versed.dtype).eps
    share = jnp.where(folded, 0, dot(u, end) / jnp.where(folded, 1, versed))
    return subtract(u, scale(share, add(start, end)))


def _angle(u: Vec3, v: Vec3, axis: Vec3) -> Array:
    """Signed angle from the normal u to the normal v about an axis [rad]."""
    sine, cosine = dot(axis, cross(u, v)), dot(u, v)
    nowhere = sine * sine + cosine * cosine == 0
    return jnp.arctan2(sine, jnp.where(nowhere, 1, cosine))


def writhe(
    curve: Curve, *, ends: Ends = "open", extension: Numbers | None = None
) -> Float[Array, ""]:
    """Writhe of a curve: its signed crossings, averaged over all directions of view.

    It has no unit. It is 0 for a curve in a plane, and changes by 2 when the curve
    passes through itself. For several frames, use `jax.vmap`.

    Args:
        curve: A state, or nodes `(3, n + 1)` [m].
        ends: "open"; "joined" for a closed curve, whether its last node repeats the
            first or is one element before it; "next_tangent", "end_to_end" or
            "net_tangent" to lengthen an open curve at both ends, as PyElastica does.
        extension: Length added at each end [m]; by default the length of the curve.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> angle = jnp.linspace(0.0, 4 * jnp.pi, 41)
        >>> coil = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.1 * angle])
        >>> round(float(topology.writhe(coil)), 2)
        0.7
        >>> round(float(topology.writhe(state)), 3)  # a straight rod
        0.0
    """
    check_ends(ends)
    nodes = _ring_or_line(nodes_of("curve", curve), ends)
    outwards, longer = _added(nodes, ends, extension)
    line = completed(nodes, ends, outwards, longer)
    return gauss_integral(line, line)


def linking_number(
    first: Curve, second: Curve, *, ends: Ends = "joined"
) -> Float[Array, ""]:
    """Gauss linking number of two curves: the number of windings around each other.

    It is an integer for closed curves. For open ones it is their Gauss integral, which
    changes by 1 when they pass through each other.

    Args:
        first: A state, or nodes `(3, n + 1)` [m].
        second: Another curve, whose number of nodes may differ.
        ends: "joined" or "open".

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> angle = jnp.linspace(0.0, 2 * jnp.pi, 21)
        >>> ring = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle])
        >>> through = jnp.stack([1 + jnp.cos(angle), 0 * angle, jnp.sin(angle)])
        >>> round(float(topology.linking_number(ring, through)), 3)
        -1.0
    """
    check_ends(ends, ("joined", "open"))
    one, other = (
        completed(nodes_of(name, curve), ends)
        for name, curve in (("first", first), ("second", second))
    )
    return gauss_integral(one, other)


def link(
    curve: Curve,
    normals: Numbers | None = None,
    *,
    offset: Numbers | None = None,
    ends: Ends = "open",
    extension: Numbers | None = None,
) -> Float[Array, ""]:
    """Link of a ribbon: linking number of its centreline and a line offset along d1.

    It is an integer for closed ribbons. For ends other than "joined" it is the Gauss
    integral of the two open or lengthened lines, which is close to twist plus writhe
    for a long `extension`.

    Args:
        curve: A state, or nodes `(3, n + 1)` [m].
        normals: Normals `(3, n)` of the elements, of any length; by default d1 of the
            state. Only their components perpendicular to the elements count.
        offset: Distance of the second line [m]; by default a hundredth of the shortest
            element. PyElastica takes the radius.
        ends: Treatment of the ends, as in `writhe`.
        extension: Length added at each end, as in `writhe`.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> angle = jnp.linspace(0.0, 2 * jnp.pi, 41)
        >>> ring = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle])
        >>> middle = 0.5 * (angle[1:] + angle[:-1])
        >>> cosine, sine = jnp.cos(middle), jnp.sin(middle)
        >>> normals = jnp.stack([cosine**2, cosine * sine, sine])  # they turn once
        >>> round(float(topology.link(ring, normals, ends="joined")), 3)
        -1.0
    """
    check_ends(ends)
    nodes = _ring_or_line(nodes_of("curve", curve), ends)
    across_elements = across(
        split(normals_of(curve, normals)), unit(inner_difference(split(nodes)))
    )
    n = nodes.shape[1] - 1
    if offset is None:
        distance = jnp.broadcast_to(0.01 * jnp.min(element_lengths(nodes)), (n,))
    else:
        given = as_array(
            "offset", offset, "m", [(), (n,)], positive=True, dtype=nodes.dtype
        )
        distance = jnp.broadcast_to(given, (n,))
    # Each node of the second line uses the normal of the element before it.
    step = distance[None, :] * jnp.stack(across_elements)
    beside = nodes + jnp.concatenate([step[:, :1], step], axis=1)
    outwards, longer = _added(nodes, ends, extension)
    return gauss_integral(
        completed(nodes, ends, outwards, longer),
        completed(beside, ends, outwards, longer),
    )


def gauss_integral(
    first: Float[Array, "3 a"], second: Float[Array, "3 b"]
) -> Float[Array, ""]:
    """Gauss integral: solid angles of all pairs of segments, summed, over 4 pi [1]."""
    starts, finishes = split(second[:, :-1]), split(second[:, 1:])

    # Storing intermediate values of the solid angles would take most of the memory.
    @jax.checkpoint
    def seen_from(segment: tuple[Array, Array]) -> Array:
        start, finish = split(segment[0]), split(segment[1])
        return jnp.sum(quadrilateral(*_directions(start, finish, starts, finishes)))

    sums = lax.map(seen_from, (first[:, :-1].T, first[:, 1:].T))
    return jnp.sum(sums) / (4 * jnp.pi)


def _directions(
    start: Vec3, finish: Vec3, starts: Vec3, finishes: Vec3
) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Corners of the spherical parallelograms of one segment with many others.

    They are unit vectors from `start` or `finish`, the ends of the segment, to `starts`
    or `finishes`, those of the others.
    """
    return (
        unit(subtract(starts, start)),
        unit(subtract(starts, finish)),
        unit(subtract(finishes, finish)),
        unit(subtract(finishes, start)),
    )


def _ring_or_line(nodes: Array, ends: Ends) -> Array:
    return seamless(nodes) if ends == "joined" else nodes


def _added(
    nodes: Array, ends: Ends, extension: Numbers | None
) -> tuple[tuple[Array, Array] | None, Array | None]:
    """Outward directions and length [m] of pieces added at the ends, or two `None`s."""
    if ends in ("open", "joined"):
        if extension is not None:
            raise ValueError(f"ends={ends!r} adds nothing: leave out extension")
        return None, None
    if extension is None:
        return end_directions(nodes, ends), jnp.sum(element_lengths(nodes))
    longer = as_array("extension", extension, "m", positive=True, dtype=nodes.dtype)
    return end_directions(nodes, ends), longer
