r"""Fixed bodies that a rod can touch, each given by its signed distance.

A body gives, at any point, the distance to its surface (negative inside) and the
outward unit normal there, which is the distance's gradient. Its parameters are traced:
`vmap` over a body makes random obstacles, `grad` with respect to it moves an obstacle.

Values and gradients are finite everywhere. Where the nearest point of a surface is not
unique (the centre of a sphere, the axis of a cylinder) distances are smoothed within
a millionth of the radius, $\sqrt{x^2 + \delta^2}$ in place of $|x|$, and the normal
passes through zero; between the faces of a box it jumps.

Factories make one body. `jax.vmap` of a factory makes many of one kind at once, as
`jaxrod.contact` takes them.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.geometry import surfaces, vectors
from jaxrod.geometry.rotations import (
    directors,
    normalise,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.surfaces import Triangles
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree, static
from jaxrod.validation import (
    Numbers,
    as_array,
    check_array,
    is_traced,
    with_parameters,
)

IDENTITY = (1.0, 0.0, 0.0, 0.0)
"""Quaternion of no rotation."""


@pytree
class Solid:
    """A shape in the frame of its principal axes, and the pose of this frame.

    Example:
        >>> solid = shapes.sphere((0.0, 0.0, 1.0), 0.1).solid()
        >>> round(float(solid.volume), 5), solid.centre.tolist()
        (0.00419, [0.0, 0.0, 1.0])
    """

    shape: Any
    """The shape with its centre of mass at the origin and along its principal axes."""
    centre: Float[Array, "3"]
    """Centre of mass [m]."""
    orientation: Float[Array, "4"]
    """Quaternion (w, x, y, z) from the principal axes to the world."""
    volume: Float[Array, ""] | None = None
    """Volume [m^3]; `None` if it is not known."""
    gyration: Float[Array, "3"] | None = None
    """Moments of inertia about the principal axes divided by the mass, at uniform
    density [m^2]; `None` if they are not known."""


def ends_along_z(half: Array) -> tuple[Array, Array]:
    """End points (0, 0, -half) and (0, 0, half) of an axis [m]."""
    zero = jnp.zeros_like(half)
    end = jnp.stack([zero, zero, half])
    return -end, end


def pose_of_axis(start: Array, end: Array) -> tuple[Array, Array, Array]:
    """Midpoint [m], quaternion that turns z into the axis, and half the length [m]."""
    way = end - start
    length = jnp.sqrt(jnp.sum(way * way))
    x, y, z = vectors.split(way / length)
    # The shortest rotation from z; a half turn about x where the axis points to -z.
    w = 1 + z
    back = w < 1e-6
    square = jnp.where(back, 1, 2 * w)
    root = jnp.sqrt(square)
    zero = jnp.zeros_like(w)
    q = jnp.stack([root / 2, -y / root, x / root, zero])
    half_turn = jnp.stack([zero, jnp.ones_like(w), zero, zero])
    return 0.5 * (start + end), jnp.where(back, half_turn, q), 0.5 * length


_ROUNDED = 1e-6
"""Smoothing length d in sqrt(x^2 + d^2) for |x|, divided by a body's size [1]."""


