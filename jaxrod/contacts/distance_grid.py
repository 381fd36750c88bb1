r"""Bodies of any shape, given by signed distances at the points of a regular grid.

Between the points the distance is a quadratic B-spline in each coordinate. With the
nearest grid point $i$ along an axis, and the coordinate $f$ from there in units of the
spacing, $-\frac12 \le f \le \frac12$, the weights of the points $i - 1$, $i$, $i + 1$
are

$$\tfrac12 (\tfrac12 - f)^2, \qquad \tfrac34 - f^2, \qquad \tfrac12 (\tfrac12 + f)^2,$$

so 27 coefficients give a distance and its gradient. Coefficients are chosen so that the
spline has the given distances at the grid points. The gradient is continuous, linear
distances are exact, and a force along it has an energy. Linear interpolation between
eight points would be cheaper, but its gradient jumps from cell to cell, and a rod that
slides would be knocked at every cell.

Where the nearest point of a surface is not unique the gradient is shorter than one, and
passes through zero; within a cell or two of such places, and of edges of the surface,
distances are rounded off.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body, Solid, with_length
from jaxrod.geometry import surfaces, vectors
from jaxrod.geometry.mesh_distance import closed_surface, grid_distances
from jaxrod.geometry.rotations import (
    conjugate,
    directors,
    multiply_quaternions,
    normalise,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.surfaces import Triangles
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree
from jaxrod.validation import (
    Numbers,
    as_array,
    check_array,
    is_traced,
    knows_constants,
    numeric,
    warn,
)

MOST_POINTS = 2**24
"""Largest number of points of a grid made from a mesh: 256 along each axis."""
CELLS = 60
"""Number of cells along the longest side of a mesh, unless a spacing is given."""


class CoarseGridWarning(UserWarning):
    """Warning that the grid of a body is too coarse or too small for a rod.

    Example:
        >>> import warnings
        >>> x, y, z = np.indices((4, 4, 4)) * 0.5  # coarser than the rod is thick
        >>> ground = shapes.signed_distance_grid(z - 0.5, 0.5)
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     _ = jaxrod.make_scene(rod, jaxrod.contact(ground, stiffness=1e4))
        >>> caught[0].category.__name__
        'CoarseGridWarning'
    """


@pytree
class SignedDistanceGrid(Body):
    """A body of any shape, from signed distances at the points of a regular grid.

    Example:
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        >>> faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
        >>> tetrahedron = shapes.from_mesh(corners, faces, spacing=0.05)
        >>> place = jnp.full(1, 0.2), jnp.full(1, 0.2), jnp.full(1, -0.06)
        >>> distance, normal = tetrahedron.surface(place)
        >>> round(float(distance[0]), 3), round(float(normal[2][0]), 3)
        (0.06, -1.0)
        >>> lumen = tetrahedron.complement()  # everything else
        >>> round(float(lumen.surface(place)[0][0]), 3)
        -0.06
    """

    coefficients: Float[Array, "nx ny nz"]
    """Coefficients of the spline [m]: one for each grid point, and one more beyond the
    grid at each side."""
    spacing: Float[Array, ""]
    """Distance between neighbouring grid points [m]."""
    corner: Float[Array, "3"]
    """Position of the first grid point [m]."""
    orientation: Float[Array, "4"]
    """Quaternion (w, x, y, z) from the grid's axes to the world, of any length."""
    beyond: Float[Array, ""]
    """Growth of the distance with the distance from the grid, outside of it: 1 if the
    body ends inside the grid, -1 if its complement does, 0 if neither does [1]."""

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Signed distance and its gradient.

        Outside the grid the distance is that of the nearest point of the grid, plus
        `beyond` times the distance from there.
        """
        frame = directors(normalise(split_quaternion(self.orientation)))
        own = to_material(frame, vectors.subtract(points, vectors.split(self.corner)))
        x, y, z = (
            _place(own[k], self.spacing, self.coefficients.shape[k] - 2)
            for k in range(3)
        )
        distance, slopes = self._interpolated(x, y, z)
        away = x.away, y.away, z.away
        square = vectors.dot(away, away)
        is_outside = square > 0
        length = jnp.sqrt(jnp.where(is_outside, square, 1))
        outwards = vectors.scale(jnp.where(is_outside, self.beyond / length, 0), away)
        distance = distance + jnp.where(is_outside, self.beyond * length, 0)
        return distance, to_world(frame, vectors.add(slopes, outwards))

    def _interpolated(self, x: _Place, y: _Place, z: _Place) -> tuple[Array, Vec3]:
        """Value of the spline [m] and its gradient [1], in the axes of the grid."""
        sizes = self.coefficients.shape
        strides = (sizes[1] * sizes[2], sizes[2], 1)
        first = x.first * strides[0] + y.first * strides[1] + z.first
        # One table of all 27 coefficients of all points, because XLA's CPU compiler
        # gives up on some programs with several (CONTRIBUTING.md).
        steps = np.array(
            [
                i * strides[0] + j * strides[1] + k
                for i, j, k in itertools.product(range(3), repeat=3)
            ],
            np.int32,
        )
        table = self.coefficients.reshape(-1)
        found = table.at[first[None] + steps.reshape(-1, *[1] * first.ndim)].get(
            mode="clip"
        )
        total = [jnp.zeros_like(z.weights[0])] * 4
        for i in range(3):
            along_y = [jnp.zeros_like(z.weights[0])] * 3
            for j in range(3):
                row = found[9 * i + 3 * j : 9 * i + 3 * j + 3]
                value = sum(w * c for w, c in zip(z.weights, row, strict=True))
                slope = sum(w * c for w, c in zip(z.slopes, row, strict=True))
                weight, steep = y.weights[j], y.slopes[j]
                parts = (weight * value, steep * value, weight * slope)
                along_y = [a + b for a, b in zip(along_y, parts, strict=True)]
            weight, (value, slope_y, slope_z) = x.weights[i], along_y
            parts_of_x = (
                weight * value,
                x.slopes[i] * value,
                weight * slope_y,
                weight * slope_z,
            )
            total = [a + b for a, b in zip(total, parts_of_x, strict=True)]
        return total[0], (total[1], total[2], total[3])

    def complement(self) -> SignedDistanceGrid:
        """The body with inside and outside exchanged, such as the wall of a vessel.

        Inside a vessel the distance from its wall is positive, and contact pushes a rod
        back inside, beyond the grid too.

        Example:
            >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
            >>> faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
            >>> room = shapes.from_mesh(corners, faces, spacing=0.05).complement()
            >>> inside = jnp.full(1, 0.1), jnp.full(1, 0.2), jnp.full(1, 0.2)
            >>> distance, normal = room.surface(inside)  # from the nearest wall
            >>> round(float(distance[0]), 3), round(float(normal[0][0]), 1)
            (0.1, 1.0)
        """
        return SignedDistanceGrid(
            -self.coefficients,
            self.spacing,
            self.corner,
            self.orientation,
            -self.beyond,
        )

    @property
    def values(self) -> Float[Array, "nx ny nz"]:
        """Signed distances at the grid points [m]."""
        found = self.coefficients
        for axis in (-3, -2, -1):
            one, two, three = (
                jax.lax.slice_in_dim(found, k, found.shape[axis] - 2 + k, axis=axis)
                for k in range(3)
            )
            found = (one + 6 * two + three) / 8
        return found

    @property
    def count(self) -> int | None:
        """Number of bodies: the length of a leading axis; `None` for a single one."""
        if self.spacing.ndim > 1:
            raise ValueError(
                f"bodies must have at most one leading axis, got {self.spacing.shape}"
            )
        return self.spacing.shape[0] if self.spacing.ndim else None

    @property
    def inradius(self) -> Array:
        """Largest depth at a grid point [m]; infinite if the body leaves the grid."""
        deepest = -jnp.min(self.values, axis=(-3, -2, -1))
        return jnp.where(self.beyond > 0, deepest, jnp.inf)

    @property
    def bounding_radius(self) -> Array:
        """Largest distance of a cell with a part of the body from the origin [m]."""
        corners = jnp.sum(self._world_points() ** 2, axis=0)
        square = jnp.max(jnp.where(self.values <= 0, corners, 0))
        return jnp.sqrt(square) + np.sqrt(3.0) * self.spacing

    def check(self, rod: Rod) -> None:
        """Warns if cells are larger than the rod's radius, or the grid ends too near.

        Beyond the grid distances are too large by up to a factor of two or so, so the
        grid must extend beyond the surface by the rod's radius.
        """
        if is_traced(self, rod):
            return
        radii, spacing = np.ravel(rod.radii), float(np.max(self.spacing))
        if spacing > np.min(radii) * (1 + 1e-6):
            warn(
                f"the grid points of a body are {spacing:.3g} m apart, more than the "
                f"rod's radius, {np.min(radii):.3g} m: smaller features are lost. If "
                "its vertices are in metres, give from_mesh a smaller spacing; else "
                "multiply them by their unit [m].",
                CoarseGridWarning,
            )
        single = self.count is None and float(self.beyond) > 0
        margin = float(np.min(_boundary(self.values))) if single else math.inf
        if margin < np.max(radii) * (1 - 1e-6):
            warn(
                f"the grid of a body ends {margin:.3g} m from its surface, nearer than "
                f"the rod's radius, {np.max(radii):.3g} m: give from_mesh "
                f"margin={np.max(radii):.3g}",
                CoarseGridWarning,
            )

    def solid(self) -> Solid:
        """Volume, centre of mass and inertia, from the part of each cell in the body.

        A cell counts by the distance of its middle over the spacing, between zero and
        one. The directions of the principal axes are taken as constants in derivatives.

        Raises:
            ValueError: If the body leaves its grid.
        """
        if not is_traced(self.beyond) and float(self.beyond) <= 0:
            raise ValueError(
                "a body that extends beyond its grid cannot be a moving rigid body: "
                "give it to `contact`"
            )
        share = jnp.clip(0.5 - self.values / self.spacing, 0, 1)
        total = jnp.sum(share)
        places = self._own_points()
        centre = jnp.sum(share[None] * places, axis=(1, 2, 3)) / total
        x, y, z = places - centre[:, None, None, None]
        # Shares are those of a surface that is blurred over the width of a cell.
        blur = self.spacing * self.spacing / 12

        def mean(a: Array, b: Array) -> Array:
            return jnp.sum(share * a * b) / total

        xx, yy, zz = mean(x, x) - blur, mean(y, y) - blur, mean(z, z) - blur
        xy, xz, yz = -mean(x, y), -mean(x, z), -mean(y, z)
        inertia = jnp.stack(
            [
                jnp.stack([yy + zz, xy, xz]),
                jnp.stack([xy, xx + zz, yz]),
                jnp.stack([xz, yz, xx + yy]),
            ]
        )
        axes = jnp.linalg.eigh(jax.lax.stop_gradient(inertia))[1]
        axes = axes * jnp.sign(jnp.linalg.det(axes))
        moments = jnp.sum(
            axes * jnp.sum(inertia[:, :, None] * axes[None], axis=1), axis=0
        )
        turn = _quaternion(axes)
        grid = normalise(split_quaternion(self.orientation))
        own = vectors.split(-centre)
        shape = SignedDistanceGrid(
            self.coefficients,
            self.spacing,
            jnp.stack(to_material(directors(turn), own)),
            jnp.stack(conjugate(turn)),
            self.beyond,
        )
        return Solid(
            shape,
            self.corner + jnp.stack(to_world(directors(grid), vectors.split(centre))),
            jnp.stack(multiply_quaternions(grid, turn)),
            total * self.spacing**3,
            moments,
        )

    def mesh(self) -> Triangles:
        """Triangles of the surface inside the grid, for drawing."""
        counts = np.array(self.coefficients.shape) - 2
        spacing = float(self.spacing)
        plain = SignedDistanceGrid(
            self.coefficients,
            self.spacing,
            jnp.zeros_like(self.corner),
            jnp.asarray([1.0, 0.0, 0.0, 0.0], self.orientation.dtype),
            self.beyond,
        )

        def distance(points: np.ndarray) -> tuple[Any, Any]:
            own = jnp.asarray(points.T, self.corner.dtype)
            found, normal = _surface(plain, own)
            return np.asarray(found), np.asarray(normal).T

        corners, faces = surfaces.of_distance(
            distance, np.zeros(3), spacing * (counts - 1), int(max(counts)) - 1
        )
        frame = directors(normalise(split_quaternion(self.orientation)))
        axes = np.array([[float(x) for x in axis] for axis in frame])
        return np.asarray(self.corner) + corners @ axes, faces

    def _own_points(self) -> Float[Array, "3 nx ny nz"]:
        """Positions of the grid points, from the first and in the grid's axes [m]."""
        counts = [n - 2 for n in self.coefficients.shape]
        return self.spacing * jnp.asarray(np.indices(counts), self.spacing.dtype)

    def _world_points(self) -> Float[Array, "3 nx ny nz"]:
        """Positions of the grid points [m]."""
        frame = directors(normalise(split_quaternion(self.orientation)))
        turned = jnp.stack(to_world(frame, vectors.split(self._own_points())))
        return self.corner[:, None, None, None] + turned


