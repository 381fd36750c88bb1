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
    r"""Cosine of half the angle between unit vectors, $|a + b|/2$, at least epsilon."""
    middle = add(a, b)
    squared = 0.25 * dot(middle, middle)
    least = jnp.finfo(squared.dtype).eps ** 2
    return jnp.sqrt(jnp.maximum(squared, least))


def angle_over_sine(a: Vec3, b: Vec3) -> Array:
    r"""Ratio $\theta/\sin\theta$, with $\theta$ the angle between two unit vectors.

    With $q = \cos(\theta/4)$ and $u = \tan^2(\theta/8) = (1 - q)/(1 + q)$ it is
    $2\,\arctan(\sqrt u)/\sqrt u$ divided by
    $q\,(1 + q) \cos(\theta/2)$.
    """
    half = half_angle_cosine(a, b)
    quarter = jnp.sqrt(0.5 * (1 + half))
    inverse = 1 / (1 + quarter)
    arctan = arctangent_ratio((1 - quarter) * inverse)
    return 2 * arctan * inverse / (quarter * half)


def smallest_rotation(a: Vec3, b: Vec3) -> Quaternion:
    """Rotation by the smallest angle that takes unit vector `a` to unit vector `b`."""
    half = half_angle_cosine(a, b)
    return (half, *scale(0.5 / half, cross(a, b)))


def frame_along(direction: Vec3) -> Quaternion:
    """Orientation whose d3 is the given unit vector; d1 and d2 are arbitrary.

    If z is not negative, it is the smallest rotation of the z axis to the vector.
    Otherwise a half turn about x comes first, and the smallest rotation begins at -z.
    The smallest rotation is thus by a quarter turn at most, and its axis is
    well-defined.
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
    """Orientations after the smallest rotation that turns d3 to `direction`."""
    d3 = directors(orientation)[2]
    turn = smallest_rotation(d3, direction)
    return normalise(multiply_quaternions(turn, orientation))


def transported(root: Quaternion, direction: Vec3, end: End) -> Quaternion:
    """Orientations of all elements, without twist, from that of one end element.

    Args:
        root: Orientation of the end element, components are scalars.
        direction: Unit vectors along all elements.
        end: End of the rod at which `root` is given.
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
    """Running products of quaternions along the rod, `p[k] = q[k] p[k-1]`."""

    def further(
        product: Quaternion, factor: Quaternion
    ) -> tuple[Quaternion, Quaternion]:
        product = multiply_quaternions(factor, product)
        return product, product

    one, zero = jnp.ones((), q[0].dtype), jnp.zeros((), q[0].dtype)
    # Sequential: an associative scan takes minutes to compile, and this runs once.
    return lax.scan(further, (one, zero, zero, zero), q)[1]