class Body(ABC):
    """Base class of all bodies, which are given by signed distance and normal.

    Example:
        >>> @extend.pytree
        ... class Ground(shapes.Body):
        ...     height: jax.Array  # [m]
        ...
        ...     def surface(self, points):
        ...         x, y, z = points
        ...         zero = jnp.zeros_like(z)
        ...         return z - self.height, (zero, zero, zero + 1.0)
        >>> distance, normal = Ground(-0.5).surface(motion.position)
        >>> distance[:2].tolist()
        [0.5, 0.5]
    """

    @abstractmethod
    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Signed distance [m], negative inside, and outward normal at each point."""

    def of_ends(self) -> Body:
        """Body at the first and last point; the same body unless it is `OneForEach`."""
        return self

    @property
    def count(self) -> int | None:
        """Number of bodies, from a leading axis; `None` for a single one."""
        return None

    @property
    def inradius(self) -> Array | None:
        """Radius of the largest ball inside the body [m]; `None` if it is not known."""
        return None

    @property
    def bounding_radius(self) -> Array | None:
        """Largest distance of the surface from the origin [m], for `stable_dt`.

        By default it is not known: `None`. Then a moving body is assumed to be convex
        and of uniform density, which limits this distance by its moments of inertia.
        The bodies of this module do not need it.
        """
        return None

    def solid(self) -> Solid:
        """Centre of mass, principal axes, volume and inertia.

        By default the centre of mass is at the origin, and the others are not known.
        """
        return Solid(self, jnp.zeros(3), jnp.asarray(IDENTITY))

    def check(self, rod: Rod) -> None:
        """Warns if contact with a rod is inaccurate; by default never."""
        return

    def mesh(self) -> Triangles | None:
        """Triangles of the surface, for drawing.

        By default there are none: drawing then samples the signed distance.
        """
        return None

    @property
    def is_convex(self) -> bool:
        """Whether the body is known to be convex; not by default.

        A body that touches a convex one does so near few of its surface points, which
        allows longer steps.
        """
        return False

    @property
    def is_half_space(self) -> bool:
        """Whether the body is a half space, which cannot be a moving body."""
        return False

    @property
    def row_of_balls(self) -> tuple[Array, Array, Array] | None:
        """First centre, last centre and radius of a row of balls along the body [m].

        The row extends from end to end. It is `None` for bodies without such a row.
        """
        return None


@pytree
class Sphere(Body):
    """A ball.

    Example:
        >>> ball = shapes.sphere((0.0, 0.0, 0.0), 0.25)
        >>> one, zero = jnp.ones(1), jnp.zeros(1)
        >>> distance, normal = ball.surface((one, zero, zero))
        >>> float(distance[0]), float(normal[0][0])
        (0.75, 1.0)
        >>> round(float(ball.solid().volume), 4)
        0.0654
    """

    centre: Float[Array, "3"]
    """Centre [m]."""
    radius: Float[Array, ""]
    """Radius [m]."""

    is_convex = True

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Distance from the centre minus the radius, and the normal."""
        return _round(_from_point(self.centre, points), self.radius)

    @property
    def count(self) -> int | None:
        """Number of bodies: the length of a leading axis; `None` for a single one."""
        return _count(self.radius.shape)

    @property
    def inradius(self) -> Array:
        """Radius of the sphere [m]."""
        return self.radius

    def solid(self) -> Solid:
        r"""Volume $4 \pi r^3 / 3$, and moments of inertia $2 r^2 / 5$ per mass."""
        radius = self.radius
        square = 0.4 * radius * radius
        return Solid(
            Sphere(jnp.zeros_like(self.centre), radius),
            self.centre,
            jnp.asarray(IDENTITY, radius.dtype),
            4 / 3 * jnp.pi * radius * radius * radius,
            jnp.stack([square, square, square]),
        )

    def mesh(self) -> Triangles:
        """Triangles of the surface of the ball, for drawing."""
        corners, faces = surfaces.ball(float(self.radius))
        return np.asarray(self.centre) + corners, faces


