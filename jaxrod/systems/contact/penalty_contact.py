"""Penalty contact of members: base class of couplings, and forces of pairs of points.

Force and reaction act at one common point, midway between the two surfaces. So momentum
and angular momentum are conserved exactly, also with damping and friction, and friction
turns both elements.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxrod.contacts.contact_law import PenaltyLaw
from jaxrod.contacts.default_law import (
    GRAVITY,
    OVERLAP,
    largest_rates,
    left_out,
    softened_law,
    with_default_law,
)
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import AllParts, Coupling, Parts
from jaxrod.validation import Numbers, as_array

C = TypeVar("C", bound="PenaltyContact")


@pytree
class PenaltyContact(Coupling):
    """Base class of penalty contact: springs, dashpots and Coulomb friction."""

    stiffness: Float[Array, ""]
    """Normal force per penetration: [N/m^2] if per unit length of contact, else
    [N/m]."""
    onset: Float[Array, ""]
    """Width of the smooth onset of contact, divided by a rod's radius or a body's size
    [1]."""
    damping: Float[Array, ""] | None = None
    """Dashpot force per normal speed: [kg/(m s)] if per unit length, else [kg/s]."""
    friction: Float[Array, ""] | None = None
    """Coefficient of Coulomb friction [1]."""
    friction_drag: Float[Array, ""] | None = None
    """Largest friction force per slip speed: [kg/(m s)] if per unit length, else
    [kg/s]."""
    left_out: tuple[str, ...] = static(default=())
    """Names of the numbers above that `make_system` chooses; until then the stiffness
    is NaN."""

    @property
    def lacks_numbers(self) -> bool:
        """Whether its stiffness is left out."""
        return bool(self.left_out)

    def with_numbers(self: C, parts: AllParts, step: Array) -> C:
        """Copy with the numbers that are left out, by `jaxrod.contacts.default_law`.

        Args:
            parts: Constants of the members.
            step: Largest stable step of the system without this contact [s].
        """

        def fastest(contact: C) -> tuple[Array, Array]:
            bounds = contact.prepared(parts).stability_bounds(parts)
            return largest_rates(bounds, parts)

        return with_default_law(self, step, self.least_stiffness(parts), fastest)

    def softened(self: C, share: ArrayLike) -> C:
        """Copy with a share of the stiffness that bounces as before."""
        return softened_law(self, share)

    def least_stiffness(self, parts: AllParts) -> Array:
        """Smallest stiffness that `make_system` chooses [N/m^2] or [N/m]."""
        raise NotImplementedError(f"{type(self).__name__} has no default stiffness")

    @property
    def twists(self) -> str | None:
        """Friction, which acts on the surface of rods and so turns them."""
        return None if self.friction is None else "friction"

    @property
    def law(self) -> PenaltyLaw:
        """Stiffness, damping and friction as a `PenaltyLaw`, which computes forces."""
        return PenaltyLaw(
            self.stiffness, self.damping, self.friction, self.friction_drag
        )


def weight_over_overlap(members: Iterable[Parts]) -> Array:
    """Largest ratio of a rod's weight per length to the overlap it may cause [N/m^2].

    The overlap is a hundredth of the rod's radius.
    """
    ratios = []
    for own in members:
        assert own.linear_density is not None and own.radii is not None
        ratios.append(jnp.max(own.linear_density / own.radii))
    return GRAVITY / OVERLAP * jnp.max(jnp.stack(ratios))


def law_numbers(
    stiffness: Numbers | None,
    damping: Numbers | None,
    friction: Numbers | None,
    friction_drag: Numbers | None,
    onset: Numbers,
    *,
    per_length: bool,
) -> dict[str, Any]:
    """Validates the parameters of the law; returns the fields of `PenaltyContact`.

    Args:
        stiffness: Normal force per penetration [N/m^2] or [N/m]; `None` to leave it,
            and the next numbers that are not given, to `make_system`.
        damping: Dashpot force per normal speed [kg/(m s)] or [kg/s].
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per slip speed [kg/(m s)] or [kg/s]; by default
            the damping.
        onset: Width of the smooth onset divided by a rod's radius or a body's size [1].
        per_length: Whether the law is per unit length of contact. If it is, the first
            of the two units above applies, else the second.

    Raises:
        ValueError: If a number is out of range, or friction is given without drag.
    """
    rigidity, rate = ("N/m^2", "kg/(m s)") if per_length else ("N/m", "kg/s")
    drag = damping if friction_drag is None else friction_drag
    missing = left_out(stiffness, damping, friction, friction_drag)
    if friction is not None and drag is None and not missing:
        raise ValueError(
            f"friction needs friction_drag > 0 {rate}, its resistance per "
            f"{'length and ' if per_length else ''}speed at the onset of slip (by "
            "default the damping), got none"
        )

    def number(name: str, value: Numbers | None, unit: str) -> Array | None:
        return None if value is None else as_array(name, value, unit, positive=True)

    return {
        "stiffness": (
            jnp.asarray(jnp.nan, jnp.result_type(float))
            if stiffness is None
            else as_array("stiffness", stiffness, rigidity, positive=True)
        ),
        "left_out": missing,
        "onset": as_array("onset", onset, "", positive=True),
        "damping": number("damping", damping, rate),
        "friction": number("friction", friction, ""),
        "friction_drag": number(
            "friction_drag", None if friction is None else drag, rate
        ),
    }


def check_members(members: tuple[str, ...]) -> None:
    """Raises an error unless members are one or more strings, no two of them equal."""
    for name in members:
        if not isinstance(name, str):
            raise TypeError(f"members are named by strings, got {name!r}")
    if not members or len(set(members)) < len(members):
        raise ValueError(f"members must be named once each, got {list(members)}")


ROUNDED = 1e-7
"""Length e in the smoothed distance sqrt(d^2 + e^2), divided by the sum of both radii
[1]."""


@pytree
class ContactPair:
    """Pairs of points on the axes of two elements, and the penetration of surfaces."""

    places: tuple[Array | None, Array]
    """Fractions along the first and the second element at which the points lie [1]; the
    first is `None` if a contact point represents the first element."""
    normal: Vec3
    """Unit vectors from the second point to the first."""
    weight: Array
    """Factor on the force and energy of the pair: a length [m] if the law is per unit
    length, else a pure number [1]. It is negative for pairs that are subtracted."""
    depth: Array
    """Penetration: sum of the radii minus the distance of the points [m]."""
    width: Array
    """Width of the smooth onset of contact [m]."""
    radii: tuple[Array, Array]
    """Radii of the first and of the second element [m]."""

    @property
    def arms(self) -> tuple[Vec3, Vec3]:
        """Lever arms from both axes to the point midway between the surfaces [m]."""
        overlap = 0.5 * self.depth
        return (
            vectors.scale(overlap - self.radii[0], self.normal),
            vectors.scale(self.radii[1] - overlap, self.normal),
        )


class Moving(Protocol):
    """Interface of elements or contact points with velocities."""

    def spin_at(self, place: Any) -> Vec3:
        """Angular velocities at fractions along the elements, world frame [rad/s]."""

    def velocity_at(self, place: Any) -> Vec3:
        """Velocities of the axes at fractions along the elements [m/s]."""


def contact_pair(
    way: Vec3,
    places: tuple[Array | None, Array],
    weight: Array,
    radii: tuple[Array, Array],
    onset: Array,
) -> ContactPair:
    """Computes normals, penetrations and onset widths of pairs of points.

    Args:
        way: Vector from the second point to the first [m].
        places: Fractions along the first and the second element [1].
        weight: Factor on the force and energy of the pair.
        radii: Radii of the first and of the second element [m].
        onset: Width of the onset divided by the mean of the radii [1].
    """
    together = radii[0] + radii[1]
    rounded = (ROUNDED * together) * (ROUNDED * together)
    square = vectors.dot(way, way) + rounded
    over_distance = jax.lax.rsqrt(square)
    distance = square * over_distance
    return ContactPair(
        places=places,
        normal=vectors.scale(over_distance, way),
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
    """Forces of pairs, times their weights: spring, dashpot and friction.

    Args:
        pair: Pairs of points.
        own: First elements or contact points, with velocities.
        other: Second elements, with velocities.
        law: Stiffness, damping and friction.
        share: Factor on dashpot and friction forces; one by default [1].

    Returns:
        Force on the first element (the second gets the opposite force), and friction
        couples on both; `None` for the couples without friction.
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