class _Place(NamedTuple):
    """Places of points along one axis of a grid, and the spline's weights there."""

    first: Array
    """Index of the first of three coefficients."""
    weights: tuple[Array, Array, Array]
    """Weights of the coefficients [1]."""
    slopes: tuple[Array, Array, Array]
    """Derivatives of the weights [1/m]; zero outside the grid."""
    away: Array
    """Distance from the grid, negative below its first point; zero inside [m]."""


def _place(own: Array, spacing: Array, count: int) -> _Place:
    """Places for the coordinates `own` [m], on an axis with `count` grid points."""
    place = own / spacing
    inside = jnp.clip(place, 0, count - 1)
    nearest = jnp.floor(inside + 0.5)
    f = inside - nearest
    low, high = 0.5 - f, 0.5 + f
    per = jnp.where(place == inside, 1 / spacing, 0)
    return _Place(
        first=nearest.astype(jnp.int32),
        weights=(0.5 * low * low, 0.75 - f * f, 0.5 * high * high),
        slopes=(-per * low, -2 * per * f, per * high),
        away=spacing * (place - inside),
    )


@jax.jit
def _surface(body: Body, points: Float[Array, "3 n"]) -> tuple[Array, Array]:
    distance, normal = body.surface(vectors.split(points))
    return distance, vectors.join(normal)


