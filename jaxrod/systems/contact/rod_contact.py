r"""Contact between rods, and of rods with themselves: the line law.

Contact points of each rod are tested against the segments of the other, and both ways
count half. Over the segments $j$ of a rod and the nodes $v$ between them

$$E = \tfrac12 \sum_a w_a \Big[\sum_j \psi(p_{aj}) - \sum_v \psi(p_{av})\Big]
  + (\text{the rods exchanged}),$$

with the penetration $p = r_a + r_b - d$ at the closest point of a segment or at a node,
the energy per length $\psi$ of `jaxrod.contacts.contact_law`, and the rest length $w_a$
of a point. By inclusion-exclusion over segments and the nodes between them every
contact counts once, also where the closest point passes from one segment to the next.
So parallel rods press on each other with $k p$ per length, whatever their grids. Forces
of a pair act at one common point between the two surfaces. So momentum and angular
momentum are exact, with damping and friction too, and friction makes both rods roll.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.contacts.contact_law import energy_density
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.along_rods import (
    from_node,
    rod_and_place,
    share_of_gap,
    tied_share,
)
from jaxrod.systems.contact.contact_numbers import contact_numbers
from jaxrod.systems.contact.continued import last_but_continued
from jaxrod.systems.contact.element_pairs import Elements, Pairs, lifted
from jaxrod.systems.contact.line_rows import row_loads, row_nearnesses
from jaxrod.systems.contact.neighbour_lists import NeighbourLists
from jaxrod.systems.contact.neighbour_search import Stretches
from jaxrod.systems.contact.segment_distance import between, products
from jaxrod.systems.contact.strands import (
    points_needed,
    strands,
)
from jaxrod.systems.contact.touches import PairLoads, Touch, loads_of, touch_at
from jaxrod.systems.contact.touching_rods import TouchingRods, same_rod
from jaxrod.systems.members.parts import Parts
from jaxrod.systems.sites.coupling import AllParts, AllSeen, TiedPair
from jaxrod.validation import Numbers, check_count

SPACING = 1 / 3
"""Largest distance between neighbouring contact points over the radius [1]."""


@pytree
class RodContact(TouchingRods):
    """Contact between all rods of some members; see `rod_contact`."""

    points_per_element: tuple[int, ...] = static(default=())
    """Contact points per element of each member, once fitted; or one number for all."""

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> RodContact:
        """The coupling with the number of points, and with the tied nodes."""
        fitted: Any = self.with_ties(parts, tied)
        given = self.points_per_element * len(self.members)
        per = given or tuple(
            points_needed("rod_contact", name, parts[name], SPACING)
            for name in self.members
        )
        return replace(fitted, points_per_element=per)

    def prepared(self, parts: AllParts) -> RodContact:
        """The coupling with radii and lengths of points and segments."""
        made = tuple(
            strands(parts[name], per, last_but_continued(name, parts, self.tied))
            for name, per in zip(self.members, self.points_per_element, strict=True)
        )
        return replace(self, strands=made)

    dotted: ClassVar[bool] = True

    # With lists of neighbours: pairs of elements.

    def views(self) -> list[tuple[int, int]]:
        """Pairs of members; points of the first meet segments of the second."""
        count = len(self.members)
        return [
            (a, b)
            for a in range(count)
            for b in range(count)
            if a != b or self.itself or self.strands[a].count > 1
        ]

    def bounding_radii(self, a: int) -> Array:
        """Largest of an element's own radius and those of its points [m]."""
        return jnp.maximum(self.strands[a].first_radii, self.strands[a].radii)

    def allowed(self, a: int, b: int, own: Stretches, other: Stretches) -> Any:
        """Whether pairs may touch: those of two rods, or far apart along one rod."""
        if a != b:
            return None
        one, two = own.elements, other.elements
        may = ~same_rod(one, two)
        if self.itself:
            assert one.starts is not None and two.starts is not None
            apart = jnp.maximum(two.starts - one.starts, one.ends - two.ends)
            may = may | (apart > math.pi * two.radii)
        return may

    def touches(self, a: int, b: int, pairs: Pairs) -> Iterator[Touch]:
        """Touches of points with closest points on segments, and with their next nodes.

        The latter count negative, and only where another segment follows.
        """
        own, other = lifted(pairs.own), lifted(pairs.other)
        points = points_on(lifted(pairs.own), self.strands[a].per_element)
        way = vectors.subtract(own.first, other.first)
        have = products(way, own.edge, other.edge)
        weights = self._weights(a, b, pairs, points)
        nearest = have.on_other(points.fractions)
        on_own = jnp.broadcast_to(points.fractions, nearest.shape)
        radii = points.radii + 0 * nearest, other.radii + 0 * nearest
        for fraction, weight in (
            (nearest, weights),
            (jnp.ones_like(nearest), -other.follows * weights),
        ):
            apart = between(way, own.edge, other.edge, (on_own, fraction))
            yield touch_at(apart, (on_own, fraction), weight, radii, self.onset)

    def pair_loads(self, a: int, b: int, pairs: Pairs) -> PairLoads:
        """Loads of all points of each pair."""
        own, other = lifted(pairs.own), lifted(pairs.other)
        first, second = (
            loads_of(touch, own, other, self.law) for touch in self.touches(a, b, pairs)
        )
        return jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), first.added(second))

    def _weights(self, a: int, b: int, pairs: Pairs, points: ElementPoints) -> Array:
        """Rest length for which points count: half, since both ways are summed [m]."""
        own, other = lifted(pairs.own), lifted(pairs.other)
        assert pairs.listed is not None
        half = jnp.where(pairs.listed.there[None], 0.5 * points.lengths, 0)
        if a == b and self.itself:
            assert other.starts is not None and other.rest_lengths is not None
            gap = jnp.maximum(other.starts - points.places, points.places - other.ends)
            share = share_of_gap(gap, other.radii, other.rest_lengths)
            half = half * jnp.where(same_rod(own, other), share, 1)
        for one, i, two, j in self.tied:
            if (one, two) != (self.members[a], self.members[b]):
                continue
            assert other.starts is not None and other.rest_lengths is not None
            assert own.rods is not None and other.rods is not None
            rod, place = rod_and_place(self.strands[a], i)
            fellow, mark = rod_and_place(self.strands[b], j)
            half = half * tied_share(
                (
                    jnp.abs(points.places - place),
                    from_node(other.starts, other.ends, mark),
                ),
                jnp.equal(own.rods, rod) & jnp.equal(other.rods, fellow),
                (points.radii, other.radii),
                other.rest_lengths,
            )
        return half

    # Without lists: rows of all points and all segments.

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on all members."""
        if self.found is not None:
            return super().loads(seen)
        return row_loads(self, seen)

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]; NaN if lists have missed some."""
        if self.found is not None:
            return super().energy(seen)
        total = jnp.zeros((), self.stiffness.dtype)
        for near in row_nearnesses(self, seen):
            density = energy_density(near.depth, near.width, self.stiffness)
            total = total + jnp.sum(near.weight * density)
        return total

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration over half the sum of the radii."""
        if self.found is not None:
            return super().violation(seen)
        worst = jnp.zeros((), self.stiffness.dtype)
        for near in row_nearnesses(self, seen):
            depth = jnp.where(near.weight > 0, near.depth, 0)
            worst = jnp.maximum(worst, jnp.max(depth / near.half_sum))
        return worst

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stiffness and drag as if all of every rod touched its partners.

        A spring's change of length is the sum of the contributions of two rods. Its
        square is at most twice the sum of their squares. Slip has four contributions,
        from the velocities and spins of both rods, shared in proportion to inertia.
        """
        easiest = None
        if self.friction_drag is not None:
            eases = [_ease(parts[name]) for name in self.members]
            easiest = jnp.max(jnp.stack(eases))
        return {name: self._bound(parts[name], easiest) for name in self.members}

    def _bound(self, own: Parts, easiest: Array | None) -> StabilityBound:
        """Bounds on one member; `easiest` is the largest ease of all with friction."""
        assert own.linear_density is not None
        # Length for which a node stands, from its mass.
        lengths = self.partners * own.node_masses / jnp.min(own.linear_density)
        stiffness = 2 * self.stiffness * lengths
        drag = None if self.damping is None else 2 * self.damping * lengths
        if easiest is None:
            return StabilityBound(nodes=stiffness, node_drag=drag)
        assert self.friction_drag is not None
        rate = self.partners * self.friction_drag * (_ease(own) + easiest)
        # Dashpots act across the surfaces, friction along them: the larger one counts.
        rub = rate * own.node_masses
        return StabilityBound(
            nodes=stiffness,
            node_drag=rub if drag is None else jnp.maximum(drag, rub),
            element_drag=rate * jnp.min(own.inertias, axis=0),
        )


