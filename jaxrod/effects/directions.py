r"""Unit vectors as directions of elements: angles between them, frames along them.

Everything here is a polynomial or a square root of sums of squares, so nothing is
divided by an angle. It is exact to round-off and has finite gradients for parallel
directions and up to opposite ones, for which the axis of rotation is undefined.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxrod.effects.ends import End
from jaxrod.geometry.rotations import (
    Quaternion,
    arctangent_ratio,
    directors,
    multiply_quaternions,
    normalise,
)
from jaxrod.geometry.vectors import Vec3, add, cross, dot, scale


def half_angle_cosine(a: Vec3, b: Vec3) -> Array:
    r"""$\cos(\theta/2) = |a + b|/2$, at least the machine epsilon."""
    middle = add(a, b)
    squared = 0.25 * dot(middle, middle)
    least = jnp.finfo(squared.dtype).eps ** 2
    return jnp.sqrt(jnp.maximum(squared, least))


def angle_over_sine(a: Vec3, b: Vec3) -> Array:
    r"""Ratio $\theta/\sin\theta$ of the angle between two directions.

    With $q = \cos(\theta/4)$ and $u = \tan^2(\theta/8) = (1 - q)/(1 + q)$ it is
    $2\,\arctan(\sqrt u)/\sqrt u$ over $q\,(1 + q) \cos(\theta/2)$.
    """
    half = half_angle_cosine(a, b)
    quarter = jnp.sqrt(0.5 * (1 + half))
    inverse = 1 / (1 + quarter)
    arctan = arctangent_ratio((1 - quarter) * inverse)
    return 2 * arctan * inverse / (quarter * half)


def smallest_rotation(a: Vec3, b: Vec3) -> Quaternion:
    """Smallest rotation that takes one direction to the other."""
    half = half_angle_cosine(a, b)
    return (half, *scale(0.5 / half, cross(a, b)))


def frame_along(direction: Vec3) -> Quaternion:
    """A frame whose d3 is the given direction; d1 and d2 are arbitrary.

    It is the smallest rotation of the z axis; in the lower half of space a half turn
    about x precedes it. It is never a rotation by nearly half a turn, whose axis would
    be ill-defined.
    """
    x, y, z = direction
    half = jnp.sqrt(0.5 * (1 + jnp.abs(z)))
    across, along = -0.5 * y / half, 0.5 * x / half
    zero = jnp.zeros_like(z)
    up = z >= 0
    return (
        jnp.where(up, half, across),
        jnp.where(up, across, half),
        jnp.where(up, along, zero),
        jnp.where(up, zero, along),
    )


def turned_to(orientation: Quaternion, direction: Vec3) -> Quaternion:
    """Orientations turned by the smallest rotation that aligns d3 with a direction."""
    d3 = directors(orientation)[2]
    turn = smallest_rotation(d3, direction)
    return normalise(multiply_quaternions(turn, orientation))


def transported(root: Quaternion, direction: Vec3, end: End) -> Quaternion:
    """Frames carried without twist from the element at one end along the rod.

    Args:
        root: Orientation of the end element; scalars.
        direction: Directions of all elements.
        end: The end at which the root is.
    """
    way = 1 if end == "base" else -1
    x, y, z = (c[::way] for c in direction)
    turns = smallest_rotation((x[:-1], y[:-1], z[:-1]), (x[1:], y[1:], z[1:]))
    w, i, j, k = (
        jnp.concatenate([first[None], following])
        for first, following in zip(root, turns, strict=True)
    )
    carried = _products((w, i, j, k))
    # Removes the round-off that has accumulated along the rod.
    w, i, j, k = turned_to(carried, (x, y, z))
    return w[::way], i[::way], j[::way], k[::way]


def _products(q: Quaternion) -> Quaternion:
    """Cumulative products of quaternions; later ones multiply from the left."""

    def further(
        product: Quaternion, factor: Quaternion
    ) -> tuple[Quaternion, Quaternion]:
        product = multiply_quaternions(factor, product)
        return product, product

    one, zero = jnp.ones((), q[0].dtype), jnp.zeros((), q[0].dtype)
    # Sequential: an associative scan takes minutes to compile, and this runs once.
    return lax.scan(further, (one, zero, zero, zero), q)[1]