def _quaternion(axes: Float[Array, "3 3"]) -> tuple[Array, Array, Array, Array]:
    """Quaternion of the rotation with the columns `axes` of its matrix."""
    (a, b, c), (d, e, f), (g, h, i) = axes
    candidates = jnp.stack(
        [
            jnp.stack([1 + a + e + i, h - f, c - g, d - b]),
            jnp.stack([h - f, 1 + a - e - i, b + d, c + g]),
            jnp.stack([c - g, b + d, 1 - a + e - i, f + h]),
            jnp.stack([d - b, c + g, f + h, 1 - a - e + i]),
        ]
    )
    # Each row is the quaternion times four of its components: take the longest.
    longest = candidates[jnp.argmax(jnp.diagonal(candidates))]
    return normalise(split_quaternion(longest))


def _boundary(values: Any) -> Any:
    """All values on the six sides of a grid, in one row."""
    last = [n - 1 for n in values.shape]
    sides = (values[:: last[0]], values[:, :: last[1]], values[:, :, :: last[2]])
    return (jnp if is_traced(values) else np).concatenate([s.ravel() for s in sides])


def _to_coefficients(count: int) -> np.ndarray:
    """Matrix from distances at `count` points to coefficients, along one axis.

    The spline has the given distances at the points, and its ends continue straight.
    """
    rows = np.eye(count + 2)
    for k in range(1, count + 1):
        rows[k, k - 1 : k + 2] = 1 / 8, 6 / 8, 1 / 8
    for end, step in ((0, 1), (count + 1, -1)):
        rows[end, [end, end + step, end + 2 * step]] = 1, -2, 1
    return np.linalg.inv(rows)[:, 1:-1]


