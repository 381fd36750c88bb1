"""Making rods: host-side factories that validate and speak SI."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod._validation import Numbers, check_array, check_count
from jaxrod.elasticity import joint_rotations, shear_stretch
from jaxrod.rod import Rod, RodState
from jaxrod.rotations import split_quaternion
from jaxrod.vectors import inner_difference, join, split

TIMOSHENKO_SHEAR_CORRECTION = 27 / 28
"""Shear correction factor of a circular section, as in PyElastica 1.0."""


def straight_rod(
    n_elements: int,
    *,
    length: Numbers,
    radius: Numbers,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None = None,
    poisson_ratio: Numbers = 0.5,
    shear_correction: Numbers = TIMOSHENKO_SHEAR_CORRECTION,
    start: Numbers = (0.0, 0.0, 0.0),
    direction: Numbers = (0.0, 0.0, 1.0),
    normal: Numbers | None = None,
    dtype: Any = None,
) -> tuple[Rod, RodState]:
    """A straight, unstressed rod of circular section, at rest.

    Args:
        n_elements: Number of elements, at least 2.
        length: Rest length [m].
        radius: Radius [m]: one number, one per element `(n,)` (a taper), or the pair
            `(2,)` of base and tip radius, which vary linearly between.
        density: Mass density [kg/m^3], one number or one per element.
        youngs_modulus: Young's modulus [Pa], one number or one per element.
        shear_modulus: Shear modulus [Pa]; by default
            `youngs_modulus / (2 (1 + poisson_ratio))`.
        poisson_ratio: Poisson's ratio [1], used when no shear modulus is given.
        shear_correction: Timoshenko's shear correction factor [1].
        start: Position of the first node [m].
        direction: Direction from first to last node; any length but zero.
        normal: Direction of d1; its part along `direction` is removed. By default
            a world axis perpendicular or nearly so.
        dtype: Floating-point type; by default JAX's default.

    Returns:
        The rod and its state.

    Raises:
        ValueError: If an argument is out of range or does not fit.
    """
    n = check_count("n_elements", n_elements, 2)
    extent = check_array("length", length, [()], "m", positive=True)
    origin = check_array("start", start, [(3,)], "m")
    axis = check_array("direction", direction, [(3,)], "")
    if np.linalg.norm(axis) == 0:
        raise ValueError("direction must not be the zero vector")
    axis = axis / np.linalg.norm(axis)
    frame = _frame_along(axis, normal)
    quaternion = np.repeat(_quaternion_of_frame(frame)[:, None], n, axis=1)
    fractions = np.linspace(0.0, 1.0, n + 1)
    positions = origin[:, None] + extent * axis[:, None] * fractions
    return _build(
        positions,
        quaternion,
        rest_lengths=extent * jnp.full(n, 1 / n),
        radius=radius,
        density=density,
        youngs_modulus=youngs_modulus,
        shear_modulus=shear_modulus,
        poisson_ratio=poisson_ratio,
        shear_correction=shear_correction,
        dtype=dtype,
        straight=True,
    )


def rod_along(
    positions: Numbers,
    *,
    radius: Numbers,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None = None,
    poisson_ratio: Numbers = 0.5,
    shear_correction: Numbers = TIMOSHENKO_SHEAR_CORRECTION,
    normal: Numbers | None = None,
    directors: Numbers | None = None,
    dtype: Any = None,
) -> tuple[Rod, RodState]:
    """A rod whose unstressed shape follows a given polyline, at rest.

    The material frames are carried along the curve without twist (parallel
    transport) unless they are given. Curvature, twist and shear of this shape become
    the rod's rest values: the rod is pre-curved, not bent.

    Args:
        positions: Nodes of the rest shape `(3, n + 1)` [m], n at least 2.
        radius: As in `straight_rod`.
        density: As in `straight_rod`.
        youngs_modulus: As in `straight_rod`.
        shear_modulus: As in `straight_rod`.
        poisson_ratio: As in `straight_rod`.
        shear_correction: As in `straight_rod`.
        normal: Direction of d1 of the first element; see `straight_rod`.
        directors: Material frames `(3, 3, n)`, `[i, j]` being world component j of
            director i, orthonormal and right-handed; instead of `normal`.
        dtype: Floating-point type; by default JAX's default.

    Returns:
        The rod and its state.

    Raises:
        ValueError: If an argument is out of range or does not fit.
    """
    nodes = np.asarray(positions, dtype=np.float64)
    if nodes.ndim != 2 or nodes.shape[0] != 3 or nodes.shape[1] < 3:
        raise ValueError(
            "positions must have shape (3, n + 1) with n >= 2, in metres, "
            f"got {nodes.shape}"
        )
    check_array("positions", nodes, [nodes.shape], "m")
    n = nodes.shape[1] - 1
    edges = np.diff(nodes, axis=1)
    lengths = np.linalg.norm(edges, axis=0)
    check_array(
        "distance between neighbouring nodes", lengths, [(n,)], "m", positive=True
    )
    if directors is None:
        frames = _transported_frames(edges / lengths, normal)
    else:
        frames = _check_frames(directors, n)
    quaternions = np.stack([_quaternion_of_frame(f) for f in frames], axis=1)
    return _build(
        nodes,
        quaternions,
        rest_lengths=lengths,
        radius=radius,
        density=density,
        youngs_modulus=youngs_modulus,
        shear_modulus=shear_modulus,
        poisson_ratio=poisson_ratio,
        shear_correction=shear_correction,
        dtype=dtype,
        straight=False,
    )


def _build(
    positions: Any,
    quaternions: np.ndarray,
    *,
    rest_lengths: Any,
    radius: Numbers,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None,
    poisson_ratio: Numbers,
    shear_correction: Numbers,
    dtype: Any,
    straight: bool,
) -> tuple[Rod, RodState]:
    n = quaternions.shape[1]
    per_element = [(), (n,)]
    radii = check_array("radius", radius, [(), (2,), (n,)], "m", positive=True)
    if radii.shape == (2,) and n != 2:
        base, tip = radii
        radii = base + (tip - base) * (np.arange(n) + 0.5) / n
    densities = check_array("density", density, per_element, "kg/m^3", positive=True)
    young = check_array(
        "youngs_modulus", youngs_modulus, per_element, "Pa", positive=True
    )
    correction = check_array(
        "shear_correction", shear_correction, per_element, "", positive=True
    )
    if shear_modulus is None:
        ratio = check_array("poisson_ratio", poisson_ratio, per_element, "")
        if isinstance(ratio, np.ndarray) and np.any((ratio <= -1) | (ratio > 0.5)):
            raise ValueError(f"poisson_ratio must be in (-1, 0.5], got {poisson_ratio}")
        shear = young / (2 * (1 + ratio))
    else:
        shear = check_array(
            "shear_modulus", shear_modulus, per_element, "Pa", positive=True
        )
    dtype = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"dtype must be a floating-point type, got {dtype}")
    area = np.pi * radii**2
    second_moment = area**2 / (4 * np.pi)
    bending = young * second_moment
    shearing = correction * shear * area

    def leaf(value: Any) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype), (n,))

    rod = Rod(
        rest_lengths=leaf(rest_lengths),
        radii=leaf(radii),
        linear_density=leaf(densities * area),
        rotary_inertia=jnp.stack(
            [leaf(densities * second_moment), leaf(2 * densities * second_moment)]
        ),
        shear_stretch_stiffness=jnp.stack(
            [leaf(shearing), leaf(shearing), leaf(young * area)]
        ),
        bend_twist_stiffness=jnp.stack(
            [leaf(bending), leaf(bending), leaf(2 * shear * second_moment)]
        ),
        rest_strains=jnp.zeros((3, n), dtype),
        rest_curvatures=jnp.zeros((3, n - 1), dtype),
    )
    state = RodState(
        positions=jnp.asarray(positions, dtype),
        orientations=jnp.asarray(quaternions, dtype),
        velocities=jnp.zeros((3, n + 1), dtype),
        angular_momenta=jnp.zeros((3, n), dtype),
    )
    return (rod if straight else unstressed(rod, state)), state


def unstressed(rod: Rod, state: RodState) -> Rod:
    """A copy of the rod for which the given state is free of stress.

    Sets rest strains and rest curvatures, not rest lengths, to those of the state.
    """
    orientation = split_quaternion(state.orientations)
    edges = inner_difference(split(state.positions))
    strains = shear_stretch(edges, orientation, 1 / rod.rest_lengths)
    bends, _ = joint_rotations(orientation)
    return dataclasses.replace(
        rod,
        rest_strains=join(strains),
        rest_curvatures=join(bends) / rod.joint_lengths[None, :],
    )


def _frame_along(axis: np.ndarray, normal: Numbers | None) -> np.ndarray:
    """Directors (rows) with d3 along a unit axis and d1 near `normal`."""
    if normal is None:
        # The world axis least aligned with the rod, so that the choice is stable.
        guess = np.eye(3)[int(np.argmin(np.abs(axis)))]
    else:
        guess = check_array("normal", normal, [(3,)], "")
    d1 = guess - axis * np.dot(axis, guess)
    if np.linalg.norm(d1) <= 1e-6 * np.linalg.norm(guess):
        raise ValueError(f"normal must not be parallel to the rod, got {normal}")
    d1 = d1 / np.linalg.norm(d1)
    return np.stack([d1, np.cross(axis, d1), axis])


def _transported_frames(
    tangents: np.ndarray, normal: Numbers | None
) -> list[np.ndarray]:
    """Frames carried along a polyline by the smallest rotation at each joint."""
    frames = [_frame_along(tangents[:, 0], normal)]
    for previous, tangent in itertools.pairwise(tangents.T):
        if np.dot(previous, tangent) <= -1 + 1e-12:
            raise ValueError("positions must not turn back on themselves by 180 deg")
        frames.append(_frame_along(tangent, _turn(frames[-1][0], previous, tangent)))
    return frames


def _turn(vector: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Applies the smallest rotation that takes one unit vector to another."""
    axis = np.cross(start, end)
    return (
        vector * np.dot(start, end)
        + np.cross(axis, vector)
        + axis * np.dot(axis, vector) / (1 + np.dot(start, end))
    )


