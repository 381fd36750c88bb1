r"""Twist of a ribbon: the angle by which its normals turn about its centreline.

From each element to the next the normal $u$ is carried without twist, by the smallest
rotation that takes the tangent $t$ to the next one $t'$,

$$\tilde u = u - \frac{u\cdot t'}{1 + t\cdot t'}\,(t + t'), \qquad
  \mathrm{Tw} = \frac1{2\pi}\sum \mathrm{atan2}\big(t'\cdot(\tilde u\times u'),\
  \tilde u\cdot u'\big).$$

The angles are those of Klenin and Langowski's method 2a, without their special case for
collinear elements.
"""

from __future__ import annotations

import jax.numpy as jnp
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
    Curve,
    Ends,
    across,
    check_ends,
    nodes_of,
    normals_of,
    seamless,
)
from jaxrod.topology.solid_angles import ROUNDING, unit
from jaxrod.validation import Numbers


def twist(
    curve: Curve, normals: Numbers | None = None, *, ends: Ends = "open"
) -> Float[Array, ""]:
    """Twist of a ribbon in whole turns, right-handed positive [1].

    For a closed ribbon (`ends="joined"`) it is `link` minus `writhe`, as long as no
    joint is twisted by half a turn. For several frames, use `jax.vmap`.

    Args:
        curve: A state, or nodes `(3, n + 1)` [m].
        normals: Normals `(3, n)` of the elements; by default d1 of the state. Only
            their components across the elements count: a sheared rod's d1 leaves the
            section.
        ends: "open" or "joined".

    Raises:
        ValueError: If an argument is out of range.
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
    """A normal turned by the smallest rotation that takes one tangent to another."""
    versed = 1 + dot(start, end)
    folded = versed < ROUNDING * jnp.finfo(versed.dtype).eps
    share = jnp.where(folded, 0, dot(u, end) / jnp.where(folded, 1, versed))
    return subtract(u, scale(share, add(start, end)))


def _angle(u: Vec3, v: Vec3, axis: Vec3) -> Array:
    """Signed angle from one normal to another about an axis [rad]."""
    sine, cosine = dot(axis, cross(u, v)), dot(u, v)
    nowhere = sine * sine + cosine * cosine == 0
    return jnp.arctan2(sine, jnp.where(nowhere, 1, cosine))