# Factories, called by users. They check their arguments and report what is wrong.


def signed_distance_grid(
    values: Numbers,
    spacing: Numbers,
    corner: Numbers = (0.0, 0.0, 0.0),
    orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
) -> SignedDistanceGrid:
    """A fixed body from signed distances at the points of a grid.

    Args:
        values: Signed distances, negative inside `(nx, ny, nz)`, with at least three
            points along each axis [m].
        spacing: Distance between neighbouring grid points, equal along all axes [m].
        corner: Position of the first grid point `(3,)` [m].
        orientation: Orientation of the grid's axes, a quaternion (w, x, y, z).

    Raises:
        ValueError: If there are fewer than three points along an axis, or a number
            cannot be stored.

    Example:
        >>> x, y, z = np.meshgrid(*[np.linspace(-1, 1, 21)] * 3, indexing="ij")
        >>> saddle = shapes.signed_distance_grid(z - 0.2 * x * y, 0.1, (-1, -1, -1))
        >>> distance, normal = saddle.surface(motion.position)
        >>> round(float(abs(distance[5])), 3)  # the rod is at y = z = 0
        0.0
    """
    found = numeric("values", values, "m")
    shape = found.shape
    if len(shape) != 3 or min(shape) < 3:
        raise ValueError(
            "values must have shape (nx, ny, nz) with at least 3 points along each "
            f"axis, got {shape}"
        )
    dtype = jnp.result_type(float)
    found = check_array("values", found, [shape], "m", dtype=dtype)
    numbers: Any = jnp if is_traced(found) else np
    coefficients = found
    for axis, count in enumerate(shape):
        matrix = numbers.asarray(_to_coefficients(count), found.dtype)
        columns = numbers.moveaxis(coefficients, axis, 0).reshape(count, -1)
        # Products to full precision, on accelerators too.
        with jax.default_matmul_precision("highest"):
            spread = matrix @ columns
        rest = [n for k, n in enumerate(coefficients.shape) if k != axis]
        coefficients = numbers.moveaxis(spread.reshape(-1, *rest), 0, axis)
    sides = _boundary(found)
    beyond = jnp.where(sides.min() > 0, 1.0, jnp.where(sides.max() < 0, -1.0, 0))
    return SignedDistanceGrid(
        coefficients=jnp.asarray(coefficients, dtype),
        spacing=as_array("spacing", spacing, "m", positive=True),
        corner=as_array("corner", corner, "m", [(3,)]),
        orientation=with_length("orientation", orientation, [(4,)]),
        beyond=jnp.asarray(beyond, dtype),
    )