@pytree
class Capsule(Body):
    """A cylinder with a hemispherical cap at each end.

    Example:
        >>> pill = shapes.capsule((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), 0.5)
        >>> one, zero = jnp.ones(1), jnp.zeros(1)
        >>> distance, normal = pill.surface((3.0 * one, zero, zero))
        >>> round(float(distance[0]), 3)
        0.5
    """

    start: Float[Array, "3"]
    """Centre of the hemisphere at one end [m]."""
    end: Float[Array, "3"]
    """Centre of the hemisphere at the other end [m]."""
    radius: Float[Array, ""]
    """Radius [m]."""

    is_convex = True

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Distance from the segment of centres, minus the radius; and the normal."""
        axis = vectors.split(self.end - self.start)
        relative = _from_point(self.start, points)
        share = vectors.dot(relative, axis) / vectors.dot(axis, axis)
        nearest = vectors.scale(jnp.clip(share, 0, 1), axis)
        return _round(vectors.subtract(relative, nearest), self.radius)

    @property
    def count(self) -> int | None:
        """Number of bodies: the length of a leading axis; `None` for a single one."""
        return _count(self.radius.shape)

    @property
    def inradius(self) -> Array:
        """Radius of the cylinder [m]."""
        return self.radius

    def solid(self) -> Solid:
        """Volume, and moments of inertia per mass, about the axis and across it."""
        centre, orientation, half = pose_of_axis(self.start, self.end)
        radius, square = self.radius, self.radius * self.radius
        middle = 2 * jnp.pi * square * half
        balls = 4 / 3 * jnp.pi * square * radius
        # Half balls: 2/5 r^2 about the centre of the ball; the centre of mass of a half
        # ball is 3/8 r away from there.
        beyond = 0.4 * square + half * half + 0.75 * half * radius
        across = middle * (square / 4 + half * half / 3) + balls * beyond
        along = middle * square / 2 + balls * 0.4 * square
        volume = middle + balls
        return Solid(
            Capsule(*ends_along_z(half), radius),
            centre,
            orientation,
            volume,
            jnp.stack([across, across, along]) / volume,
        )

    def mesh(self) -> Triangles:
        """Triangles of the cylinder and its hemispherical caps, for drawing."""
        start, end = np.asarray(self.start), np.asarray(self.end)
        half = float(np.linalg.norm(end - start)) / 2
        return surfaces.along(surfaces.capsule(half, float(self.radius)), start, end)

    @property
    def row_of_balls(self) -> tuple[Array, Array, Array]:
        """Centres of the two hemispherical caps, and their radius [m]."""
        return self.start, self.end, self.radius


@pytree
class Cylinder(Body):
    """A cylinder with flat ends.

    Example:
        >>> post = shapes.cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.5)
        >>> round(float(post.solid().volume), 3), post.solid().centre.tolist()
        (1.571, [0.0, 0.0, 1.0])
    """

    start: Float[Array, "3"]
    """Centre of one end [m]."""
    end: Float[Array, "3"]
    """Centre of the other end [m]."""
    radius: Float[Array, ""]
    """Radius [m]."""

    is_convex = True

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Distance and normal, from the distances to curved side and nearer end."""
        axis, length, along, across = _about_axis(self.start, self.end, points)
        beside, outwards = _round(across, self.radius)
        end_face = jnp.abs(along) - 0.5 * length
        size = jnp.minimum(self.radius, 0.5 * length)
        distance, (mantle, end) = _corner((beside, end_face), size)
        normal = vectors.add(
            vectors.scale(mantle, outwards), vectors.scale(end * _sign(along), axis)
        )
        return distance, normal

    @property
    def count(self) -> int | None:
        """Number of bodies: the length of a leading axis; `None` for a single one."""
        return _count(self.radius.shape)

    @property
    def inradius(self) -> Array:
        """Smaller of the radius and half the length of the cylinder [m]."""
        x, y, z = jnp.moveaxis(self.end - self.start, -1, 0)
        return jnp.minimum(self.radius, 0.5 * vectors.safe_norm((x, y, z)))

    def solid(self) -> Solid:
        """Volume, and moments of inertia per mass, about the axis and across it."""
        centre, orientation, half = pose_of_axis(self.start, self.end)
        square = self.radius * self.radius
        across = square / 4 + half * half / 3
        return Solid(
            Cylinder(*ends_along_z(half), self.radius),
            centre,
            orientation,
            2 * jnp.pi * square * half,
            jnp.stack([across, across, square / 2]),
        )

    def mesh(self) -> Triangles:
        """Triangles of the curved side and the ends, for drawing."""
        start, end = np.asarray(self.start), np.asarray(self.end)
        half = float(np.linalg.norm(end - start)) / 2
        return surfaces.along(surfaces.cylinder(half, float(self.radius)), start, end)

    @property
    def row_of_balls(self) -> tuple[Array, Array, Array]:
        """Points on the axis, a radius from each end, and the radius [m]."""
        middle = 0.5 * (self.start + self.end)
        axis = self.end - self.start
        length = jnp.sqrt(jnp.sum(axis * axis))
        way = jnp.maximum(0.5 - self.radius / length, 0) * axis
        return middle - way, middle + way, self.radius


