r"""Nearest places of two segments, and middles where they are parallel.

Of segments $x_1 + s e_1$ and $x_2 + t e_2$ the squared distance is a quadratic form
with the determinant $D = |e_1|^2 |e_2|^2 \sin^2\theta$. Its least value in the unit
square lies where the form's gradient vanishes or on the border: three clips give the
first, the four ends against the other segment the second, and the nearest of the five
is right whatever rounding does to one of them (compare Eberly, Robust computation of
distance between line segments, 2015).

Where segments are parallel the nearest place is not unique, and a force there would
jump from end to end. Below $\sin^2\theta = 10^{-5}$ contact at the nearest places gives
way, linearly in $\sin^2\theta$, to contact at the middles of where the segments lie
side by side, which is all there is below $10^{-6}$. No sooner: segments that touch at
their nearest places only would not touch at their middles.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree

PARALLEL = 1e-6
"""Below this square of the sine of their angle segments count as parallel [1]."""
CROSSED = 1e-5
"""Above this one they count as crossed [1]."""
_FLOOR = 1e-6
"""Least determinant over its largest value, in divisions [1]."""


@pytree
class Products:
    """Scalar products of two edges and of the way between the segments' beginnings."""

    own: Array
    """Square of the length of the one edge [m^2]."""
    other: Array
    """Square of the length of the other [m^2]."""
    mixed: Array
    """Product of both [m^2]."""
    own_way: Array
    """Product of the one edge and the way [m^2]."""
    other_way: Array
    """Product of the other and the way [m^2]."""

    def on_own(self, fraction: Array | float) -> Array:
        """Place on the one segment nearest to a place on the other [1]."""
        return jnp.clip((self.mixed * fraction - self.own_way) / self.own, 0, 1)

    def on_other(self, fraction: Array | float) -> Array:
        """Place on the other segment nearest to a place on the one [1]."""
        return jnp.clip((self.mixed * fraction + self.other_way) / self.other, 0, 1)


def from_products(
    slopes: Products, way: Vec3, own: Vec3, other: Vec3
) -> tuple[Vec3, Vec3, Vec3]:
    """What slopes with regard to the products are with regard to the vectors.

    Args:
        slopes: Derivatives of something by each of the products.
        way: From the beginning of the other segment to that of the one [m].
        own: Edge of the one segment [m].
        other: Edge of the other [m].
    """

    def sums(*terms: tuple[Array, Vec3]) -> Vec3:
        x, y, z = (sum(factor * v[k] for factor, v in terms) for k in range(3))
        return x, y, z  # type: ignore[return-value]

    return (
        sums((slopes.own_way, own), (slopes.other_way, other)),
        sums((2 * slopes.own, own), (slopes.mixed, other), (slopes.own_way, way)),
        sums((2 * slopes.other, other), (slopes.mixed, own), (slopes.other_way, way)),
    )


def products(way: Vec3, own: Vec3, other: Vec3) -> Products:
    """The scalar products.

    Args:
        way: From the beginning of the other segment to that of the one [m].
        own: Edge of the one segment [m].
        other: Edge of the other [m].
    """
    return Products(
        own=vectors.dot(own, own),
        other=vectors.dot(other, other),
        mixed=vectors.dot(own, other),
        own_way=vectors.dot(own, way),
        other_way=vectors.dot(other, way),
    )


def between(
    way: Vec3, own: Vec3, other: Vec3, at: tuple[Array | float, Array | float]
) -> Vec3:
    """From a place on the other segment to one on the one [m]."""
    x, y, z = (
        w + at[0] * e - at[1] * f for w, e, f in zip(way, own, other, strict=True)
    )
    return x, y, z


def nearest_places(way: Vec3, own: Vec3, other: Vec3) -> tuple[Array, Array, Array]:
    """Nearest places on both segments [1], and the square of their distance [m^2].

    Args:
        way: From the beginning of the other segment to that of the one [m].
        own: Edge of the one segment [m].
        other: Edge of the other [m].
    """
    have = products(way, own, other)
    s, t = first_guess(have)
    square = _square(between(way, own, other, (s, t)))
    zero, one = jnp.zeros_like(s), jnp.ones_like(s)
    for first, second in (
        (zero, have.on_other(0.0)),
        (one, have.on_other(1.0)),
        (have.on_own(0.0), zero),
        (have.on_own(1.0), one),
    ):
        found = _square(between(way, own, other, (first, second)))
        nearer = found < square
        s, t = jnp.where(nearer, first, s), jnp.where(nearer, second, t)
        square = jnp.where(nearer, found, square)
    return s, t, square


def first_guess(have: Products) -> tuple[Array, Array]:
    """Place in the unit square where the form is least, but for rounding [1]."""
    largest = have.own * have.other
    determinant = jnp.maximum(largest - have.mixed * have.mixed, _FLOOR * largest)
    across = have.mixed * have.other_way - have.other * have.own_way
    last = have.on_other(jnp.clip(across / determinant, 0, 1))
    return have.on_own(last), last


def crossedness(have: Products) -> Array:
    """Zero for parallel segments, one for crossed ones [1]."""
    sine = 1 - have.mixed * have.mixed / (have.own * have.other)
    return jnp.clip((sine - PARALLEL) / (CROSSED - PARALLEL), 0, 1)


def middles(have: Products) -> tuple[Array, Array]:
    """Middles of where segments that are parallel lie side by side [1].

    Of each what the other covers; where it covers nothing, the end next to it.
    """
    return (
        0.5 * (have.on_own(0.0) + have.on_own(1.0)),
        0.5 * (have.on_other(0.0) + have.on_other(1.0)),
    )


def _square(vector: Vec3) -> Array:
    return vectors.dot(vector, vector)