@knows_constants
def from_mesh(
    vertices: Any,
    faces: Any,
    *,
    spacing: float | None = None,
    margin: float | None = None,
    position: Numbers = (0.0, 0.0, 0.0),
    orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
) -> SignedDistanceGrid:
    """A fixed body from a closed surface of triangles.

    The distances at the grid points are those from the triangles. They are computed
    once, in NumPy, which takes seconds; `jaxrod.save` keeps the body. A step costs the
    same for any number of triangles and grid points.

    Args:
        vertices: Corners of the triangles `(v, 3)` [m].
        faces: Indices of the three corners of each triangle `(f, 3)`. All are listed
            counterclockwise seen from outside, or all clockwise.
        spacing: Distance between neighbouring grid points; by default a sixtieth of the
            longest side of the mesh [m]. It should be smaller than the features of the
            body that matter, and than the radius of the rod.
        margin: Distance from the mesh to the end of the grid; by default a tenth of the
            longest side of the mesh. It should be larger than the radius of the rod
            [m].
        position: Displacement of the mesh `(3,)` [m].
        orientation: Rotation of the mesh about its origin, before the displacement, a
            quaternion (w, x, y, z).

    Raises:
        ValueError: If the surface is not closed, not oriented or without volume, or if
            the grid is too coarse for the mesh or too large.

    Example:
        >>> corners = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
        >>> quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1]]
        >>> quads += [[2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
        >>> faces = [t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])]
        >>> cube = shapes.from_mesh(corners, faces, spacing=0.1, position=(0, 0, -1.2))
        >>> distance, normal = cube.surface(motion.position)
        >>> round(float(distance[5]), 3)  # from the rod to the top of the cube
        0.2
    """
    corners = numeric("vertices", vertices, "m")
    corners = check_array("vertices", corners, [corners.shape], "m")
    if is_traced(corners):
        raise ValueError(
            "vertices must be known numbers: the distances are computed in NumPy. Move "
            "the body by position and orientation, which may be traced"
        )
    if corners.ndim != 2 or corners.shape[1] != 3:
        raise ValueError(f"vertices must have shape (v, 3) [m], got {corners.shape}")
    surface = closed_surface(corners, _checked_faces(faces, len(corners)))
    low, high = surface[0].min(axis=0), surface[0].max(axis=0)
    sides = high - low
    size = " x ".join(f"{side:.3g}" for side in sides)
    step = float(np.max(sides)) / CELLS
    if spacing is not None:
        step = _known("spacing", spacing)
    if step > 0.5 * np.min(sides):
        raise ValueError(
            f"spacing must be at most half the shortest side of the mesh, which is "
            f"{size} m in size, got {step:.3g} m"
        )
    room = 0.1 * float(np.max(sides))
    if margin is not None:
        room = _known("margin", margin)
    with np.errstate(over="ignore"):
        cells = np.ceil((sides + 2 * room) / step - 1e-6)
        n_points = float(np.prod(cells + 1))
    if n_points > MOST_POINTS:
        raise ValueError(
            f"a spacing of {step:.3g} m for a mesh of {size} m with a margin of "
            f"{room:.3g} m makes {n_points:.2g} grid points, more "
            f"than {MOST_POINTS:.2g}. If the unit of the mesh is the millimetre, "
            "multiply its vertices by 1e-3; otherwise give a larger spacing"
        )
    counts = cells.astype(int) + 1
    # Equal margins on both sides.
    first = 0.5 * (low + high) - 0.5 * step * (counts - 1)
    a, b, c = (int(n) for n in counts)
    values = grid_distances(surface, first, step, (a, b, c))
    turn = with_length("orientation", orientation, [(4,)])
    frame = directors(normalise(split_quaternion(turn)))
    place = vectors.split(jnp.asarray(first, turn.dtype))
    corner = jnp.stack(to_world(frame, place))
    corner = corner + as_array("position", position, "m", [(3,)])
    return signed_distance_grid(values, step, corner, turn)