@pytree
class Pipe(Body):
    """A straight pipe with a round bore, open at both ends.

    Example:
        >>> sheath = shapes.pipe((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.5, thickness=0.1)
        >>> round(float(sheath.solid().volume), 3), round(float(sheath.inradius), 3)
        (0.691, 0.6)
    """

    start: Float[Array, "3"]
    """Centre of one end [m]."""
    end: Float[Array, "3"]
    """Centre of the other end [m]."""
    radius: Float[Array, ""]
    """Radius of the bore [m]."""
    thickness: Float[Array, ""]
    """Thickness of the wall [m]."""

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Distance and normal, from the distances to bore, mantle and nearer end."""
        axis, length, along, across = _about_axis(self.start, self.end, points)
        half = 0.5 * self.thickness
        beyond, outwards = _round(across, self.radius + half)
        beside = jnp.abs(beyond) - half
        end_face = jnp.abs(along) - 0.5 * length
        size = jnp.minimum(half, 0.5 * length)
        distance, (side, end) = _corner((beside, end_face), size)
        normal = vectors.add(
            vectors.scale(side * _sign(beyond), outwards),
            vectors.scale(end * _sign(along), axis),
        )
        return distance, normal

    @property
    def count(self) -> int | None:
        """Number of bodies: the length of a leading axis; `None` for a single one."""
        return _count(self.radius.shape)

    @property
    def inradius(self) -> Array:
        """Smaller of the outer radius and half the length [m].

        The bore does not count, because no wall is thin between two points on one side
        of the wall.
        """
        x, y, z = jnp.moveaxis(self.end - self.start, -1, 0)
        outer = self.radius + self.thickness
        return jnp.minimum(outer, 0.5 * vectors.safe_norm((x, y, z)))

    @property
    def bounding_radius(self) -> Array:
        """Distance of the farther end from the origin, plus the outer radius [m]."""
        ends = jnp.stack([self.start, self.end])
        farther = jnp.max(jnp.sqrt(jnp.sum(ends * ends, axis=-1)), axis=0)
        return farther + self.radius + self.thickness

    def solid(self) -> Solid:
        """Volume, and moments of inertia per mass, about the axis and across it."""
        centre, orientation, half = pose_of_axis(self.start, self.end)
        outer = self.radius + self.thickness
        squares = outer * outer + self.radius * self.radius
        across = squares / 4 + half * half / 3
        wall = self.thickness * (outer + self.radius)
        return Solid(
            Pipe(*ends_along_z(half), self.radius, self.thickness),
            centre,
            orientation,
            2 * jnp.pi * wall * half,
            jnp.stack([across, across, squares / 2]),
        )

    def mesh(self) -> Triangles:
        """Triangles of bore, mantle and rims, for drawing."""
        start, end = np.asarray(self.start), np.asarray(self.end)
        half = float(np.linalg.norm(end - start)) / 2
        bore = float(self.radius)
        around = surfaces.pipe(half, bore, bore + float(self.thickness))
        return surfaces.along(around, start, end)


@pytree
class Plane(Body):
    """Half space below a plane, such as the ground.

    Example:
        >>> floor = shapes.plane((0.0, 0.0, -0.5))
        >>> distance, normal = floor.surface(motion.position)
        >>> distance[:2].tolist(), floor.is_half_space
        ([0.5, 0.5], True)
    """

    point: Float[Array, "3"]
    """Any point of the plane [m]."""
    normal: Float[Array, "3"]
    """Normal that points out of the body, of any length."""

    is_convex = True

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Height above the plane, along its normal, and the unit normal."""
        normal, _ = _unit(self.normal)
        distance = vectors.dot(_from_point(self.point, points), normal)
        x, y, z = (jnp.broadcast_to(c, distance.shape) for c in normal)
        return distance, (x, y, z)

    @property
    def count(self) -> int | None:
        """Number of bodies: the length of a leading axis; `None` for a single one."""
        return _count(self.normal.shape[:-1])

    @property
    def is_half_space(self) -> bool:
        """Always true: a plane bounds a half space."""
        return True

    @property
    def inradius(self) -> Array:
        """Radius of the largest ball inside: infinite [m]."""
        return jnp.full(self.normal.shape[:-1], jnp.inf, self.normal.dtype)

    def solid(self) -> Solid:
        """Raises a ValueError: a half space cannot be a moving body."""
        raise ValueError("a plane cannot be a moving rigid body: use it in `contact`")