def _ease(own: Parts) -> Array:
    """Largest speed of a rod's surface per impulse along it, times length [m/kg]."""
    assert own.linear_density is not None and own.rest_lengths is not None
    assert own.radii is not None
    inertia = jnp.min(own.inertias, axis=0) / own.rest_lengths
    return jnp.max(1 / own.linear_density + own.radii**2 / inertia)


def rod_contact(
    *members: str,
    stiffness: Numbers,
    damping: Numbers | None = None,
    friction: Numbers | None = None,
    friction_drag: Numbers | None = None,
    itself: bool = False,
    onset: Numbers = 0.01,
    points_per_element: int | None = None,
    partners: int = 2,
    lists: NeighbourLists | None = None,
) -> RodContact:
    """Contact between all rods of the named members.

    Args:
        *members: Names of members; a member is one rod or several equal rods.
        stiffness: Force per length of contact and penetration [N/m^2].
        damping: Force per length and normal speed [kg/(m s)].
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per length and slip speed [kg/(m s)]; by default
            equal to `damping`.
        itself: Whether each rod also touches itself. Places that are nearer to each
            other along the rod than pi times its radius do not touch.
        onset: Width of the smooth onset of contact over the mean of the radii [1].
        points_per_element: Contact points per element; by default so many that they
            are at most a third of a radius apart. Then the energy of crossing rods is
            the same to 3 % wherever they cross.
        partners: Rods that may touch one place at the same time, for `stable_dt`: 2
            for a few rods, 6 in a bundle.
        lists: Lists of neighbours, from `neighbour_lists`; by default every step tests
            all points against all segments.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or friction has no drag.
        TypeError: If a name is not a string.
    """
    if points_per_element is not None:
        check_count("points_per_element", points_per_element, 1, 1000)
    given = contact_numbers(
        members,
        stiffness,
        (damping, friction, friction_drag),
        onset,
        partners,
        lists,
        units=("N/m^2", "kg/(m s)"),
    )
    return RodContact(
        **given,
        itself=bool(itself),
        points_per_element=() if points_per_element is None else (points_per_element,),
    )


@pytree
class ElementPoints:
    """Contact points of the elements of pairs."""

    fractions: Array
    """Places of the points on their element, over its length [1]."""
    lengths: Array
    """Rest length that each point stands for [m]."""
    radii: Array
    """Radius at each point [m]."""
    places: Array
    """Rest arc length of each point along its rod [m]."""


def points_on(own: Elements, per_element: int) -> ElementPoints:
    """Contact points of elements that have a leading axis of length one for points."""
    assert own.first_radii is not None and own.first_lengths is not None
    assert own.starts is not None and own.rest_lengths is not None
    assert own.last is not None
    counts = np.arange(per_element + 1).reshape(-1, *[1] * (own.radii.ndim - 1))
    fractions = jnp.asarray(counts / per_element, own.radii.dtype)
    spacing = own.rest_lengths / per_element
    at_end = 0.5 * own.last * spacing
    within = jnp.where(counts == per_element, at_end, spacing)
    return ElementPoints(
        fractions=fractions,
        lengths=jnp.where(counts == 0, own.first_lengths, within),
        radii=jnp.where(counts == 0, own.first_radii, own.radii),
        places=own.starts + fractions * own.rest_lengths,
    )
