r"""Closest points of two pieces of smooth axes.

Newton's method in the unit square, started from the closest points of the chords. In
each step the squared distance is replaced by its second-order expansion, a quadratic
form whose minimum in the square `segment_distance` finds. This form is not clearly
convex for pieces that bend towards each other and are nearly parallel. There the terms
of the curvature are left out.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.systems.contact.element_pairs import Elements
from jaxrod.systems.contact.segment_distance import Products, first_guess

STEPS = 3
"""Number of Newton steps. With three, forces match the energy to round-off; with two,
to 3e-8."""
_CONVEX = 0.5
"""Smallest fraction of the second derivatives of straight pieces that counts as convex
[1]."""


def apart(way: Vec3, own: Elements, other: Elements, at: tuple[Array, Array]) -> Vec3:
    """Vector from a place on the second axis to a place on the first [m].

    Args:
        way: Vector from the start of the second element to the start of the first [m].
        own: First elements.
        other: Second elements.
        at: Places on the first and second axis, over the lengths of their elements [1].
    """
    return vectors.add(way, vectors.subtract(own.on_axis(at[0]), other.on_axis(at[1])))


def nearest_on_curves(
    way: Vec3, own: Elements, other: Elements, start: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Closest points of both pieces [1].

    Only the last Newton step is differentiated, which gives the derivatives of the
    closest points.

    Args:
        way: Vector from the start of the second element to the start of the first [m].
        own: First elements.
        other: Second elements.
        start: Starting points, such as the closest points of the chords [1].
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
    """Point of the second piece closest to the next node of the first [1].

    Args:
        way: Vector from the start of the second element to the start of the first [m].
        own: First elements.
        other: Second elements.
        start: Starting point [1].
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