@pytree
class Box(Body):
    """A rectangular block.

    Example:
        >>> block = shapes.box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
        >>> float(block.solid().volume), float(block.inradius)
        (48.0, 1.0)
    """

    centre: Float[Array, "3"]
    """Centre [m]."""
    half_lengths: Float[Array, "3"]
    """Distances from the centre to the faces, along the box's own axes [m]."""
    orientation: Float[Array, "4"]
    """Quaternion (w, x, y, z) from the box's axes to the world, of any length."""

    is_convex = True

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Signed distance and normal, from the distances to each pair of faces."""
        frame = directors(normalise(split_quaternion(self.orientation)))
        x, y, z = to_material(frame, _from_point(self.centre, points))
        a, b, c = self.half_lengths[0], self.half_lengths[1], self.half_lengths[2]
        faces = (jnp.abs(x) - a, jnp.abs(y) - b, jnp.abs(z) - c)
        distance, shares = _corner(faces, jnp.min(self.half_lengths))
        own = (shares[0] * _sign(x), shares[1] * _sign(y), shares[2] * _sign(z))
        return distance, to_world(frame, own)

    @property
    def count(self) -> int | None:
        """Number of bodies: the length of a leading axis; `None` for a single one."""
        return _count(self.centre.shape[:-1])

    @property
    def inradius(self) -> Array:
        """Half the smallest edge length [m]."""
        return jnp.min(self.half_lengths, axis=-1)

    def solid(self) -> Solid:
        """Volume, and moments of inertia per mass about the box's axes."""
        a, b, c = self.half_lengths * self.half_lengths / 3
        identity = jnp.asarray(IDENTITY, self.half_lengths.dtype)
        orientation = self.orientation / jnp.sqrt(jnp.sum(self.orientation**2))
        return Solid(
            Box(jnp.zeros_like(self.centre), self.half_lengths, identity),
            self.centre,
            orientation,
            8 * jnp.prod(self.half_lengths),
            jnp.stack([b + c, a + c, a + b]),
        )

    def mesh(self) -> Triangles:
        """Triangles of the six faces, for drawing."""
        corners, faces = surfaces.box(np.asarray(self.half_lengths))
        frame = directors(normalise(split_quaternion(self.orientation)))
        axes = np.array([[float(x) for x in axis] for axis in frame])
        return np.asarray(self.centre) + corners @ axes, faces


