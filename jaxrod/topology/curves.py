r"""Curves as polylines: checks of arguments, completion of ends, and solid angles.

Writhe and link are invariants of closed curves. An open curve is left open, closed by a
segment, or lengthened by a straight piece at each end. These pieces are so long that
the rest of a closing curve would add little.

A spherical triangle of unit vectors $a, b, c$ has the signed area

$$\Omega = 2\,\mathrm{atan2}\big(a\cdot(b\times c),\ 1 + a\cdot b + b\cdot c
    + c\cdot a\big)$$

(van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30, 1983). Seen from all points of
one segment, another segment sweeps a spherical parallelogram, which is two such
triangles. The formula has no arcsine whose argument could leave its range by round-off.
A zero vector (between points that coincide) subtends no angle and has zero gradient. So
everything is finite and differentiable for any position of the curves.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry.vectors import (
    Vec3,
    cross,
    dot,
    inner_difference,
    scale,
    split,
    subtract,
)
from jaxrod.rods.rod import RodState, check_one
from jaxrod.validation import Numbers, as_array, numeric

Ends = Literal["open", "joined", "next_tangent", "end_to_end", "net_tangent"]
"""Treatment of the ends of a curve.

"open": no treatment. "joined": the last node is joined to the first, whether it is at
the same place (a welded ring) or not. The others add a straight piece at each end, as
PyElastica's `type_of_additional_segment` does: along the end elements, along the line
from one end to the other, along the line between the mean nodes of both halves.
"""

KINDS = (jnp.float32, jnp.float64)

ROUNDING = 64
"""Multiple of round-off below which a sine and a cosine define no angle."""

Curve = RodState | Numbers
"""A state, or node positions `(3, n + 1)` [m]."""


def state_of(curve: Curve) -> RodState | None:
    """The curve if it is a state, else `None`."""
    return curve if isinstance(curve, RodState) else None


def nodes_of(name: str, curve: Curve) -> Float[Array, "3 nodes"]:
    """Nodes of a curve as an array `(3, n + 1)` [m].

    Raises:
        ValueError: If they are not at least two points, in three rows.
    """
    state = state_of(curve)
    if state is not None:
        check_one(state)
        return state.positions
    points = numeric(name, curve, "m")
    if points.ndim != 2 or points.shape[0] != 3 or points.shape[1] < 2:
        raise ValueError(
            f"{name} must be a state, or nodes (3, n + 1) with n >= 1, in metres, got "
            f"shape {points.shape}; for several frames use jax.vmap"
        )
    return as_array(name, points, "m", [points.shape], dtype=_kind(curve))


def _kind(given: Any) -> Any:
    """Floating-point dtype of a JAX array; `None` for others, to use JAX's default."""
    kind = getattr(given, "dtype", None)
    return kind if isinstance(given, jax.Array) and kind in KINDS else None


def normals_of(curve: Curve, normals: Numbers | None) -> Float[Array, "3 n"]:
    """Normals of the elements: the given ones, or d1 of a state.

    Raises:
        ValueError: If there are none, or not one per element.
    """
    state = state_of(curve)
    if state is not None and normals is None:
        return state.directors[0]
    if normals is None:
        raise ValueError("normals (3, n) of the elements must be given with positions")
    nodes = nodes_of("curve", curve)
    return as_array(
        "normals", normals, "", [(3, nodes.shape[1] - 1)], dtype=nodes.dtype
    )


def check_ends(ends: Ends, allowed: tuple[Ends, ...] = get_args(Ends)) -> None:
    """Raises a `ValueError` unless `ends` is one of the `allowed` treatments."""
    if not isinstance(ends, str) or ends not in allowed:
        raise ValueError(f"ends must be one of {', '.join(allowed)}, got {ends!r}")


