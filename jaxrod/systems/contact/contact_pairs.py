"""Pairs of places that may touch, and the forces there.

Force and reaction act at one common point of both elements, half a penetration deep. So
momentum and angular momentum are exact, with damping and friction too, and friction
turns both elements.
"""

from __future__ import annotations

from typing import Any, Protocol

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.contacts.contact_law import PenaltyLaw
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree

ROUNDED = 1e-7
"""Width within which distances are smoothed, over the sum of the radii [1]."""


@pytree
class ContactPair:
    """Two places, and the penetration of the surfaces around them."""

    places: tuple[Array | None, Array]
    """Places on the first and on the second element, over their lengths [1]; `None` for
    a contact point."""
    normal: Vec3
    """Unit vectors from the second place to the first."""
    weight: Array
    """Weight of the pair: a length in the line law [m], else a number [1]; negative for
    pairs that are subtracted."""
    depth: Array
    """Penetration [m]."""
    width: Array
    """Width of the onset of contact [m]."""
    radii: tuple[Array, Array]
    """Radii of the first and of the second element [m]."""

    @property
    def arms(self) -> tuple[Vec3, Vec3]:
        """Vectors from the places on both axes to the common point of contact [m]."""
        overlap = 0.5 * self.depth
        return (
            vectors.scale(overlap - self.radii[0], self.normal),
            vectors.scale(self.radii[1] - overlap, self.normal),
        )


class Moving(Protocol):
    """Elements or contact points in motion."""

    def spin_at(self, place: Any) -> Vec3:
        """Angular velocities at places on the axes, world frame [rad/s]."""

    def velocity_at(self, place: Any) -> Vec3:
        """Velocities of places on the axes [m/s]."""


def contact_pair(
    way: Vec3,
    places: tuple[Array | None, Array],
    weight: Array,
    radii: tuple[Array, Array],
    onset: Array,
) -> ContactPair:
    """Makes the pair of two places.

    Args:
        way: Vector from the second place to the first [m].
        places: Places on the first and on the second element [1].
        weight: Weight of the pair.
        radii: Radii of the first and of the second element [m].
        onset: Width of the onset over the mean of the radii [1].
    """
    together = radii[0] + radii[1]
    rounded = (ROUNDED * together) * (ROUNDED * together)
    distance = jnp.sqrt(vectors.dot(way, way) + rounded)
    return ContactPair(
        places=places,
        normal=vectors.scale(1 / distance, way),
        weight=weight,
        depth=together - distance,
        width=0.5 * onset * together,
        radii=radii,
    )


def pair_forces(
    pair: ContactPair,
    own: Moving,
    other: Moving,
    law: PenaltyLaw,
    share: Array | None = None,
) -> tuple[Vec3, tuple[Vec3, Vec3] | None]:
    """Normal force, dashpot and friction of a pair, times its weight.

    Args:
        pair: The pair.
        own: First elements.
        other: Second elements.
        law: Numbers of the law.
        share: Fraction of the dashpot and of friction that counts; all by default [1].

    Returns:
        Force on the first element, and couples on both; no couples without friction.
    """
    rate = turning = None
    arms = pair.arms
    if law.has_rates:
        rate = vectors.subtract(
            own.velocity_at(pair.places[0]), other.velocity_at(pair.places[1])
        )
    if law.friction is not None:
        turning = vectors.subtract(
            vectors.cross(own.spin_at(pair.places[0]), arms[0]),
            vectors.cross(other.spin_at(pair.places[1]), arms[1]),
        )
    push, rub = law.forces(pair.depth, pair.width, pair.normal, rate, turning)
    pressed = pair.weight * push
    if share is not None and law.damping is not None:
        spring = law.spring(pair.depth, pair.width)
        pressed = pair.weight * (spring + share * (push - spring))
    force = vectors.scale(pressed, pair.normal)
    if rub is None:
        return force, None
    rub = vectors.scale(pair.weight if share is None else pair.weight * share, rub)
    own_turn = vectors.cross(arms[0], rub)
    other_turn = vectors.cross(rub, arms[1])
    return vectors.add(force, rub), (own_turn, other_turn)
