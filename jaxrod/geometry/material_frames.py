"""Material frames along a polyline: the orientations that factories give to elements.

They are computed in float64 on the host if the line is known, and with JAX if it is
traced. Both use the same formulas; `xp` is NumPy or JAX's NumPy.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxrod.validation import Numbers, check_array, is_traced

ALONG = math.radians(10)
"""Largest angle between a given frame's d3 and the direction of its element [rad]."""


def module_for(*values: Any) -> ModuleType:
    """NumPy, or JAX's NumPy if any of the values is traced."""
    return jnp if is_traced(values) else np


def _compiled_if_traced(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorates `function(xp, *arrays)` so that it is called without `xp`.

    Known arrays are computed with NumPy. For traced ones the function is a single
    program, because a factory under `jax.vmap` would compile each operation by itself.
    """
    program = jax.jit(functools.partial(function, jnp))

    @functools.wraps(function)
    def call(*arrays: Any) -> Any:
        return program(*arrays) if is_traced(arrays) else function(np, *arrays)

    return call


def unit_vector(name: str, value: Numbers, size: int = 3) -> Any:
    """Validates a vector of any length but zero, and returns it scaled to unit length.

    Raises:
        ValueError: If it is not a vector of this size, or the zero vector.
    """
    vector = check_array(name, value, [(size,)], "")
    if not is_traced(vector) and not np.any(vector):
        raise ValueError(f"{name} must not be the zero vector")
    return _unit(vector)


@_compiled_if_traced
def _unit(xp: ModuleType, vector: Any) -> Any:
    # First divided by the largest component, because its square may overflow.
    vector = vector / xp.max(xp.abs(vector))
    return vector / xp.sqrt(xp.sum(vector * vector))


def transported_frames(tangents: Any, normal: Numbers | None) -> Any:
    """Frames carried along a polyline by the smallest rotation at each joint.

    Args:
        tangents: Unit vectors along the elements `(3, n)`.
        normal: Direction of d1 of the first element; by default the world axis that is
            most nearly perpendicular to it.

    Returns:
        Directors `(3, 3, n)`; `[i, j]` is world component j of director i.

    Raises:
        ValueError: If the normal is along the first tangent, or the line turns back
            on itself.
    """
    first = _first_normal(tangents[:, 0], normal)
    xp = module_for(tangents, first)
    if xp is np:
        if np.any(np.sum(tangents[:, 1:] * tangents[:, :-1], axis=0) <= -1 + 1e-12):
            raise ValueError("positions must not turn back on themselves by 180 deg")
        normals = [first]
        for k in range(1, tangents.shape[1]):
            pair = tangents[:, k - 1], tangents[:, k]
            normals.append(_carried(np, normals[-1], *pair))
        d1 = np.stack(normals, axis=1)
    else:
        d1 = _carried_along(jnp.asarray(tangents), first)
    return xp.stack([d1, xp.cross(tangents, d1, axis=0), tangents])


def straight_frame(axis: Any, normal: Numbers | None) -> Any:
    """Directors (rows) with d3 along a unit axis and d1 near `normal`."""
    return _frame(axis, _first_normal(axis, normal))


@_compiled_if_traced
def _frame(xp: ModuleType, axis: Any, d1: Any) -> Any:
    return xp.stack([d1, xp.cross(axis, d1), axis])


def _first_normal(axis: Any, normal: Numbers | None) -> Any:
    guess = None if normal is None else unit_vector("normal", normal)
    d1, length = _across(axis, guess)
    if not is_traced(length) and length <= 1e-6:
        raise ValueError(f"normal must not be parallel to the rod, got {normal}")
    return d1


@_compiled_if_traced
def _across(xp: ModuleType, axis: Any, guess: Any) -> Any:
    """Unit vector along the part of a guess perpendicular to an axis, and its length.

    Without a guess the world axis least aligned with `axis` is used, so that the choice
    is stable. `xp` is NumPy or `jax.numpy`.
    """
    if guess is None:
        guess = xp.eye(3)[xp.argmin(xp.abs(axis))]
    d1 = guess - axis * xp.sum(axis * guess)
    length = xp.sqrt(xp.sum(d1 * d1))
    return d1 / (length if xp is jnp else max(length, 1e-300)), length


def _carried(xp: ModuleType, vector: Any, start: Any, end: Any) -> Any:
    """Normal vector after the smallest rotation that takes tangent `start` to `end`.

    `xp` is NumPy or `jax.numpy`.
    """
    axis = xp.cross(start, end)
    turned = (
        vector * xp.sum(start * end)
        + xp.cross(axis, vector)
        + axis * xp.sum(axis * vector) / (1 + xp.sum(start * end))
    )
    turned = turned - end * xp.sum(end * turned)
    return turned / xp.sqrt(xp.sum(turned * turned))


@jax.jit
def _carried_along(tangents: jax.Array, first: jax.Array) -> jax.Array:
    def carry_on(
        before: tuple[jax.Array, jax.Array], tangent: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        normal = _carried(jnp, before[1], before[0], tangent)
        return (tangent, normal), normal

    first = first.astype(tangents.dtype)
    _, others = lax.scan(carry_on, (tangents[:, 0], first), tangents[:, 1:].T)
    return jnp.concatenate([first[:, None], others.T], axis=1)


def check_frames(directors: Numbers, tangents: Any) -> Any:
    """Validates directors `(3, 3, n)`, and returns them as an array.

    `[i, j, k]` is world component j of director i of element k. The unit vectors
    `tangents` `(3, n)` point along the elements.

    Raises:
        ValueError: If they are not orthonormal and right-handed, or d3 is not along
            the elements.
    """
    n = tangents.shape[1]
    frames = check_array("directors", directors, [(3, 3, n)], "")
    for k in range(0 if is_traced(frames) else n):
        frame = frames[:, :, k]
        if not np.allclose(frame @ frame.T, np.eye(3), atol=1e-6):
            raise ValueError(
                f"directors must be orthonormal: those of element {k} are not"
            )
        if np.linalg.det(frame) < 0:
            raise ValueError(
                f"directors must be right-handed: those of element {k} are not"
            )
        if is_traced(tangents):
            continue
        angle = math.acos(np.clip(np.sum(frame[2] * tangents[:, k]), -1, 1))
        if angle > ALONG:
            raise ValueError(
                f"directors must have d3 along the rod, but that of element {k} is "
                f"{math.degrees(angle):.3g} deg from the line between its nodes"
            )
    return frames


@_compiled_if_traced
def quaternions(xp: ModuleType, frames: Any) -> Any:
    """Unit quaternions (w, x, y, z), material to world, of directors `(3, 3, n)`.

    Called without `xp`, see `_compiled_if_traced`.
    """
    m = xp.swapaxes(frames, 0, 1)
    # The largest of these four is at least 1, so division by its root is safe.
    squares = 1 + xp.stack(
        [
            m[0, 0] + m[1, 1] + m[2, 2],
            m[0, 0] - m[1, 1] - m[2, 2],
            m[1, 1] - m[0, 0] - m[2, 2],
            m[2, 2] - m[0, 0] - m[1, 1],
        ]
    )
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    products = xp.stack(
        [
            xp.stack([squares[0], wx, wy, wz]),
            xp.stack([wx, squares[1], xy, xz]),
            xp.stack([wy, xy, squares[2], yz]),
            xp.stack([wz, xz, yz, squares[3]]),
        ]
    )
    chosen = xp.argmax(squares, axis=0)
    rows = xp.take_along_axis(products, chosen[None, None, :], axis=0)[0]
    lengths = xp.sqrt(xp.sum(rows * rows, axis=0))
    signs = xp.where(rows[0] >= 0, 1, -1)
    return rows * (signs / lengths)[None, :]