def seamless(nodes: Float[Array, "3 nodes"]) -> Float[Array, "3 nodes"]:
    """Nodes of a ring; a last node that differs by round-off is set to the first."""
    gap = nodes[:, 0] - nodes[:, -1]
    edges = nodes[:, 1:] - nodes[:, :-1]
    typical = jnp.sum(edges * edges) / edges.shape[1]
    near = jnp.sum(gap * gap) < jnp.finfo(nodes.dtype).eps * typical
    return nodes.at[:, -1].set(jnp.where(near, nodes[:, 0], nodes[:, -1]))


def end_directions(nodes: Float[Array, "3 nodes"], ends: Ends) -> tuple[Array, Array]:
    """Unit vectors `(3,)` pointing outwards at both ends, for a treatment of ends."""
    if ends == "next_tangent":
        first, last = nodes[:, 0] - nodes[:, 1], nodes[:, -1] - nodes[:, -2]
    elif ends == "end_to_end":
        first = nodes[:, 0] - nodes[:, -1]
        last = -first
    else:
        half = nodes.shape[1] // 2
        # PyElastica divides the second sum by one more than there are nodes, so that
        # its directions depend on the origin. They agree if that sum is zero.
        rest = nodes.shape[1] - (nodes.shape[1] + 1) // 2
        first = (
            jnp.sum(nodes[:, :half], axis=1) / half
            - jnp.sum(nodes[:, nodes.shape[1] - rest :], axis=1) / rest
        )
        last = -first
    return jnp.stack(unit(split(first))), jnp.stack(unit(split(last)))


def completed(
    nodes: Float[Array, "3 nodes"],
    ends: Ends,
    directions: tuple[Array, Array] | None = None,
    extension: Array | None = None,
) -> Float[Array, "3 all"]:
    """Nodes of a curve, including those of the pieces that are added at its ends.

    Straight pieces have outward `directions` and a length `extension` [m]; "open" and
    "joined" need neither.
    """
    if ends == "open":
        return nodes
    if ends == "joined":
        return jnp.concatenate([nodes, nodes[:, :1]], axis=1)
    assert directions is not None and extension is not None
    first = nodes[:, 0] + extension * directions[0]
    last = nodes[:, -1] + extension * directions[1]
    return jnp.concatenate([first[:, None], nodes, last[:, None]], axis=1)


def element_lengths(nodes: Float[Array, "3 nodes"]) -> Float[Array, " n"]:
    """Lengths of the elements [m]."""
    edges: Vec3 = inner_difference(split(nodes))
    return dot(edges, unit(edges))


def across(directions: Vec3, tangents: Vec3) -> Vec3:
    """Components of vectors perpendicular to unit tangents, scaled to unit length."""
    along = scale(dot(directions, tangents), tangents)
    return unit(subtract(directions, along))


def unit(a: Vec3) -> Vec3:
    """Vectors scaled to unit length; zero vectors stay zero, with zero gradient."""
    squared = dot(a, a)
    there = squared > 0
    inverse = 1 / jnp.sqrt(jnp.where(there, squared, 1))
    return scale(jnp.where(there, inverse, 0), a)


def triangle(a: Vec3, b: Vec3, c: Vec3) -> Array:
    """Signed area of spherical triangles of unit vectors, within 2 pi [sr].

    It is zero, the mean of the values on both sides, if the centre of the sphere lies
    in the flat triangle.
    """
    volume = dot(a, cross(b, c))
    cosines = 1 + dot(a, b) + dot(b, c) + dot(c, a)
    least = ROUNDING * jnp.finfo(volume.dtype).eps
    through = (volume * volume + cosines * cosines < least * least) | (
        (volume == 0) & (cosines < 0)
    )
    return 2 * jnp.arctan2(
        jnp.where(through, 0, volume), jnp.where(through, 1, cosines)
    )


def quadrilateral(a: Vec3, b: Vec3, c: Vec3, d: Vec3) -> Array:
    """Signed area of spherical quadrilaterals `a b c d`, as two triangles [sr]."""
    return triangle(a, b, c) + triangle(a, c, d)
