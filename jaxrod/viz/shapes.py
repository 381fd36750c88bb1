"""Shapes that are shown with the rods: spheres, cylinders, arrows and rigid bodies.

The surfaces of rigid bodies are triangles that translate and rotate.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

MOST = 400
"""Largest number of arrows drawn in one group; if there are more, the longest are."""
_SHORTEST = 0.02
"""Smallest length of a drawn arrow, relative to the longest [1]."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere shown with the rods, such as a target.

    Example:
        >>> goal = viz.Sphere((1.0, 0.0, 0.3), radius=0.03)
        >>> path = state.positions[None]  # one frame
        >>> replay = viz.Replay.from_rollout(path, 0.02, [0.0], spheres=[goal])
        >>> replay.spheres[0].name, replay.spheres[0].radius
        ('target', 0.03)
    """

    positions: Any
    """Centre of the sphere [m], shape (3,) if stationary, (T, 3) if it moves."""
    radius: float
    """Radius of the sphere [m]."""
    name: str = "target"
    """Name in the legend."""


@dataclasses.dataclass(frozen=True, eq=False)
class Cylinder:
    """A stationary cylinder, such as an obstacle.

    Example:
        >>> post = viz.Cylinder((0.5, 0.2, -1.0), (0.5, 0.2, 1.0), 0.05, name="post")
        >>> path = state.positions[None]  # one frame
        >>> replay = viz.Replay.from_rollout(path, 0.02, [0.0], cylinders=[post])
        >>> replay.num_rods, replay.cylinders[0].name
        (1, 'post')
    """

    start: Any
    """Centre of the first end face [m], shape (3,)."""
    end: Any
    """Centre of the second end face [m], shape (3,)."""
    radius: float
    """Radius of the cylinder [m]."""
    name: str = "obstacle"
    """Name in the legend."""


@dataclasses.dataclass(frozen=True, eq=False)
class Arrows:
    """A group of A arrows over T frames, such as forces.

    Example:
        >>> weight = np.tile([0.0, 0.0, -12.0], (2, 1, 1))  # 2 frames, 1 arrow
        >>> arrows = viz.Arrows(np.zeros((2, 1, 3)), weight, name="weight [N]")
        >>> replay = viz.Replay.of([0.0, 0.1], arrows=[arrows])
        >>> replay.arrows[0].largest
        12.0
    """

    origins: Float[np.ndarray, "num_frames a 3"]
    """Starting points of the arrows [m], shape (T, A, 3)."""
    vectors: Float[np.ndarray, "num_frames a 3"]
    """Vectors to show, for example forces [N], shape (T, A, 3)."""
    name: str = "force [N]"
    """Name and unit in the legend."""
    length: float | None = None
    """Length of the longest arrow [m]; `None` for a seventh of the scene's size."""
    colour: str = "#d62f5b"
    """Colour of the arrows as "#rrggbb"."""

    def at_frames(self, keep: Any) -> Arrows:
        """Copy with only the frames of the indices `keep`."""
        return dataclasses.replace(
            self, origins=self.origins[keep], vectors=self.vectors[keep]
        )

    @property
    def largest(self) -> float:
        """Largest norm of all vectors in all frames, in the unit of the vectors."""
        return float(np.linalg.norm(self.vectors, axis=-1).max(initial=0.0))

    def drawn(self, size: float) -> tuple[np.ndarray, float]:
        """Scales the vectors to the arrows that are drawn.

        Args:
            size: Size of the scene [m].

        Returns:
            The arrows [m], shape (T, A, 3), zero if shorter than 2 % of the longest;
            and the scale, arrow length per unit of the vectors.
        """
        longest = size / 7 if self.length is None else self.length
        scale = longest / (self.largest or 1.0)
        lengths = np.linalg.norm(self.vectors, axis=-1, keepdims=True) * scale
        return np.where(lengths >= _SHORTEST * longest, self.vectors * scale, 0), scale


def checked_sphere(index: int, sphere: Sphere, times: np.ndarray) -> Sphere:
    """Copy of a sphere with one position per frame; raises a ValueError if invalid.

    `index` is its index in the list of spheres, for the error message.
    """
    name = f"spheres[{index}].positions"
    centre = numbers(name, sphere.positions, "m")
    if centre.shape not in ((3,), (len(times), 3)):
        raise ValueError(
            f"{name} must have shape (3,) or ({len(times)}, 3) [m], got {centre.shape}"
        )
    require_finite(name, centre, "m")
    radius = _positive(f"spheres[{index}].radius", sphere.radius, "m")
    moving = np.broadcast_to(centre, (len(times), 3)).copy()
    return Sphere(moving, radius, str(sphere.name))


