"""Solids: volume, inertia and pose of shapes that have them in closed form."""

from __future__ import annotations

from functools import singledispatch

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body, Box, Capsule, Cylinder, Plane, Sphere
from jaxrod.geometry import vectors
from jaxrod.structure import pytree


@pytree
class Solid:
    """A shape in the frame of its principal axes, and the pose of this frame."""

    shape: Body
    """The shape with its centre of mass at the origin and along its principal axes."""
    centre: Float[Array, "3"]
    """Centre of mass [m]."""
    orientation: Float[Array, "4"]
    """Quaternion from the principal axes to the world."""
    volume: Float[Array, ""] | None = None
    """Volume [m^3]; `None` if it is not known."""
    gyration: Float[Array, "3"] | None = None
    """Moments of inertia over the mass, at uniform density [m^2]."""


_IDENTITY = (1.0, 0.0, 0.0, 0.0)


@singledispatch
def solid_of(shape: Body) -> Solid:
    """Centre, axes, volume and inertia of a shape.

    A shape that is not known here is assumed to have its centre of mass at the origin.
    """
    zero = jnp.zeros(3)
    return Solid(shape, zero, jnp.asarray(_IDENTITY))


@solid_of.register
def _(shape: Plane) -> Solid:
    raise ValueError("a plane is no rigid body that can move: give it to `contact`")


@solid_of.register
def _(shape: Sphere) -> Solid:
    radius = shape.radius
    square = 0.4 * radius * radius
    return Solid(
        Sphere(jnp.zeros_like(shape.centre), radius),
        shape.centre,
        jnp.asarray(_IDENTITY, radius.dtype),
        4 / 3 * jnp.pi * radius * radius * radius,
        jnp.stack([square, square, square]),
    )


@solid_of.register
def _(shape: Box) -> Solid:
    a, b, c = shape.half_lengths * shape.half_lengths / 3
    identity = jnp.asarray(_IDENTITY, shape.half_lengths.dtype)
    orientation = shape.orientation / jnp.sqrt(jnp.sum(shape.orientation**2))
    return Solid(
        Box(jnp.zeros_like(shape.centre), shape.half_lengths, identity),
        shape.centre,
        orientation,
        8 * jnp.prod(shape.half_lengths),
        jnp.stack([b + c, a + c, a + b]),
    )


@solid_of.register
def _(shape: Cylinder) -> Solid:
    centre, orientation, half = _axis(shape.start, shape.end)
    square = shape.radius * shape.radius
    across = square / 4 + half * half / 3
    return Solid(
        Cylinder(*_ends(half), shape.radius),
        centre,
        orientation,
        2 * jnp.pi * square * half,
        jnp.stack([across, across, square / 2]),
    )


@solid_of.register
def _(shape: Capsule) -> Solid:
    centre, orientation, half = _axis(shape.start, shape.end)
    radius, square = shape.radius, shape.radius * shape.radius
    middle = 2 * jnp.pi * square * half
    balls = 4 / 3 * jnp.pi * square * radius
    # Half balls: 2/5 r^2 about the centre of the ball; the centre of mass of a half
    # ball is 3/8 r away from there.
    beyond = 0.4 * square + half * half + 0.75 * half * radius
    across = middle * (square / 4 + half * half / 3) + balls * beyond
    along = middle * square / 2 + balls * 0.4 * square
    volume = middle + balls
    return Solid(
        Capsule(*_ends(half), radius),
        centre,
        orientation,
        volume,
        jnp.stack([across, across, along]) / volume,
    )


def _ends(half: Array) -> tuple[Array, Array]:
    """Ends of an axis along z about the origin."""
    zero = jnp.zeros_like(half)
    end = jnp.stack([zero, zero, half])
    return -end, end


def _axis(start: Array, end: Array) -> tuple[Array, Array, Array]:
    """Middle, quaternion that turns z into the axis, and half the length."""
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
