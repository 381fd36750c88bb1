"""Triangulated surfaces of balls, capsules, cylinders, boxes, signed distances."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

_AROUND = 40

Triangles = tuple[np.ndarray, np.ndarray]
"""Corners (V, 3) [m], and faces (F, 3) as indices of corners."""


def ball(radius: float) -> Triangles:
    """Triangulated surface of a ball centred at the origin."""
    polar = np.linspace(0, np.pi, _AROUND // 2 + 1)
    return turned(radius * np.sin(polar), -radius * np.cos(polar))


def capsule(half: float, radius: float) -> Triangles:
    """Triangulated capsule, with its axis from z = -half to half."""
    polar = np.linspace(0, np.pi / 2, _AROUND // 4 + 1)
    across = radius * np.sin(polar)
    up = half + radius * np.cos(polar)
    return turned(np.r_[across, across[::-1]], np.r_[-up, up[::-1]])


def cylinder(half: float, radius: float) -> Triangles:
    """Triangulated cylinder with flat ends, with its axis from z = -half to half."""
    return turned(
        np.array([0.0, radius, radius, 0.0]), np.array([-half, -half, half, half])
    )


def pipe(half: float, bore: float, outer: float) -> Triangles:
    """Triangulated pipe with radii `bore` and `outer`, from z = -half to half."""
    return turned(
        np.array([bore, outer, outer, bore, bore]),
        np.array([-half, -half, half, half, -half]),
    )


def along(triangles: Triangles, start: np.ndarray, end: np.ndarray) -> Triangles:
    """Moves a surface so that its z axis becomes the line from `start` to `end`.

    The origin becomes the middle of the line.
    """
    corners, faces = triangles
    axis = (end - start) / np.linalg.norm(end - start)
    # The shortest rotation from z; a half turn about x where the axis points to -z.
    turn = np.diag([1.0, -1.0, -1.0])
    if axis[2] > -1 + 1e-6:
        x, y, z = axis
        spin = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
        turn = np.eye(3) + spin + spin @ spin / (1 + z)
    return (start + end) / 2 + corners @ turn.T, faces


def box(half_lengths: np.ndarray) -> Triangles:
    """Triangulated block centred at the origin, with edges along the axes."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4)]
    quads.append((1, 5, 7, 3))
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return signs * np.asarray(half_lengths, float), np.array(faces)


def turned(across: np.ndarray, along: np.ndarray) -> Triangles:
    """Surface of revolution about z, from points of its profile.

    Args:
        across: Distances from the axis [m], from the lowest point to the highest.
        along: Heights [m].
    """
    angles = 2 * np.pi * np.arange(_AROUND) / _AROUND
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(_AROUND)], axis=-1)
    rings = across[:, None, None] * circle + along[:, None, None] * np.array(
        [0, 0, 1.0]
    )
    first = np.arange(_AROUND)
    nexts = (first + 1) % _AROUND
    faces = []
    for k in range(len(across) - 1):
        a, b = k * _AROUND + first, k * _AROUND + nexts
        c, d = a + _AROUND, b + _AROUND
        faces += [np.stack([a, b, d], -1), np.stack([a, d, c], -1)]
    return merged(rings.reshape(-1, 3), np.concatenate(faces))


def merged(vertices: np.ndarray, faces: np.ndarray) -> Triangles:
    """Merges coincident corners, and drops faces without area."""
    size = np.ptp(vertices, axis=0).max() or 1.0
    _, first, where = np.unique(
        np.round((vertices - vertices.min(axis=0)) / (1e-7 * size)).astype(np.int64),
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    faces = np.ravel(where)[faces]
    whole = np.all(faces != np.roll(faces, 1, axis=1), axis=1)
    return vertices[first], faces[whole]


def of_distance(
    surface: Callable[[np.ndarray], tuple[Any, Any]],
    low: np.ndarray,
    high: np.ndarray,
    cells: int = 36,
) -> Triangles:
    """Triangulated surface where a signed distance is zero, by surface nets.

    Every grid cell that the surface crosses gets a vertex, which is moved onto the
    surface along the normal. The cells around a crossed edge make a face.

    Args:
        surface: Function that returns distance [m] and outward normal at points (N, 3).
        low: Lower corner of the box to search [m].
        high: Upper corner of the box [m].
        cells: Number of cells along its longest side.

    Raises:
        ValueError: If the surface does not cross the box.
    """
    step = float(np.max(high - low)) / cells
    counts = np.maximum(np.ceil((high - low) / step).astype(int), 1) + 1
    axes = [low[k] + step * np.arange(counts[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = np.asarray(surface(grid.reshape(-1, 3))[0]).reshape(counts) < 0
    eight = [
        inside[i : i + counts[0] - 1, j : j + counts[1] - 1, k : k + counts[2] - 1]
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    ]
    number = np.sum(eight, axis=0)
    crossed = (number > 0) & (number < 8)
    if not crossed.any():
        raise ValueError(
            f"there is no surface between {low.tolist()} and {high.tolist()} m"
        )
    names = np.full(crossed.shape, -1)
    names[crossed] = np.arange(crossed.sum())
    vertices = (np.argwhere(crossed) + 0.5) * step + low
    for _ in range(4):
        distance, normal = surface(vertices)
        move = np.asarray(distance)[:, None] * np.asarray(normal)
        vertices = vertices - np.clip(move, -step, step)
    faces = []
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        here = np.moveaxis(inside, (axis, b, c), (0, 1, 2))
        cell = np.moveaxis(names, (axis, b, c), (0, 1, 2))
        first, second = here[:-1, 1:-1, 1:-1], here[1:, 1:-1, 1:-1]
        for leaving in (True, False):
            edges = np.argwhere((first != second) & (first == leaving))
            i, j, k = edges.T
            quad = [cell[i, j, k], cell[i, j + 1, k], cell[i, j + 1, k + 1]]
            quad.append(cell[i, j, k + 1])
            four = np.stack(quad if leaving else quad[::-1], axis=-1)
            faces += [four[:, [0, 1, 2]], four[:, [0, 2, 3]]]
    return vertices, np.concatenate(faces)