def checked_cylinder(index: int, cylinder: Cylinder) -> Cylinder:
    """Copy of a cylinder with NumPy arrays; raises a ValueError if invalid.

    `index` is its index in the list of cylinders, for the error message.
    """
    ends = []
    for side in ("start", "end"):
        name = f"cylinders[{index}].{side}"
        point = numbers(name, getattr(cylinder, side), "m")
        if point.shape != (3,):
            raise ValueError(f"{name} must have shape (3,) [m], got {point.shape}")
        require_finite(name, point, "m")
        ends.append(point)
    if np.array_equal(ends[0], ends[1]):
        raise ValueError(
            f"cylinders[{index}] must have a length, got start = end = {ends[0]} m"
        )
    radius = _positive(f"cylinders[{index}].radius", cylinder.radius, "m")
    return Cylinder(ends[0], ends[1], radius, str(cylinder.name))


def checked_arrows(index: int, arrows: Arrows, times: np.ndarray) -> Arrows:
    """Validates a group of arrows, and returns a copy of those to be drawn.

    Leaves out arrows that in every frame are too short to be drawn, then keeps at most
    the `MOST` longest. `index` is the index of the group, for the error message.
    """
    name = f"arrows[{index}]"
    vectors = numbers(f"{name}.vectors", arrows.vectors, "-")
    origins = numbers(f"{name}.origins", arrows.origins, "m")
    if vectors.ndim != 3 or vectors.shape[0] != len(times) or vectors.shape[2] != 3:
        raise ValueError(
            f"{name}.vectors must have shape ({len(times)}, a, 3), got {vectors.shape}"
        )
    try:
        origins = np.broadcast_to(origins, vectors.shape).copy()
    except ValueError:
        raise ValueError(
            f"{name}.origins must have shape {vectors.shape} [m], got {origins.shape}"
        ) from None
    require_finite(f"{name}.vectors", vectors, "-", times)
    require_finite(f"{name}.origins", origins, "m", times)
    if arrows.length is not None and not 0 < arrows.length < np.inf:
        raise ValueError(f"{name}.length must be positive, got {arrows.length} m")
    peaks = np.linalg.norm(vectors, axis=-1).max(axis=0, initial=0.0)
    seen = np.flatnonzero(peaks > _SHORTEST * peaks.max(initial=0.0))
    seen = np.sort(seen[np.argsort(-peaks[seen], kind="stable")][:MOST])
    return Arrows(
        origins[:, seen],
        vectors[:, seen],
        str(arrows.name),
        arrows.length,
        checked_colour(arrows.colour),
    )


def _positive(name: str, value: Any, unit: str) -> float:
    number = numbers(name, value, unit)
    if number.ndim != 0 or not (np.isfinite(number) and number > 0):
        raise ValueError(f"{name} must be one positive number, got {value} {unit}")
    return float(number)


def checked_colour(colour: str) -> str:
    """Returns a colour if it is "#rrggbb" or empty; raises a ValueError otherwise."""
    if colour and not re.fullmatch(r"#[0-9a-fA-F]{6}", str(colour)):
        raise ValueError(f'colour must be "#rrggbb", got {colour!r}')
    return str(colour)


def numbers(name: str, values: ArrayLike, unit: str) -> np.ndarray:
    """Copies values into a new float64 array; raises if they are not numbers.

    `name` and `unit` describe the values in the error message.

    Raises:
        ValueError: The values are not numbers.
    """
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{name} must be an array of numbers [{unit}], got {type(values).__name__}"
        ) from error


def require_finite(
    name: str, values: np.ndarray, unit: str, times: np.ndarray | None = None
) -> None:
    """Raises a ValueError for NaN or infinity, with index and time of the first one.

    `name` and `unit` are for the message. `times` are the times along the first axis;
    `None` if the values do not depend on time.
    """
    finite = np.isfinite(values)
    if finite.all():
        return
    where = tuple(int(i) for i in np.argwhere(~finite)[0])
    when = "" if times is None else f" (t = {times[where[0]]:g} s)"
    raise ValueError(
        f"{name} must be finite, got {values[where]} {unit} at index {where}{when}"
    )


def checked_times(times: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Times of the frames as a new array of `shape` [s].

    Raises a ValueError if they have another shape or do not increase.
    """
    clock = numbers("times", times, "s")
    if clock.shape != shape:
        raise ValueError(
            f"times must have shape {shape} [s], one per frame, got {clock.shape}"
        )
    require_finite("times", clock, "s")
    backward = np.flatnonzero(np.diff(clock) <= 0)
    if backward.size:
        k = int(backward[0])
        raise ValueError(
            f"times must increase, got {clock[k]:g} s then {clock[k + 1]:g} s "
            f"at index {k + 1}"
        )
    return clock


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
    """Copy of a mesh with a position and orientation per body and frame.

    Raises a ValueError if invalid; `index` is the mesh's index in the list, for the
    message.
    """
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

    A normal is the mean of the normals of the faces around the corner, weighted by
    their angles at the corner. Only faces at less than 35 degrees to the triangle
    count, so creases stay sharp.
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
