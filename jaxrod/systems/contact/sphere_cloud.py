r"""Sphere clouds: balls on a rigid body, tested for contact with another.

A ball has a centre in the body's own frame and a radius. A sphere is a single ball. A
capsule has several balls along its axis. A box has balls of zero radius at its corners.
A cylinder has balls along its axis, like a capsule, and points on its two rims. The
first point of a rim is always its lowest, so that a cylinder rolls and stands without
knocking.
"""

from __future__ import annotations

import math
from functools import singledispatch

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body, Box, Capsule, Cylinder, Sphere
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    normalise,
    split_quaternion,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree, static
from jaxrod.validation import is_traced

RIM_POINTS = 4
"""Number of points on a rim. Three would support a standing cylinder; four support it
equally in all directions."""
MOST_BALLS = 100
"""Largest number of balls in a row that represent a body; more raise an error."""


@pytree
class SphereCloud:
    """Balls of one body, in its own frame, tested against other surfaces."""

    offsets: Float[Array, "3 balls"]
    """Centres of the balls in the body's frame; for points on a rim, the centre of the
    rim [m]."""
    radii: Float[Array, " balls"]
    """Radii of the balls, zero for points [m]."""
    rim_radii: Float[Array, " balls"] | None = None
    """Radii of the rims, zero for balls that are on no rim [m]; `None` without rims."""
    axis: Float[Array, "3"] | None = None
    """Unit vector along the axis of a cylinder, whose rims have points, in the body's
    own frame; `None` for bodies without rims."""
    angles: tuple[float, ...] = static(default=())
    """Angle of each ball along its rim, measured from the lowest point; zero for balls
    on no rim [rad]. Empty without rims."""
    is_round: bool = static(default=False)
    """Whether the balls together represent the whole body, which has no corner or
    edge."""
    at_once: int | None = static(default=None)
    """Largest number of balls that can touch a convex body at one time; `None` for
    all."""

    @property
    def count(self) -> int:
        """Number of balls."""
        return self.offsets.shape[1]

    def places(self, downwards: Vec3) -> Vec3:
        """Centres of the balls, in the body's own frame [m].

        The first point of each rim is its lowest, in the direction `downwards`.

        Args:
            downwards: Vector from every ball towards the other surface, in the body's
                own frame, of any length.
        """
        offsets = vectors.split(self.offsets)
        if self.rim_radii is None:
            return offsets
        assert self.axis is not None
        axis = vectors.split(self.axis)
        along = vectors.dot(downwards, axis)
        x, y, z = vectors.subtract(downwards, vectors.scale(along, axis))
        square = x * x + y * y + z * z
        # In an upright cylinder every point of a rim is the lowest: use a fixed one.
        upright = square < float(jnp.finfo(square.dtype).eps)
        shrink = 1 / jnp.sqrt(jnp.where(upright, 1, square))
        a, b, c = _beside(axis)
        lowest = (
            jnp.where(upright, a, x * shrink),
            jnp.where(upright, b, y * shrink),
            jnp.where(upright, c, z * shrink),
        )
        cosine = self.rim_radii * jnp.asarray(np.cos(self.angles), self.axis.dtype)
        sine = self.rim_radii * jnp.asarray(np.sin(self.angles), self.axis.dtype)
        way = vectors.add(
            vectors.scale(cosine, lowest),
            vectors.scale(sine, vectors.cross(axis, lowest)),
        )
        return vectors.add(offsets, way)


def _beside(axis: Vec3) -> Vec3:
    """A unit vector perpendicular to the unit vector `axis`."""
    x, y, z = axis
    flat = jnp.abs(z) < 0.9
    p, q, r = jnp.where(flat, y, 0), jnp.where(flat, -x, z), jnp.where(flat, 0, -y)
    size = 1 / jnp.sqrt(p * p + q * q + r * r)
    return p * size, q * size, r * size


@singledispatch
def spheres_of(shape: Body, balls: int, points_per_edge: int) -> SphereCloud | None:
    """Balls of a shape in its own frame; `None` if only its surface is known.

    Args:
        shape: The shape.
        balls: Number of balls along the axis of a capsule or cylinder, from
            `spheres_needed`.
        points_per_edge: Points on every edge of a box, corners included.
    """
    return None


