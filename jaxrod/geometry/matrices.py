"""Fields of 3 by 3 matrices, as rows of component arrays."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3

Matrix = tuple[Vec3, Vec3, Vec3]
"""A field of 3 by 3 matrices, as its rows."""


def skew(a: Vec3) -> Matrix:
    """Matrix A with A b = a x b for every vector b."""
    zero = jnp.zeros_like(a[0])
    return (zero, -a[2], a[1]), (a[2], zero, -a[0]), (-a[1], a[0], zero)


def outer(a: Vec3, b: Vec3) -> Matrix:
    """Outer product: matrix with the entries a[i] b[j]."""
    return vectors.scale(a[0], b), vectors.scale(a[1], b), vectors.scale(a[2], b)


def scaled_identity(a: Array) -> Matrix:
    """Identity matrix times a scalar field."""
    zero = jnp.zeros_like(a)
    return (a, zero, zero), (zero, a, zero), (zero, zero, a)


def turned_diagonal(frame: tuple[Vec3, Vec3, Vec3], entries: Vec3) -> Matrix:
    """Matrix in the world frame that is diag(entries) in the given frame."""
    one, two, three = (
        outer(vectors.scale(entry, axis), axis)
        for axis, entry in zip(frame, entries, strict=True)
    )
    return add(add(one, two), three)


def cross_rows(matrix: Matrix, a: Vec3) -> Matrix:
    """Product with `skew(a)` on the right: each row's cross product with `a`."""
    return (
        vectors.cross(matrix[0], a),
        vectors.cross(matrix[1], a),
        vectors.cross(matrix[2], a),
    )


def transpose(a: Matrix) -> Matrix:
    """Transposes every matrix of a field."""
    x, y, z = zip(*a, strict=True)
    return x, y, z


def add(a: Matrix, b: Matrix) -> Matrix:
    """Sum a + b of matrix fields."""
    return vectors.add(a[0], b[0]), vectors.add(a[1], b[1]), vectors.add(a[2], b[2])


def subtract(a: Matrix, b: Matrix) -> Matrix:
    """Difference a - b of matrix fields."""
    return add(a, scale(-1, b))


def scale(factor: Array | float, a: Matrix) -> Matrix:
    """Product of a matrix field with a number or a scalar field."""
    return (
        vectors.scale(factor, a[0]),
        vectors.scale(factor, a[1]),
        vectors.scale(factor, a[2]),
    )


def stacked(matrix: Matrix) -> Float[Array, "entries 3 3"]:
    """Matrices of a field stacked into one array, one matrix per entry."""
    entries = jnp.stack([entry for row in matrix for entry in row], axis=-1)
    return entries.reshape(-1, 3, 3)