@pytree
class SignedDistance(Body):
    """Any body, described by a function that gives its signed distance.

    Example:
        >>> def distance_from(point, radius):
        ...     return jnp.sqrt(jnp.sum(point**2) + 1e-12) - radius
        >>> ball = shapes.signed_distance(distance_from, 0.25)
        >>> one, zero = jnp.ones(1), jnp.zeros(1)
        >>> distance, normal = ball.surface((one, zero, zero))
        >>> round(float(distance[0]), 3), round(float(normal[0][0]), 3)
        (0.75, 1.0)
    """

    parameters: Any
    """Traced numbers of the body: any pytree of arrays."""
    function: Callable[[Any, Any], Any] = static()
    """Signed distance [m] at one point `(3,)` [m], given the parameters."""
    ranks: tuple[int, ...] = static()
    """Number of axes of every leaf of the parameters, for a single body."""

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Signed distance and normal: the function and its gradient at each point."""
        at_each = jax.vmap(jax.value_and_grad(self.function), in_axes=(0, None))
        distances, normals = at_each(jnp.stack(points, axis=-1), self.parameters)
        return distances, (normals[:, 0], normals[:, 1], normals[:, 2])

    @property
    def count(self) -> int | None:
        """Number of bodies: the length of a leading axis; `None` for a single one."""
        leaves = jax.tree.leaves(self.parameters)
        leading = {
            leaf.shape[: leaf.ndim - rank]
            for leaf, rank in zip(leaves, self.ranks, strict=True)
        }
        if len(leading) > 1:
            raise ValueError(
                "parameters of several bodies must all have the same leading axis, "
                f"got {sorted(leading)}"
            )
        return _count(leading.pop()) if leading else None


def _count(leading: tuple[int, ...]) -> int | None:
    """Number of bodies, from the leading axes of their arrays.

    It is `None` if there are no leading axes.
    """
    if len(leading) > 1:
        raise ValueError(f"bodies must have at most one leading axis, got {leading}")
    return leading[0] if leading else None


def _from_point(origin: Float[Array, "3"], points: Vec3) -> Vec3:
    return vectors.subtract(points, vectors.split(origin))


def _unit(vector: Float[Array, "3"]) -> tuple[Vec3, Array]:
    """Unit vector along a vector, and the vector's length."""
    components = vectors.split(vector)
    length = jnp.sqrt(vectors.dot(components, components))
    return vectors.scale(1 / length, components), length


def _about_axis(
    start: Array, end: Array, points: Vec3
) -> tuple[Vec3, Array, Array, Vec3]:
    """Unit vector and length of an axis, and parts of points along it and across it.

    The parts are measured from the middle of the axis [m].
    """
    axis, length = _unit(end - start)
    relative = _from_point(0.5 * (start + end), points)
    along = vectors.dot(relative, axis)
    across = vectors.subtract(relative, vectors.scale(along, axis))
    return axis, length, along, across


def _round(relative: Vec3, radius: Array) -> tuple[Array, Vec3]:
    """Signed distance and normal of a ball centred at the origin of `relative`."""
    rounded = (_ROUNDED * radius) * (_ROUNDED * radius)
    length = jnp.sqrt(vectors.dot(relative, relative) + rounded)
    return length - radius, vectors.scale(1 / length, relative)


def _sign(a: Array) -> Array:
    """Sign of a number: -1 if it is negative, else 1."""
    return jnp.where(a < 0, -1, 1).astype(a.dtype)


def _corner(faces: tuple[Array, ...], size: Array) -> tuple[Array, tuple[Array, ...]]:
    """Distance to faces that meet at right angles, and weights of their normals.

    The weighted sum of the normals of the faces is the normal of the body. For a point
    outside of several faces the nearest point is on the edge between them. For a point
    inside only the nearest face counts.

    Args:
        faces: Distance to each face, negative on its inner side [m].
        size: Size of the body, to which the margin for round-off is proportional [m].
    """
    beyond = [jnp.maximum(face, 0) for face in faces]
    squared = sum(b * b for b in beyond)
    is_beyond = squared > (_ROUNDED * size) * (_ROUNDED * size)
    length = jnp.sqrt(jnp.where(is_beyond, squared, 1))
    nearest = faces[0]
    for face in faces[1:]:
        nearest = jnp.maximum(nearest, face)
    shares, taken = [], jnp.zeros_like(is_beyond)
    for face, b in zip(faces, beyond, strict=True):
        is_nearest = (face == nearest) & ~taken
        taken = taken | is_nearest
        shares.append(jnp.where(is_beyond, b / length, is_nearest.astype(b.dtype)))
    return jnp.where(is_beyond, length, nearest), tuple(shares)


# Factories, called by users. They check their arguments and report what is wrong.


def sphere(centre: Numbers, radius: Numbers) -> Sphere:
    """A fixed sphere.

    Args:
        centre: Centre `(3,)` [m].
        radius: Radius [m].

    Raises:
        ValueError: If the centre is not three finite numbers, or the radius is not
            positive.

    Example:
        >>> ball = shapes.sphere((0.5, 0.0, -0.25), radius=0.125)
        >>> distance, normal = ball.surface(motion.position)
        >>> round(float(distance[5]), 3)  # from the middle of the rod [m]
        0.125
    """
    return Sphere(
        as_array("centre", centre, "m", [(3,)]),
        as_array("radius", radius, "m", positive=True),
    )