@spheres_of.register
def _(shape: Sphere, balls: int, points_per_edge: int) -> SphereCloud:
    return SphereCloud(shape.centre[:, None], shape.radius[None], is_round=True)


@spheres_of.register
def _(shape: Capsule, balls: int, points_per_edge: int) -> SphereCloud:
    offsets = _line(shape.start, shape.end, balls)
    return SphereCloud(offsets, jnp.broadcast_to(shape.radius, (balls,)), is_round=True)


@spheres_of.register
def _(shape: Cylinder, balls: int, points_per_edge: int) -> SphereCloud:
    angles = tuple(2 * math.pi * k / RIM_POINTS for k in range(RIM_POINTS))
    rims = [
        jnp.repeat(p[:, None], RIM_POINTS, axis=1) for p in (shape.start, shape.end)
    ]
    first, last, _ = shape.row_of_balls
    inner = [_line(first, last, balls)] if balls else []
    dtype = shape.radius.dtype
    none, some = jnp.zeros(2 * RIM_POINTS, dtype), jnp.ones(balls, dtype)
    return SphereCloud(
        offsets=jnp.concatenate([*rims, *inner], axis=1),
        radii=jnp.concatenate([none, shape.radius * some]),
        rim_radii=jnp.concatenate([shape.radius * (1 + none), 0 * some]),
        axis=_direction(shape.end - shape.start),
        angles=(*angles, *angles, *([0.0] * balls)),
        # One rim of a standing cylinder; all balls and two rim points of a lying one.
        at_once=max(RIM_POINTS, 2 + balls),
    )


@spheres_of.register
def _(shape: Box, balls: int, points_per_edge: int) -> SphereCloud:
    inner = np.linspace(-1, 1, points_per_edge)[1:-1]
    signs = (-1.0, 1.0)
    places = [(a, b, c) for a in signs for b in signs for c in signs]
    for axis in range(3):
        for a in signs:
            for b in signs:
                for t in inner:
                    place = [a, b]
                    place.insert(axis, float(t))
                    places.append((place[0], place[1], place[2]))
    units = jnp.asarray(np.array(places).T, shape.half_lengths.dtype)
    own = vectors.split(shape.half_lengths[:, None] * units)
    frame = directors(normalise(split_quaternion(shape.orientation)))
    return SphereCloud(
        shape.centre[:, None] + vectors.join(to_world(frame, own)),
        jnp.zeros(len(places), shape.half_lengths.dtype),
        # The points on the edges of one face.
        at_once=4 * (points_per_edge - 1),
    )


def given_points(points: Array) -> SphereCloud:
    """Balls of radius zero at given points of a surface, in the body's frame [m]."""
    return SphereCloud(points, jnp.zeros_like(points[0]))


def spheres_needed(name: str, shape: Body) -> int:
    """Number of balls in a row along a shape's axis, at most a radius apart.

    It is zero for shapes without such a row.

    Args:
        name: Name of the body, for messages.
        shape: The shape.

    Raises:
        ValueError: If there are more than `MOST_BALLS`, or the size is traced.
    """
    row = shape.row_of_balls
    if row is None:
        return 0
    start, end, radius = row
    if is_traced(start, end, radius):
        raise ValueError(
            f"rigid_contact: the size of {name} is traced: give balls_per_axis"
        )
    length = float(np.linalg.norm(np.asarray(end) - np.asarray(start)))
    if length == 0:
        return 0
    count = 1 + max(1, math.ceil(length / float(radius) - 1e-6))
    if count > MOST_BALLS:
        raise ValueError(
            f"rigid_contact: {name}, {length:.3g} m long and of radius "
            f"{float(radius):.3g} m, would be {count} balls in a row, more than "
            f"{MOST_BALLS}: give balls_per_axis, or make it a rod"
        )
    return count


def _direction(vector: Array) -> Array:
    return vector / jnp.sqrt(jnp.sum(vector * vector))


def _line(start: Array, end: Array, count: int) -> Array:
    """Equidistant points from `start` to `end`, both included `(3, count)` [m]."""
    share = jnp.asarray(np.linspace(0, 1, count), start.dtype)
    return start[:, None] + (end - start)[:, None] * share[None, :]
