"""Solids: volume, inertia and pose of shapes that have them in closed form."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.structure import pytree

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
    """Moments of inertia about the principal axes over the mass, at uniform density
    [m^2]; `None` if they are not known."""


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
