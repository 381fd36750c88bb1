"""Signed distance of grid points from a closed surface of triangles, on the host.

Blocks of grid points share a list of faces that can be nearest. A block is halved along
each axis until it is a single point, and its parts inherit the faces that are still
near enough. The sign at a point is that of its position relative to the pseudonormal of
the nearest feature: the normal of a face, the sum of the normals of both faces at an
edge, or the sum of those at a corner, weighted by the angles of the faces there.

Source: J. A. Bærentzen and H. Aanæs, Signed distance computation using the angle
weighted pseudonormal, IEEE Transactions on Visualization and Computer Graphics 11
(2005) 243.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxrod.geometry.surfaces import Triangles, merged

_PAIRS = 1 << 15
"""Number of pairs of a block and a face above which a group of blocks is divided."""


def closed_surface(vertices: np.ndarray, faces: np.ndarray) -> Triangles:
    """Closed surface with coincident corners merged and its faces turned outwards.

    Args:
        vertices: Corners `(v, 3)` [m].
        faces: Indices of the corners of each face `(f, 3)`.

    Raises:
        ValueError: If the surface is not closed, is not oriented, or has no volume.
    """
    corners, sides = merged(vertices, faces)
    if not len(sides):
        raise ValueError(
            f"no face of the mesh has an area: all {len(faces)} are points or lines"
        )
    _require_closed(corners, sides)
    a, b, c = np.moveaxis(corners[sides] - corners.mean(axis=0), 1, 0)
    volume = float(np.sum(a * np.cross(b, c))) / 6
    room = float(np.prod(np.ptp(corners, axis=0)))
    if not abs(volume) > 1e-9 * room:
        size = " x ".join(f"{x:.3g}" for x in np.ptp(corners, axis=0))
        raise ValueError(
            f"the mesh, {size} m in size, must enclose a volume, got {volume:.2g} m^3"
        )
    return corners, sides if volume > 0 else sides[:, ::-1]


def _require_closed(corners: np.ndarray, faces: np.ndarray) -> None:
    """Raises a ValueError unless every edge joins two faces of equal orientation.

    Args:
        corners: Corners `(v, 3)`, without coincident ones [m].
        faces: Indices of the corners of each face `(f, 3)`.
    """
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    there = edges[:, 0] * len(corners) + edges[:, 1]
    back = edges[:, 1] * len(corners) + edges[:, 0]
    alone = ~np.isin(back, there)
    _, which, how_often = np.unique(there, return_inverse=True, return_counts=True)
    repeated = how_often[which] > 1
    both = np.minimum(there, back)
    _, which, how_often = np.unique(both, return_inverse=True, return_counts=True)
    uses = how_often[which]
    for is_bad, trouble, remedy in (
        (
            alone & (uses == 1),
            "is not closed: {count} edges have a face on one side only",
            "Fill the holes, for example with trimesh.repair.fill_holes",
        ),
        (
            uses > 2,
            "meets itself: {count} sides of faces are at edges of more than two faces",
            "Separate the parts, for example with trimesh.Trimesh.split",
        ),
        (
            repeated | alone,
            "is not oriented: {count} sides of faces run the same way as their "
            "neighbour's",
            "Turn the faces, for example with trimesh.repair.fix_normals",
        ),
    ):
        if np.any(is_bad):
            start, end = corners[edges[np.argmax(is_bad)]]
            words = trouble.format(count=int(np.sum(is_bad)))
            raise ValueError(
                f"the mesh {words}, the first from {_point(start)} to {_point(end)} m. "
                f"{remedy}"
            )


def _point(place: np.ndarray) -> str:
    """Text for the coordinates of a point."""
    return f"({', '.join(f'{x:.4g}' for x in place)})"


def grid_distances(
    surface: Triangles, low: np.ndarray, spacing: float, counts: tuple[int, int, int]
) -> np.ndarray:
    """Signed distances of the points of a grid, negative inside [m].

    Args:
        surface: Closed surface from `closed_surface`.
        low: Position of the first point `(3,)` [m].
        spacing: Distance between neighbouring points [m].
        counts: Number of points along each axis.
    """
    corners, faces = surface
    triangles = corners[faces]
    nearest = _nearest_faces(triangles, low, spacing, counts).reshape(-1)
    normals = _pseudonormals(corners, faces)
    found = np.empty(len(nearest))
    for start in range(0, len(nearest), _PAIRS):
        some = slice(start, start + _PAIRS)
        numbers = np.arange(start, min(start + _PAIRS, len(nearest)))
        index = np.stack(np.unravel_index(numbers, counts), axis=-1)
        points = low + spacing * index
        away, feature = _from_triangles(points, triangles[nearest[some]])
        side = np.sum(away * normals[nearest[some], feature], axis=1)
        found[some] = np.copysign(np.sqrt(np.sum(away * away, axis=1)), side)
    return found.reshape(counts)


def _nearest_faces(
    triangles: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]
) -> np.ndarray:
    """Index of the nearest face of each grid point, as an array of shape `counts`.

    A block lists faces in `faces`; `owner` has the number of the block for each entry,
    in ascending order. No point of a face is farther than `reach` from its centroid.
    """
    centroids = triangles.mean(axis=1)
    reach = np.sqrt(np.sum((triangles - centroids[:, None]) ** 2, axis=2).max(axis=1))
    columns, flat = centroids.T.copy(), _in_own_planes(triangles)
    nearest = np.zeros(counts, int)
    every = np.arange(len(triangles))
    size = 1 << (max(counts) - 1).bit_length()
    stack = [(np.zeros((3, 1), int), size, np.zeros_like(every), every)]
    while stack:
        firsts, size, owner, faces = stack.pop()
        half = firsts.shape[1] // 2
        if len(faces) > _PAIRS and half:
            cut = int(np.searchsorted(owner, half))
            stack.append((firsts[:, :half], size, owner[:cut], faces[:cut]))
            stack.append((firsts[:, half:], size, owner[cut:] - half, faces[cut:]))
            continue
        middles = low[:, None] + spacing * (firsts + 0.5 * (size - 1))
        distance = np.sqrt(
            sum(
                (middle[owner] - column[faces]) ** 2
                for middle, column in zip(middles, columns, strict=True)
            )
        )
        # A centroid is on its face. Points of a block are within half its diagonal of
        # the middle, so the distances of two faces change by up to a whole diagonal.
        starts = np.searchsorted(owner, np.arange(firsts.shape[1]))
        diagonal = spacing * np.sqrt(3.0) * (size - 1)
        most = np.minimum.reduceat(distance, starts) * (1 + 1e-12) + diagonal
        near = distance - reach[faces] <= most[owner]
        owner, faces = owner[near], faces[near]
        if size == 1:
            square = _squares(middles[:, owner], flat[:, faces])
            starts = np.searchsorted(owner, np.arange(firsts.shape[1]))
            least = np.minimum.reduceat(square, starts)
            best = np.flatnonzero(square == least[owner])
            _, first = np.unique(owner[best], return_index=True)
            nearest[tuple(firsts)] = faces[best[first]]
            continue
        size //= 2
        steps = size * np.stack(np.unravel_index(np.arange(8), (2, 2, 2)))
        parts = (steps[:, :, None] + firsts[:, None]).reshape(3, -1)
        inside = np.all(parts < np.array(counts)[:, None], axis=0)
        number = np.cumsum(inside) - 1
        owner = (np.arange(8)[:, None] * firsts.shape[1] + owner).reshape(-1)
        faces = np.tile(faces, 8)[inside[owner]]
        stack.append((parts[:, inside], size, number[owner[inside[owner]]], faces))
    return nearest


def _in_own_planes(triangles: np.ndarray) -> np.ndarray:
    """Triangles `(f, 3, 3)` in their own planes, as 15 numbers each, for `_squares`.

    They are the first corner, unit vectors along the first edge, beside it in the plane
    and across the plane, and in the first two directions the second corner's first
    coordinate and both of the third corner [m].
    """
    a, b, c = np.moveaxis(triangles, 1, 0)

    def unit(vector: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        return vector / np.where(length > 0, length, 1)

    along = unit(b - a)
    across = unit(np.cross(b - a, c - a))
    # Corners on a line have no plane: any one through the line will do.
    other = unit(np.cross(along, np.eye(3)[np.argmin(np.abs(along), axis=1)]))
    across = np.where(np.any(across != 0, axis=1, keepdims=True), across, other)
    beside = np.cross(across, along)
    own = [np.sum(x * y, axis=1) for x, y in ((b - a, along), (c - a, along))]
    own.append(np.sum((c - a) * beside, axis=1))
    return np.concatenate([a.T, along.T, beside.T, across.T, np.stack(own)])


def _squares(points: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Squared distance of each point from its triangle [m^2].

    Args:
        points: Points `(3, n)` [m].
        flat: Triangles from `_in_own_planes`, one for each point `(15, n)`.
    """
    dx, dy, dz = points - flat[:3]
    x, y, z = (dx * flat[k] + dy * flat[k + 1] + dz * flat[k + 2] for k in (3, 6, 9))
    b, u, v = flat[12:]

    def of_edge(x: np.ndarray, y: np.ndarray, u: np.ndarray, v: np.ndarray) -> Any:
        """Squared distance from the edge (0, 0) - (u, v), and the side of its line."""
        square = u * u + v * v
        share = (x * u + y * v) / np.where(square > 0, square, 1)
        share = np.clip(share, 0, 1)
        return (x - share * u) ** 2 + (y - share * v) ** 2, u * y - v * x

    along = np.clip(x, 0, b)
    first = (x - along) ** 2 + y * y
    second, left = of_edge(x - b, y, u - b, v)
    third, right = of_edge(x, y, u, v)
    above = (y > 0) & (left > 0) & (right < 0)
    edges = np.minimum(np.minimum(first, second), third)
    return np.where(above, 0, edges) + z * z


