r"""Signed solid angles, finite and differentiable for any position of the curves.

A spherical triangle of unit vectors $a, b, c$ has the signed area

$$\Omega = 2\,\mathrm{atan2}\big(a\cdot(b\times c),\ 1 + a\cdot b + b\cdot c
    + c\cdot a\big)$$

(van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30, 1983). Seen from all points of
one segment, another one sweeps a spherical parallelogram: two such triangles. There are
no arcsines whose argument round-off could put out of range. A vector without direction
(between points that coincide) subtends no angle and has zero gradient.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry.vectors import Vec3, cross, dot, scale

ROUNDING = 64
"""Multiple of round-off below which sine and cosine together define no direction."""


def unit(a: Vec3) -> Vec3:
    """Unit vectors; zero, with zero gradient, for zero vectors."""
    squared = dot(a, a)
    there = squared > 0
    inverse = 1 / jnp.sqrt(jnp.where(there, squared, 1))
    return scale(jnp.where(there, inverse, 0), a)


def triangle(a: Vec3, b: Vec3, c: Vec3) -> Array:
    """Signed area of spherical triangles of unit vectors, within 2 pi [sr].

    It is zero, the mean of the values on both sides, if the centre of the sphere lies
    in the flat triangle.
    """
    volume = dot(a, cross(b, c))
    cosines = 1 + dot(a, b) + dot(b, c) + dot(c, a)
    least = ROUNDING * jnp.finfo(volume.dtype).eps
    through = (volume * volume + cosines * cosines < least * least) | (
        (volume == 0) & (cosines < 0)
    )
    return 2 * jnp.arctan2(
        jnp.where(through, 0, volume), jnp.where(through, 1, cosines)
    )


def quadrilateral(a: Vec3, b: Vec3, c: Vec3, d: Vec3) -> Array:
    """Signed area of spherical quadrilaterals, cut from `a` to `c` [sr]."""
    return triangle(a, b, c) + triangle(a, c, d)