def _check_frames(directors: Numbers, n: int) -> list[np.ndarray]:
    frames = check_array("directors", directors, [(3, 3, n)], "")
    matrices = [frames[:, :, k] for k in range(n)]
    for k, frame in enumerate(matrices):
        if not np.allclose(frame @ frame.T, np.eye(3), atol=1e-6):
            raise ValueError(f"directors must be orthonormal, those of {k} are not")
        if np.linalg.det(frame) < 0:
            raise ValueError(f"directors must be right-handed, those of {k} are not")
    return matrices


def _quaternion_of_frame(frame: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z), material to world, of directors given as rows."""
    m = frame.T
    # The largest of these four is at least 1: divide by its root, never by zero.
    squares = 1 + np.array(
        [
            m[0, 0] + m[1, 1] + m[2, 2],
            m[0, 0] - m[1, 1] - m[2, 2],
            m[1, 1] - m[0, 0] - m[2, 2],
            m[2, 2] - m[0, 0] - m[1, 1],
        ]
    )
    products = np.array(
        [
            [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], squares[1], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], squares[2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], squares[3]],
        ]
    )
    quaternion = products[int(np.argmax(squares))]
    quaternion = quaternion / np.linalg.norm(quaternion)
    return quaternion if quaternion[0] >= 0 else -quaternion
