r"""Nearest places of two pieces of smooth axes.

Newton's method in the unit square, from the nearest places of the chords: the squared
distance is replaced by the quadratic form that it is to second order, which has its
least value in the square where `segment_distance` says. Where that form is not clearly
convex, of pieces that bend towards each other and are nearly parallel, what bends it is
left out.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.systems.element_pairs import Elements
from jaxrod.systems.segment_distance import Products, first_guess

STEPS = 3
"""Newton steps: forces are then those of the energy to rounding; with two, to 3e-8."""
_CONVEX = 0.5
"""Least share of what straight pieces have that counts as convex [1]."""


def apart(way: Vec3, own: Elements, other: Elements, at: tuple[Array, Array]) -> Vec3:
    """From a place on the other axis to one on the one [m].

    Args:
        way: From the first node of the other element to that of the one [m].
        own: The one elements.
        other: The other elements.
        at: Both places, over the lengths of their elements [1].
    """
    return vectors.add(way, vectors.subtract(own.on_axis(at[0]), other.on_axis(at[1])))


def nearest_on_curves(
    way: Vec3, own: Elements, other: Elements, start: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Nearest places of both pieces [1].

    Slopes are those of the last step, which are those of the nearest places.

    Args:
        way: From the first node of the other element to that of the one [m].
        own: The one elements.
        other: The other elements.
        start: Places to begin with, as the nearest ones of the chords [1].
    """
    s, t = start
    for _ in range(STEPS):
        s, t = jax.lax.stop_gradient((s, t))
        r = apart(way, own, other, (s, t))
        u, v = own.tangent(s), other.tangent(t)
        straight = vectors.dot(u, u), vectors.dot(v, v)
        mixed = vectors.dot(u, v)
        bent = (
            straight[0] + vectors.dot(r, own.bend(s)),
            straight[1] - vectors.dot(r, other.bend(t)),
        )
        square = mixed * mixed
        convex = (
            (bent[0] > _CONVEX * straight[0])
            & (bent[1] > _CONVEX * straight[1])
            & (
                bent[0] * bent[1] - square
                > _CONVEX * (straight[0] * straight[1] - square)
            )
        )
        a, b = (
            jnp.where(convex, full, flat)
            for full, flat in zip(bent, straight, strict=True)
        )
        form = Products(
            own=a,
            other=b,
            mixed=mixed,
            own_way=vectors.dot(r, u) - a * s + mixed * t,
            other_way=vectors.dot(r, v) + b * t - mixed * s,
        )
        s, t = first_guess(form)
    return s, t


def nearest_to_node(way: Vec3, own: Elements, other: Elements, start: Array) -> Array:
    """Place of the other piece that is nearest to the next node of the one [1].

    Args:
        way: From the first node of the other element to that of the one [m].
        own: The one elements.
        other: The other elements.
        start: Place to begin with [1].
    """
    t = start
    node = vectors.add(way, own.edge)
    for _ in range(STEPS):
        t = jax.lax.stop_gradient(t)
        r = vectors.subtract(node, other.on_axis(t))
        v = other.tangent(t)
        straight = vectors.dot(v, v)
        bent = straight - vectors.dot(r, other.bend(t))
        slope = jnp.where(bent > _CONVEX * straight, bent, straight)
        t = jnp.clip(t + vectors.dot(r, v) / slope, 0, 1)
    return t