def capsule(start: Numbers, end: Numbers, radius: Numbers) -> Capsule:
    """A fixed cylinder with round ends.

    Args:
        start: Centre of the hemisphere at one end `(3,)` [m].
        end: Centre of the hemisphere at the other end `(3,)` [m].
        radius: Radius [m].

    Raises:
        ValueError: If the ends are the same, or so near or so far apart that the square
            of their distance leaves the range of the precision.

    Example:
        >>> pill = shapes.capsule((0.5, -1.0, -0.25), (0.5, 1.0, -0.25), radius=0.125)
        >>> distance, normal = pill.surface(motion.position)
        >>> round(float(distance[5]), 3)
        0.125
    """
    ends = _ends(start, end)
    return Capsule(*ends, as_array("radius", radius, "m", positive=True))


def cylinder(start: Numbers, end: Numbers, radius: Numbers) -> Cylinder:
    """A fixed cylinder with flat ends.

    Args:
        start: Centre of one end `(3,)` [m].
        end: Centre of the other end `(3,)` [m].
        radius: Radius [m].

    Raises:
        ValueError: If the ends are the same, or so near or so far apart that the square
            of their distance leaves the range of the precision.

    Example:
        >>> post = shapes.cylinder((0.5, -1.0, -0.25), (0.5, 1.0, -0.25), radius=0.125)
        >>> distance, normal = post.surface(motion.position)
        >>> round(float(distance[5]), 3)
        0.125
    """
    ends = _ends(start, end)
    return Cylinder(*ends, as_array("radius", radius, "m", positive=True))


def pipe(start: Numbers, end: Numbers, radius: Numbers, thickness: Numbers) -> Pipe:
    """A fixed straight pipe, open at both ends: a sheath, a bore, a ring.

    Contact inside works like contact outside. The wall should be thicker than the
    distance that a rod moves in a step. Otherwise its thickness does not matter inside.

    Args:
        start: Centre of one end `(3,)` [m].
        end: Centre of the other end `(3,)` [m].
        radius: Radius of the bore [m].
        thickness: Thickness of the wall [m].

    Raises:
        ValueError: If the ends are the same, or so near or so far apart that the square
            of their distance leaves the range of the precision, or a number is not
            positive.

    Example:
        >>> sheath = shapes.pipe((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), 0.05, thickness=0.1)
        >>> distance, normal = sheath.surface(motion.position)
        >>> round(float(distance[2]), 3)  # a node on the axis
        0.05
    """
    return Pipe(
        *_ends(start, end),
        as_array("radius", radius, "m", positive=True),
        as_array("thickness", thickness, "m", positive=True),
    )


def plane(point: Numbers = (0.0, 0.0, 0.0), normal: Numbers = (0.0, 0.0, 1.0)) -> Plane:
    """A fixed half space, such as the ground.

    Args:
        point: Any point of its surface `(3,)` [m].
        normal: Normal that points out of the half space `(3,)`; its length does not
            matter.

    Raises:
        ValueError: If the length of the normal is zero, or its square is too small or
            too large for the precision.

    Example:
        >>> wall = shapes.plane((2.0, 0.0, 0.0), normal=(-1.0, 0.0, 0.0))
        >>> distance, normal = wall.surface(motion.position)
        >>> round(float(distance[-1]), 3)  # from the tip
        1.0
    """
    return Plane(
        as_array("point", point, "m", [(3,)]), with_length("normal", normal, [(3,)])
    )


