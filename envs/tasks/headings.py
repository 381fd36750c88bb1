"""Headings: directions in the plane of the ground along which animals should go."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxrod.validation import check_array


def check_turn(turn: float) -> float:
    """The largest angle of a heading from x, either way [rad].

    Raises:
        ValueError: If it is below 0 or beyond pi.
    """
    angle = float(check_array("turn", turn, [()], "rad", non_negative=True))
    if angle > math.pi:
        raise ValueError(f"turn must be at most pi rad, got {angle:g} rad")
    return angle


def drawn_heading(key: Key[Array, ""], turn: Float[Array, ""]) -> Float[Array, "2"]:
    """A unit vector, all angles from x up to `turn` alike likely."""
    angle = turn * jax.random.uniform(key, (), turn.dtype, -1.0)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def along_heading(vector: Array, heading: Float[Array, "2"]) -> Array:
    """A vector's parts along the heading and to its left, and others as they are.

    Args:
        vector: X, y and what follows; each may be several numbers.
        heading: Unit vector.
    """
    along, left = heading
    x, y = vector[0], vector[1]
    level = jnp.stack([x * along + y * left, y * along - x * left])
    return jnp.concatenate([level, vector[2:]])
