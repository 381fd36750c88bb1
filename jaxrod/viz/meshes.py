"""Rigid bodies in a replay: surfaces of triangles that translate and rotate."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxrod.viz.shapes import checked_colour, numbers, require_finite

_CREASE = np.cos(np.radians(35.0))
"""Cosine of the largest angle between adjacent faces that are shaded as smooth."""


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """A surface of triangles, shown at K equal bodies over T frames.

    Example:
        >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
        >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> rising = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.5]]
        >>> replay = viz.Replay.of([0, 0.1], meshes=[viz.Mesh(corners, faces, rising)])
        >>> replay.meshes[0].placed(frame=1, body=0)[3].tolist()  # its top
        [0.0, 0.0, 1.5]
    """

    vertices: Float[np.ndarray, "v 3"]
    """Corners of the triangles in the body frame [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Indices of the corners of each triangle, counterclockwise seen from outside."""
    positions: Any = (0.0, 0.0, 0.0)
    """Positions of the bodies' origins [m]: (3,) at rest, (T, 3) for one moving body,
    or (T, K, 3)."""
    orientations: Any = (1.0, 0.0, 0.0, 0.0)
    """Unit quaternions (w, x, y, z), body to world: (4,) at rest, (T, 4), or
    (T, K, 4)."""
    name: str = "body"
    """Name in the legend."""
    colour: str = ""
    """Colour as "#rrggbb"; empty for an automatic colour."""

    @property
    def count(self) -> int:
        """Number of bodies, K."""
        return int(self.positions.shape[1])

    def at_frames(self, keep: Any) -> Mesh:
        """Copy with only the frames of the indices `keep`."""
        return dataclasses.replace(
            self, positions=self.positions[keep], orientations=self.orientations[keep]
        )

    def placed(self, frame: int, body: int) -> np.ndarray:
        """Corners of one body in one frame, in world coordinates [m], shape (v, 3)."""
        turn = rotation(self.orientations[frame, body])
        return self.positions[frame, body] + self.vertices @ turn.T


def checked_mesh(index: int, mesh: Mesh, times: np.ndarray) -> Mesh:
    """A checked copy of a mesh, with a position and orientation per body and frame."""
    name = f"meshes[{index}]"
    vertices = numbers(f"{name}.vertices", mesh.vertices, "m")
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < 3:
        raise ValueError(
            f"{name}.vertices must have shape (v, 3) [m], got {vertices.shape}"
        )
    require_finite(f"{name}.vertices", vertices, "m")
    faces = np.asarray(mesh.faces)
    good = faces.ndim == 2 and faces.shape[1] == 3 and len(faces)
    if not good or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"{name}.faces must be integers (f, 3), got {faces.shape}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"{name}.faces must name corners from 0 to {len(vertices) - 1}, got "
            f"{faces.min()} to {faces.max()}"
        )
    frames = len(times)
    places = _per_body(f"{name}.positions", mesh.positions, 3, times, "m")
    turns = _per_body(f"{name}.orientations", mesh.orientations, 4, times, "")
    bodies = max(places.shape[1], turns.shape[1])
    places = np.broadcast_to(places, (frames, bodies, 3)).copy()
    turns = np.broadcast_to(turns, (frames, bodies, 4)).copy()
    sizes = np.linalg.norm(turns, axis=-1, keepdims=True)
    if sizes.min() < 1e-6:
        raise ValueError(f"{name}.orientations must be unit quaternions, got a zero")
    turns /= sizes
    # q and -q are the same rotation: choose the sign nearer to the previous frame.
    for k in range(1, frames):
        turns[k] *= np.where(
            np.sum(turns[k] * turns[k - 1], axis=-1, keepdims=True) < 0, -1, 1
        )
    return Mesh(
        vertices,
        faces.astype(np.int64),
        places,
        turns,
        str(mesh.name),
        checked_colour(mesh.colour),
    )


def _per_body(
    name: str, values: Any, width: int, times: np.ndarray, unit: str
) -> np.ndarray:
    given = numbers(name, values, unit)
    if given.ndim == 2:
        given = given[:, None]
    if given.ndim not in (1, 3) or given.shape[-1] != width:
        raise ValueError(
            f"{name} must have shape ({width},), ({len(times)}, {width}) or "
            f"({len(times)}, k, {width}), got {np.shape(values)}"
        )
    if given.ndim == 3 and given.shape[0] != len(times):
        raise ValueError(f"{name} must have {len(times)} frames, got {given.shape[0]}")
    require_finite(name, given, unit)
    return (
        np.broadcast_to(given, (len(times), *(given.shape[1:] or (1,))[:-1], width))
        if given.ndim == 3
        else np.broadcast_to(given, (len(times), 1, width))
    )


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a unit quaternion (w, x, y, z), body to world."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def shaded(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Corners of every triangle, and normals there for smooth shading, (f, 3, 3) each.

    A normal is the mean of those of the faces around the corner, weighted by their
    angles at the corner. Only faces at less than 35 degrees to the triangle count, so
    creases stay sharp.
    """
    corners = mesh.vertices[mesh.faces]
    along = np.roll(corners, -1, axis=1) - corners
    face = np.cross(along[:, 0], along[:, 1])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-300)
    unit = along / np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-300)
    cosines = -np.sum(unit * np.roll(unit, 1, axis=1), axis=2)
    angles = np.arccos(np.clip(cosines, -1, 1))
    around: dict[int, list[tuple[int, float]]] = {}
    for f, (three, wide) in enumerate(zip(mesh.faces, angles, strict=True)):
        for v, angle in zip(three, wide, strict=True):
            around.setdefault(int(v), []).append((f, float(angle)))
    normals = np.empty_like(corners)
    for f, three in enumerate(mesh.faces):
        for c, v in enumerate(three):
            others, weights = zip(*around[int(v)], strict=True)
            near = face[list(others)]
            smooth = near @ face[f] > _CREASE
            total = (np.array(weights)[smooth, None] * near[smooth]).sum(axis=0)
            size = np.linalg.norm(total)
            normals[f, c] = total / size if size > 1e-9 else face[f]
    return corners, normals