def _from_triangles(
    points: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vectors from the nearest point of a triangle, for each point `(n, 3)` [m].

    Returns:
        The vectors, and the feature that has the nearest point: 0 for the inner part of
        the triangle, 1 + k for the edge from corner k to the next, 4 + k for corner k.
    """
    edges = np.roll(triangles, -1, axis=1) - triangles
    away = points[:, None] - triangles
    along = np.sum(away * edges, axis=2)
    square = np.sum(edges * edges, axis=2)
    share = np.clip(along / np.where(square > 0, square, 1), 0, 1)
    beside = away - share[:, :, None] * edges
    nearest = np.argmin(np.sum(beside * beside, axis=2), axis=1)
    rows = np.arange(len(points))
    found, part = beside[rows, nearest], share[rows, nearest]
    feature = np.where(part <= 0, 4 + nearest, 1 + nearest)
    feature = np.where(part >= 1, 4 + (nearest + 1) % 3, feature)
    normal = np.cross(edges[:, 0], edges[:, 1])
    area = np.sum(normal * normal, axis=1)
    # A point is above the inner part if it is on the inner side of all three edges.
    side = np.sum(np.cross(edges, away) * normal[:, None], axis=2)
    above = np.all(side > 0, axis=1) & (area > 0)
    height = np.sum(away[:, 0] * normal, axis=1) / np.where(area > 0, area, 1)
    found = np.where(above[:, None], height[:, None] * normal, found)
    return found, np.where(above, 0, feature)


def _pseudonormals(corners: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Outward directions at the features of each face `(f, 7, 3)`.

    The features are numbered as in `_from_triangles`; lengths do not matter.
    """
    triangles = corners[faces]
    edges = np.roll(triangles, -1, axis=1) - triangles
    normal = np.cross(edges[:, 0], edges[:, 1])
    length = np.sqrt(np.sum(normal * normal, axis=1, keepdims=True))
    normal = normal / np.where(length > 0, length, 1)
    back = -np.roll(edges, 1, axis=1)
    cross = np.linalg.norm(np.cross(edges, back), axis=2)
    angle = np.arctan2(cross, np.sum(edges * back, axis=2))
    at_corners = np.zeros_like(corners)
    np.add.at(at_corners, faces, angle[:, :, None] * normal[:, None])
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1)
    names = np.sort(ends, axis=2) @ np.array([len(corners), 1])
    _, which = np.unique(names, return_inverse=True)
    which = which.reshape(names.shape)
    at_edges = np.zeros((which.max() + 1, 3))
    np.add.at(at_edges, which, np.broadcast_to(normal[:, None], edges.shape))
    return np.concatenate([normal[:, None], at_edges[which], at_corners[faces]], axis=1)
