"""Places where two elements touch, the loads there, and sums over them.

Force and reaction act at one common point of both elements, half a penetration deep. So
momentum and angular momentum are exact, with damping and friction too, and friction
turns both elements.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.contacts.contact_law import energy_density, friction_force, normal_force
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.contact.element_pairs import Elements, bulge_shares

ROUNDED = 1e-7
"""Width within which distances are smoothed, over the sum of the radii [1]."""


@pytree
class Touch:
    """Places on pairs of elements, and the penetration there."""

    own_fraction: Array
    """Place on the first element, over its length [1]."""
    other_fraction: Array
    """Place on the second element, over its length [1]."""
    normal: Vec3
    """Unit vectors from the second element to the first."""
    weight: Array
    """Weight of the touch: a length in the line law [m], else a number [1]; negative
    for touches that are subtracted."""
    depth: Array
    """Penetration [m]."""
    width: Array
    """Width of the onset of contact [m]."""
    own_radius: Array
    """Radius of the first element [m]."""
    other_radius: Array
    """Radius of the second element [m]."""

    @property
    def arms(self) -> tuple[Vec3, Vec3]:
        """Vectors from both axes to their common point [m]."""
        overlap = 0.5 * self.depth
        return (
            vectors.scale(overlap - self.own_radius, self.normal),
            vectors.scale(self.other_radius - overlap, self.normal),
        )


@pytree
class Law:
    """Numbers of the law of contact, per length of contact or per crossing."""

    stiffness: Array
    """Force per penetration [N/m^2] or [N/m]."""
    damping: Array | None
    """Force per normal speed [kg/(m s)] or [kg/s]."""
    friction: Array | None
    """Coefficient of friction [1]."""
    friction_drag: Array | None
    """Largest friction per slip speed [kg/(m s)] or [kg/s]."""

    def energy(self, touch: Touch) -> Array:
        """Energy of each touch [J]."""
        density = energy_density(touch.depth, touch.width, self.stiffness)
        return touch.weight * density


OnElements = tuple[Vec3, Vec3, Vec3 | None, tuple[Vec3, Vec3] | None]
"""Forces on first and on next nodes, couples, and forces on tangents at both nodes."""


@pytree
class PairLoads:
    """Loads of pairs of elements on each other.

    Forces are conjugate to the way between the elements' first nodes and to both edges.
    The first element gets the force `way`, the second its opposite.
    """

    way: Vec3
    """Total force on the first element [N]."""
    own_edge: Vec3
    """Part of this force that acts at the next node of the first element [N]."""
    other_edge: Vec3
    """Force at the next node of the second element, part of its total [N]."""
    own_turn: Vec3 | None = None
    """Couple on the first element [N m]."""
    other_turn: Vec3 | None = None
    """Couple on the second element [N m]."""
    own_bulges: tuple[Vec3, Vec3] | None = None
    """Forces on both bulges of the first element, for smooth axes [N]."""
    other_bulges: tuple[Vec3, Vec3] | None = None
    """Forces on both bulges of the second element, for smooth axes [N]."""

    def added(self, more: PairLoads) -> PairLoads:
        """Sum of both loads."""
        return PairLoads(
            vectors.add(self.way, more.way),
            vectors.add(self.own_edge, more.own_edge),
            vectors.add(self.other_edge, more.other_edge),
            _added(self.own_turn, more.own_turn),
            _added(self.other_turn, more.other_turn),
            _both_added(self.own_bulges, more.own_bulges),
            _both_added(self.other_bulges, more.other_bulges),
        )

    @property
    def on_own(self) -> OnElements:
        """Loads on both nodes, sections and tangents of the first elements."""
        edge = _less(self.own_edge, self.own_bulges)
        first = vectors.subtract(self.way, edge)
        return first, edge, self.own_turn, self.own_bulges

    @property
    def on_other(self) -> OnElements:
        """Loads on both nodes, sections and tangents of the second elements."""
        edge = _less(self.other_edge, self.other_bulges)
        first = vectors.scale(-1.0, vectors.add(self.way, edge))
        return first, edge, self.other_turn, self.other_bulges


def touch_at(
    way: Vec3,
    fractions: tuple[Array, Array],
    weight: Array,
    radii: tuple[Array, Array],
    onset: Array,
) -> Touch:
    """The touch of two places.

    Args:
        way: Vector from the place on the second element to that on the first [m].
        fractions: Places on the first and on the second element [1].
        weight: Weight of the touch.
        radii: Radii of the first and of the second element [m].
        onset: Width of the onset over the mean of the radii [1].
    """
    together = radii[0] + radii[1]
    rounded = (ROUNDED * together) * (ROUNDED * together)
    distance = jnp.sqrt(vectors.dot(way, way) + rounded)
    return Touch(
        own_fraction=fractions[0],
        other_fraction=fractions[1],
        normal=vectors.scale(1 / distance, way),
        weight=weight,
        depth=together - distance,
        width=0.5 * onset * together,
        own_radius=radii[0],
        other_radius=radii[1],
    )


def loads_of(
    touch: Touch,
    own: Elements,
    other: Elements,
    law: Law,
    share: Array | None = None,
) -> PairLoads:
    """Normal force, dashpot and friction at a touch, times its weight.

    Args:
        touch: The touch.
        own: First elements.
        other: Second elements.
        law: Numbers of the law.
        share: Fraction of the dashpot and of friction that counts; all by default [1].
    """
    rate: Vec3 | None = None
    leaving = jnp.zeros_like(touch.depth)
    if law.damping is not None or law.friction is not None:
        rate = vectors.subtract(
            _rate(own, touch.own_fraction), _rate(other, touch.other_fraction)
        )
        leaving = vectors.dot(rate, touch.normal)
    push = normal_force(touch.depth, leaving, touch.width, law.stiffness, law.damping)
    pressed = touch.weight * push
    if share is not None and law.damping is not None:
        spring = elastic_push(touch, law)
        pressed = touch.weight * (spring + share * (push - spring))
    force = vectors.scale(pressed, touch.normal)
    own_turn: Vec3 | None = None
    other_turn: Vec3 | None = None
    if law.friction is not None:
        assert law.friction_drag is not None and rate is not None
        assert own.spin is not None and other.spin is not None
        arms = touch.arms
        slip = vectors.subtract(rate, vectors.scale(leaving, touch.normal))
        slip = vectors.add(slip, vectors.cross(own.spin, arms[0]))
        slip = vectors.subtract(slip, vectors.cross(other.spin, arms[1]))
        rub = friction_force(push, slip, law.friction, law.friction_drag)
        rub = vectors.scale(
            touch.weight if share is None else touch.weight * share, rub
        )
        own_turn = vectors.cross(arms[0], rub)
        other_turn = vectors.cross(rub, arms[1])
        force = vectors.add(force, rub)
    return PairLoads(
        way=force,
        own_edge=vectors.scale(touch.own_fraction, force),
        other_edge=vectors.scale(-touch.other_fraction, force),
        own_turn=own_turn,
        other_turn=other_turn,
        own_bulges=on_bulges(own, touch.own_fraction, force),
        other_bulges=on_bulges(other, touch.other_fraction, vectors.scale(-1.0, force)),
    )


def on_bulges(
    elements: Elements, fraction: Array, force: Vec3
) -> tuple[Vec3, Vec3] | None:
    """Parts of a force at a place that act on the bulges [N]; `None` without bulges."""
    if elements.bulges is None:
        return None
    first, second = bulge_shares(fraction)
    return vectors.scale(first, force), vectors.scale(second, force)


def elastic_push(touch: Touch, law: Law) -> Array:
    """Force of the spring of a touch, per weight of the touch."""
    still = jnp.zeros_like(touch.depth)
    return normal_force(touch.depth, still, touch.width, law.stiffness)


def _rate(elements: Elements, fraction: Array) -> Vec3:
    """Velocity of a place on elements [m/s]."""
    assert elements.first_velocity is not None
    return vectors.add(elements.first_velocity, elements.change_on_axis(fraction))


def _added(a: Vec3 | None, b: Vec3 | None) -> Vec3 | None:
    if a is None or b is None:
        return b if a is None else a
    return vectors.add(a, b)


def _both_added(
    a: tuple[Vec3, Vec3] | None, b: tuple[Vec3, Vec3] | None
) -> tuple[Vec3, Vec3] | None:
    if a is None or b is None:
        return b if a is None else a
    return vectors.add(a[0], b[0]), vectors.add(a[1], b[1])


def _less(edge: Vec3, bulges: tuple[Vec3, Vec3] | None) -> Vec3:
    """Force on the edge, with tangents as variables in place of the bulges [N]."""
    if bulges is None:
        return edge
    return vectors.subtract(edge, vectors.add(*bulges))
