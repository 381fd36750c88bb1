r"""Writhe of a curve, linking number of two, link of a ribbon.

The Gauss integral of two curves is a sum over pairs of their segments, of the signed
solid angle $\Omega_{ij}$ under which segment j is seen from all points of segment i:

$$\mathrm{Lk} = \frac1{4\pi}\sum_{i,j}\Omega_{ij}, \qquad
  \mathrm{Wr} = \frac1{4\pi}\sum_{i \ne j}\Omega_{ij},$$

exact for polygons (Klenin and Langowski, Biopolymers 54, 2000). For a closed ribbon
$\mathrm{Lk} = \mathrm{Tw} + \mathrm{Wr}$, see `jaxrod.topology.twist`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod.geometry.vectors import Vec3, inner_difference, split, subtract
from jaxrod.topology.curves import (
    Curve,
    Ends,
    across,
    check_ends,
    completed,
    end_directions,
    length_of,
    nodes_of,
    normals_of,
    seamless,
    shortest,
)
from jaxrod.topology.solid_angles import quadrilateral, unit
from jaxrod.validation import Numbers, as_array


def writhe(
    curve: Curve, *, ends: Ends = "open", extension: Numbers | None = None
) -> Float[Array, ""]:
    """Writhe of a curve: its signed crossings, averaged over all directions of view.

    It has no unit. It is 0 for a curve in a plane, and changes by 2 when the curve
    passes through itself. For several frames, use `jax.vmap`.

    Args:
        curve: A state, or nodes `(3, n + 1)` [m].
        ends: "open"; "joined" for a closed curve, whether its last node is at the
            first one's place or one element before it; "next_tangent", "end_to_end" or
            "net_tangent" to lengthen an open one at both ends, as PyElastica does.
        extension: Length added at each end [m]; by default the length of the curve.

    Raises:
        ValueError: If an argument is out of range.
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
    """Link of a ribbon: of its centreline with a parallel line, offset along d1.

    It is an integer for closed ribbons. With ends other than "joined" it is that of the
    lengthened pair of lines, near twist plus writhe for a long `extension`.

    Args:
        curve: A state, or nodes `(3, n + 1)` [m].
        normals: Normals `(3, n)` of the elements, of any length; by default d1 of the
            state. Only their components across the elements count.
        offset: Distance of the second line [m]; by default a hundredth of the shortest
            element. PyElastica takes the radius.
        ends: Treatment of the ends, as in `writhe`.
        extension: Length added at each end, as in `writhe`.

    Raises:
        ValueError: If an argument is out of range.
    """
    check_ends(ends)
    nodes = _ring_or_line(nodes_of("curve", curve), ends)
    across_elements = across(
        split(normals_of(curve, normals)), unit(inner_difference(split(nodes)))
    )
    n = nodes.shape[1] - 1
    if offset is None:
        distance = jnp.broadcast_to(0.01 * shortest(nodes), (n,))
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
    """Sum of the solid angles of all pairs of segments over that of a sphere [1]."""
    starts, finishes = split(second[:, :-1]), split(second[:, 1:])

    # Storing the solid angles' intermediate values would take most of the memory.
    @jax.checkpoint
    def seen_from(segment: tuple[Array, Array]) -> Array:
        start, finish = split(segment[0]), split(segment[1])
        return jnp.sum(quadrilateral(*_directions(start, finish, starts, finishes)))

    sums = lax.map(seen_from, (first[:, :-1].T, first[:, 1:].T))
    return jnp.sum(sums) / (4 * jnp.pi)


def _directions(
    start: Vec3, finish: Vec3, starts: Vec3, finishes: Vec3
) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Corners of the spherical parallelograms of one segment with many."""
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
    """Outward directions and lengths of the added pieces; `None` if there are none."""
    if ends in ("open", "joined"):
        if extension is not None:
            raise ValueError(f"ends={ends!r} adds nothing: leave out extension")
        return None, None
    if extension is None:
        return end_directions(nodes, ends), length_of(nodes)
    longer = as_array("extension", extension, "m", positive=True, dtype=nodes.dtype)
    return end_directions(nodes, ends), longer
