"""Headings: directions in the ground plane along which the animals should move."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxrod.validation import check_array


def check_turn(turn: float) -> float:
    """Validates the largest angle of a heading from x and returns it [rad].

    Raises:
        ValueError: If it is below 0 or beyond pi.
    """
    angle = float(check_array("turn", turn, [()], "rad", non_negative=True))
    if angle > math.pi:
        raise ValueError(f"turn must be at most pi rad, got {angle:g} rad")
    return angle


def drawn_heading(key: Key[Array, ""], turn: Float[Array, ""]) -> Float[Array, "2"]:
    """Draws a unit vector whose angle from x is uniform in [-turn, turn]."""
    angle = turn * jax.random.uniform(key, (), turn.dtype, -1.0)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def along_heading(vector: Array, heading: Float[Array, "2"]) -> Array:
    """Rotates a vector's x and y into components along the heading and to its left.

    Args:
        vector: Components x, y, then any others, which stay unchanged; each component
            may be an array.
        heading: Unit vector in the plane.
    """
    along, left = heading
    x, y = vector[0], vector[1]
    level = jnp.stack([x * along + y * left, y * along - x * left])
    return jnp.concatenate([level, vector[2:]])