def _known(name: str, value: Numbers) -> float:
    """A positive length that is known outside of programs [m]; `name` is for errors."""
    checked = check_array(name, value, [()], "m", positive=True)
    if is_traced(checked):
        raise ValueError(f"{name} must be a known number, not one that JAX traces")
    return float(checked)


def _checked_faces(faces: Any, n_vertices: int) -> np.ndarray:
    """Indices of the corners of each face, checked."""
    found = numeric("faces", faces)
    if is_traced(found) or found.ndim != 2 or found.shape[1] != 3:
        raise ValueError(
            "faces must be known indices of shape (f, 3), the corners of each "
            f"triangle, got shape {found.shape}"
        )
    if not len(found):
        raise ValueError("faces must be at least four triangles, got none")
    wrong = (found != np.floor(found)) | (found < 0) | (found >= n_vertices)
    if np.any(wrong):
        raise ValueError(
            f"faces must be indices of vertices, from 0 to {n_vertices - 1}, got "
            f"{found[wrong][0]:g}"
        )
    return found.astype(np.int64)


def load_mesh(path: Any, unit: float = 1.0) -> Triangles:
    r"""Triangles of an STL file (binary or text) or an OBJ file, for `from_mesh`.

    It needs the extra `mesh`: `pip install "jaxrod[mesh]"`.

    Args:
        path: Path of the file.
        unit: Length of the file's unit [m]: 1e-3 for millimetres.

    Returns:
        Vertices `(v, 3)` [m], and faces `(f, 3)`.

    Raises:
        ImportError: If trimesh is not installed.
        ValueError: If the file has no triangles.

    Example:
        >>> text = "v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\n"
        >>> text += "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
        >>> with open("corner.obj", "w") as file:
        ...     _ = file.write(text)
        >>> vertices, faces = shapes.load_mesh("corner.obj", unit=1e-3)
        >>> vertices.max(axis=0).round(4).tolist(), len(faces)
        ([0.009, 0.009, 0.009], 4)
    """
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(
            'load_mesh needs trimesh: pip install "jaxrod[mesh]". If you have '
            "the triangles already, give them to from_mesh"
        ) from error
    scale = _known("unit", unit)
    found = trimesh.load_mesh(path)
    faces = np.asarray(getattr(found, "faces", ()), np.int64).reshape(-1, 3)
    if not len(faces):
        raise ValueError(f"{path} has no triangles")
    return scale * np.asarray(found.vertices, float), faces