def box(
    centre: Numbers,
    half_lengths: Numbers,
    orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
) -> Box:
    """A rectangular block, as an obstacle or as the shape of a rigid body.

    Args:
        centre: Centre `(3,)` [m].
        half_lengths: Distances from the centre to the faces, along the box's axes
            `(3,)` [m].
        orientation: Orientation of the box's axes, a quaternion (w, x, y, z).

    Raises:
        ValueError: If the length of the quaternion is zero, or its square is too small
            or too large for the precision.

    Example:
        >>> block = shapes.box((0.5, 0.0, -0.25), half_lengths=(1.0, 1.0, 0.125))
        >>> distance, normal = block.surface(motion.position)
        >>> round(float(distance[5]), 3)  # from the axis of the rod to the top [m]
        0.125
    """
    return Box(
        centre=as_array("centre", centre, "m", [(3,)]),
        half_lengths=as_array("half_lengths", half_lengths, "m", [(3,)], positive=True),
        orientation=with_length("orientation", orientation, [(4,)]),
    )


def signed_distance(
    function: Callable[[Any, Any], ArrayLike], parameters: Any = ()
) -> SignedDistance:
    """A fixed body of any shape.

    If it is the shape of a rigid body, `stable_dt` assumes that it is convex and of
    uniform density, with the given mass and inertia. For other bodies subclass `Body`
    and define `bounding_radius`.

    Args:
        function: Pure function from one point `(3,)` [m] and `parameters` to the signed
            distance [m], negative inside. The normal is its gradient, which has to be
            finite everywhere and of length one near the surface. A program is compiled
            for each function object, so reuse the same one.
        parameters: Traced numbers of the body: any pytree of numbers.

    Raises:
        ValueError: If the function does not give one number at a point, or a parameter
            is not a number that can be stored.
        TypeError: If `function` is not callable.

    Example:
        >>> def bowl(point, radius):
        ...     return radius - jnp.sqrt(jnp.sum(point**2) + 1e-12)
        >>> inside = shapes.signed_distance(bowl, 1.5)
        >>> distance, normal = inside.surface(motion.position)
        >>> round(float(distance[-1]), 3)  # from the tip to the wall [m]
        0.5
    """
    if not callable(function):
        raise TypeError(f"function must be callable, got {type(function).__name__}")
    dtype = jnp.result_type(float)
    numbers = jax.tree.map(
        lambda leaf: as_array("parameters", leaf, "", [np.shape(leaf)]), parameters
    )
    point = jax.ShapeDtypeStruct((3,), dtype)
    got = jax.eval_shape(function, point, numbers)
    if getattr(got, "shape", None) != ():
        raise ValueError(
            f"function must return one distance [m] at a point of shape (3,), got {got}"
        )
    function, numbers = with_parameters(function, jnp.zeros((3,), dtype), numbers)
    ranks = tuple(jnp.ndim(leaf) for leaf in jax.tree.leaves(numbers))
    return SignedDistance(numbers, function, ranks)


def _ends(start: Numbers, end: Numbers) -> tuple[Array, Array]:
    dtype = jnp.result_type(float)
    first = check_array("start", start, [(3,)], "m", dtype=dtype)
    last = check_array("end", end, [(3,)], "m", dtype=dtype)
    if not is_traced(first, last):
        apart = last.astype(dtype) - first.astype(dtype)
        if not np.any(apart):
            raise ValueError(f"start and end must differ, got {first} m for both")
        _check_length("end - start", apart, dtype)
    return jnp.asarray(first, dtype), jnp.asarray(last, dtype)


def with_length(name: str, value: Numbers, shapes: list[tuple[int, ...]]) -> Array:
    """Validates that a vector can be normalised and returns it as an array."""
    checked = check_array(name, value, shapes, "")
    dtype = jnp.result_type(float)
    if not is_traced(checked):
        _check_length(name, checked, dtype)
    return jnp.asarray(checked, dtype)


def _check_length(name: str, vector: np.ndarray, dtype: Any) -> None:
    """Raises unless the square of a vector's length is within the limits of a type."""
    limits = jnp.finfo(dtype)
    shortest, longest = float(limits.tiny) ** 0.5, float(limits.max) ** 0.5
    if not shortest <= math.hypot(*vector) <= longest:
        raise ValueError(
            f"{name} must have a length between {shortest:.0e} and {longest:.0e} in "
            f"{np.dtype(dtype)}, got {vector}"
        )
