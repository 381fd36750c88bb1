"""Arithmetic on 3-vectors held as tuples of component arrays.

Inside a step every vector field is a tuple `(x, y, z)` of equally shaped arrays,
one entry per node, element or joint. Each operation is then a plain multiply or add
over contiguous memory. XLA fuses it well, and no dot product goes to a matrix unit,
which would round it to TF32 on some accelerators.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Vec3 = tuple[Array, Array, Array]
"""A field of 3-vectors, as the arrays of x, y and z components, equal in shape."""


def split(stacked: Float[Array, "3 n"]) -> Vec3:
    """Splits a component-first array into its three component arrays."""
    return stacked[0], stacked[1], stacked[2]


def join(vector: Vec3) -> Float[Array, "3 n"]:
    """Stacks the three component arrays into one, component axis first."""
    return jnp.stack(vector)


def split_optional(stacked: Float[Array, "3 n"] | None) -> Vec3 | None:
    """Splits an array as `split` does; `None` stays `None`."""
    return None if stacked is None else split(stacked)


def join_optional(vector: Vec3 | None) -> Float[Array, "3 n"] | None:
    """Joins a vector field as `join` does; `None` stays `None`."""
    return None if vector is None else join(vector)


def dot(a: Vec3, b: Vec3) -> Array:
    """Scalar product, entry by entry."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Cross product, entry by entry."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def add(a: Vec3, b: Vec3) -> Vec3:
    """Sum a + b of vector fields."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def add_optional(a: Vec3 | None, b: Vec3 | None) -> Vec3 | None:
    """Sum of two vector fields, either of which may be `None`, which counts as zero."""
    if a is None or b is None:
        return b if a is None else a
    return add(a, b)


def subtract(a: Vec3, b: Vec3) -> Vec3:
    """Difference a - b of vector fields."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(factor: Array | float, a: Vec3) -> Vec3:
    """Product of a vector field with a number or a scalar field."""
    return factor * a[0], factor * a[1], factor * a[2]


def multiply(a: Vec3, b: Vec3) -> Vec3:
    """Product component by component: the diagonal matrix diag(a) times b."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


def apply(function: Callable[[Array, Array], Array], a: Vec3, b: Vec3) -> Vec3:
    """Applies a function to the x, the y and the z components of two vector fields."""
    return function(a[0], b[0]), function(a[1], b[1]), function(a[2], b[2])


def along(axis: int, like: Array) -> Vec3:
    """Unit vectors along a coordinate axis, one for each entry of `like`."""
    x, y, z = (jnp.full_like(like, k == axis) for k in range(3))
    return x, y, z


def mapped(function: Callable[[Array], Array], vector: Vec3) -> Vec3:
    """Applies a function to each of the three components of a vector field."""
    return function(vector[0]), function(vector[1]), function(vector[2])


def safe_norm(a: Vec3) -> Array:
    """Euclidean length, with gradient zero (not NaN) for the zero vector.

    The length of the zero vector is the square root of the smallest normal number.
    """
    squared = dot(a, a)
    return jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))


def pad(a: Array, before: int, after: int) -> Array:
    """Field with zeros added along its last axis, `before` in front and `after` behind.

    Unlike `jnp.concatenate`, `lax.pad` fuses with neighbouring operations and leaves
    the batch axis in place under `vmap`.
    """
    ends = [*[(0, 0, 0)] * (a.ndim - 1), (before, after, 0)]
    return lax.pad(a, jnp.zeros((), a.dtype), ends)


def difference(a: Vec3) -> Vec3:
    r"""Differences of neighbours, with zeros beyond both ends.

    $(a_1,\ a_2 - a_1,\ \dots,\ a_n - a_{n-1},\ -a_n)$: one entry more than `a`. It is
    the transpose of the (negated) inner difference, so a field of internal loads
    sums to zero.
    """

    def one(c: Array) -> Array:
        return pad(c, 0, 1) - pad(c, 1, 0)

    return one(a[0]), one(a[1]), one(a[2])


def pair_sum(a: Vec3) -> Vec3:
    r"""Sums of neighbours, with zeros beyond both ends.

    $(a_1,\ a_1 + a_2,\ \dots,\ a_{n-1} + a_n,\ a_n)$: one entry more than `a`.
    """

    def one(c: Array) -> Array:
        return pad(c, 0, 1) + pad(c, 1, 0)

    return one(a[0]), one(a[1]), one(a[2])


def inner_difference(a: Vec3) -> Vec3:
    """Differences a[k+1] - a[k] of neighbours: one entry fewer than `a`."""
    return a[0][1:] - a[0][:-1], a[1][1:] - a[1][:-1], a[2][1:] - a[2][:-1]
