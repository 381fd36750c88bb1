r"""Contact between rods by the crossing law: each crossing counts once.

Over the segments $i$, $j$ of two rods and the nodes between segments

$$E = \sum_{ij} \big[\psi(p_{ij}) - \psi(p_{vj}) - \psi(p_{iw}) + \psi(p_{vw})\big].$$

The penetration $p$ is taken at the closest points of two segments, of the next node $v$
or $w$ of one segment and the other segment, and of both nodes. Segments are pieces of
curves that are smooth at nodes (`jaxrod.systems.contact.smooth_axes`): on polylines,
rods at rest on each other would slide to nodes, where their energy is lower. By
inclusion-exclusion over segments and the nodes between them a crossing counts once,
wherever it is and however long segments are for their radius. It does so smoothly,
since a node subtracts exactly what both its segments have there. Rods that lie side by
side also count once, however long the contact is: the law is for nests, nets and knots
of long elements. Forces are exactly those of the energy, and act at one common point of
both rods.

Subtracted terms have springs only. Dashpots and friction act at the closest points of
two segments, reduced by the share of the push that is subtracted. A subtracted dashpot
would be at another place, which moves differently, and would feed in energy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.contacts.contact_law import energy_density, normal_force
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.contact.along_rods import (
    from_node,
    rod_and_place,
    share_of_gap,
    tied_share,
)
from jaxrod.systems.contact.contact_numbers import contact_numbers
from jaxrod.systems.contact.continued import closed_rods, last_but_continued
from jaxrod.systems.contact.curve_distance import (
    apart,
    nearest_on_curves,
    nearest_to_node,
)
from jaxrod.systems.contact.element_pairs import Elements, Pairs
from jaxrod.systems.contact.neighbour_lists import NeighbourLists
from jaxrod.systems.contact.neighbour_search import Stretches
from jaxrod.systems.contact.segment_distance import (
    Products,
    crossedness,
    from_products,
    middles,
    nearest_places,
    products,
)
from jaxrod.systems.contact.smooth_axes import stiffest
from jaxrod.systems.contact.strands import strands
from jaxrod.systems.contact.touches import (
    PairLoads,
    Touch,
    elastic_push,
    loads_of,
    touch_at,
)
from jaxrod.systems.contact.touching_rods import TouchingRods, same_rod
from jaxrod.systems.members.parts import Parts
from jaxrod.systems.sites.coupling import AllParts, TiedPair
from jaxrod.validation import Numbers


@pytree
class CrossingContact(TouchingRods):
    """Contact between all rods of some members; see `crossing_contact`."""

    once: ClassVar[bool] = True
    smooth: ClassVar[bool] = True

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> CrossingContact:
        """The coupling with the tied nodes, near which nothing touches."""
        fitted: Any = self.with_ties(parts, tied)
        return fitted

    def prepared(self, parts: AllParts) -> CrossingContact:
        """The coupling with radii and lengths of segments."""
        made = tuple(
            strands(
                parts[name],
                1,
                last_but_continued(name, parts, self.tied),
                closed_rods(name, parts, self.tied),
            )
            for name in self.members
        )
        return replace(self, strands=made)

    def views(self) -> list[tuple[int, int]]:
        """Numbers of pairs of members whose elements meet, each pair once."""
        count = len(self.members)
        return [
            (a, b)
            for a in range(count)
            for b in range(a, count)
            if a != b or self.itself or self.strands[a].count > 1
        ]

    def bounding_radii(self, a: int) -> Array:
        """Radii of the elements [m]."""
        return self.strands[a].radii

    def allowed(self, a: int, b: int, own: Stretches, other: Stretches) -> Any:
        """Whether pairs may touch: those of two rods, or far apart along one rod."""
        share = self._share(a, b, own.elements, other.elements)
        return None if share is None else share > 0

    def _share(self, a: int, b: int, own: Elements, other: Elements) -> Array | None:
        """Share with which pairs of elements count [1]; `None` for one."""
        share: Array | None = None
        if a == b:
            same = same_rod(own, other)
            near = jnp.zeros_like(own.radii + other.radii)
            if self.itself:
                assert own.starts is not None and other.starts is not None
                assert own.rest_lengths is not None
                assert other.rest_lengths is not None
                gap = jnp.maximum(own.starts - other.ends, other.starts - own.ends)
                length = 0.5 * (own.rest_lengths + other.rest_lengths)
                near = share_of_gap(gap, 0.5 * (own.radii + other.radii), length)
            share = jnp.where(same, near, 1)
        for one, i, two, j in self.tied:
            if (one, two) == (self.members[a], self.members[b]):
                tied = self._tied(a, b, (i, j), own, other)
                share = tied if share is None else share * tied
        return share

    def _tied(
        self, a: int, b: int, nodes: tuple[int, int], own: Elements, other: Elements
    ) -> Array:
        assert own.starts is not None and other.starts is not None
        assert own.rest_lengths is not None and other.rest_lengths is not None
        rod, place = rod_and_place(self.strands[a], nodes[0])
        fellow, mark = rod_and_place(self.strands[b], nodes[1])
        assert own.rods is not None and other.rods is not None
        return tied_share(
            (
                from_node(own.starts, own.ends, place),
                from_node(other.starts, other.ends, mark),
            ),
            jnp.equal(own.rods, rod) & jnp.equal(other.rods, fellow),
            (own.radii, other.radii),
            0.5 * (own.rest_lengths + other.rest_lengths),
        )

    def _weights(self, a: int, b: int, pairs: Pairs) -> Array:
        """Weights of pairs [1]."""
        own, other = pairs.own, pairs.other
        share = self._share(a, b, own, other)
        if pairs.listed is not None:
            # Lists hold every pair of elements once.
            there = pairs.listed.there.astype(own.radii.dtype)
            return there if share is None else jnp.where(pairs.listed.there, share, 0)
        ones = jnp.ones_like(own.radii + other.radii)
        share = ones if share is None else share
        if a != b:
            return share
        size = self.strands[a].radii.shape[0]
        before = jnp.arange(size)[:, None] < jnp.arange(size)[None, :]
        return jnp.where(before, share, 0)

    def touches(self, a: int, b: int, pairs: Pairs) -> Iterator[Touch]:
        """Touches of two segments, of a node and a segment (both ways), of two nodes.

        Two segments touch at their closest points and, as far as they are parallel, at
        their middles.
        """
        own, other = pairs.own, pairs.other
        way = vectors.subtract(own.first, other.first)
        lines = way, own.edge, other.edge
        weight = self._weights(a, b, pairs)
        have = products(*lines)
        share = crossedness(have)
        s, t = nearest_on_curves(way, own, other, nearest_places(*lines)[:2])
        on_other = nearest_to_node(way, own, other, have.on_other(1.0))
        back = vectors.scale(-1.0, way)
        on_own = nearest_to_node(back, other, own, have.on_own(1.0))
        one = jnp.ones_like(s)
        radii = own.radii + 0 * s, other.radii + 0 * s
        for places, counts in (
            ((s, t), share * weight),
            (middles(have), (1 - share) * weight),
            ((one, on_other), -own.follows * weight),
            ((on_own, one), -other.follows * weight),
            ((one, one), own.follows * other.follows * weight),
        ):
            between = apart(way, own, other, places)
            yield touch_at(between, places, counts, radii, self.onset)

    def pair_loads(self, a: int, b: int, pairs: Pairs) -> PairLoads:
        """Loads of all touches."""
        own, other = pairs.own, pairs.other
        nearest, middle, *nodes = self.touches(a, b, pairs)
        law = self.law
        spring = replace(law, damping=None, friction=None, friction_drag=None)
        pushes = [
            touch.weight * elastic_push(touch, law)
            for touch in (nearest, middle, *nodes)
        ]
        all_of_it, left = pushes[0] + pushes[1], sum(pushes)
        pushed = all_of_it > 0
        share = jnp.clip(left / jnp.where(pushed, all_of_it, 1), 0, 1)
        total = loads_of(nearest, own, other, law, share)
        total = total.added(loads_of(middle, own, other, law, share))
        for touch in nodes:
            total = total.added(loads_of(touch, own, other, spring))
        way, own_edge, other_edge = self._shifting(nearest, middle, pairs)
        return replace(
            total,
            way=vectors.add(total.way, way),
            own_edge=vectors.add(total.own_edge, own_edge),
            other_edge=vectors.add(total.other_edge, other_edge),
        )

    def _shifting(
        self, nearest: Touch, middle: Touch, pairs: Pairs
    ) -> tuple[Vec3, Vec3, Vec3]:
        """Additional forces of the energy of segments that are nearly parallel.

        At the closest points the distance is stationary, so the shift of these points
        along the segments does not contribute. The shift of the middles does, and so
        does the change of the shares of both touches.
        """
        own, other = pairs.own, pairs.other
        lines = vectors.subtract(own.first, other.first), own.edge, other.edge
        weight = nearest.weight + middle.weight
        first, second = (
            energy_density(touch.depth, touch.width, self.stiffness)
            for touch in (nearest, middle)
        )
        push = middle.weight * normal_force(
            middle.depth, jnp.zeros_like(middle.depth), middle.width, self.stiffness
        )
        # Broadcast to one shape: derivatives are then those of each pair, not sums over
        # all pairs of an edge.
        shape = jnp.shape(weight)
        have: Products = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, shape), products(*lines)
        )

        def changing(have: Products) -> tuple[Array, tuple[Array, Array]]:
            return crossedness(have), middles(have)

        _, pulled = jax.vjp(changing, have)
        tangents = (
            own.tangent(middle.own_fraction),
            other.tangent(middle.other_fraction),
        )
        along = (
            push * vectors.dot(middle.normal, tangents[0]),
            -push * vectors.dot(middle.normal, tangents[1]),
        )
        (slopes,) = pulled((weight * (second - first), along))
        return from_products(slopes, *lines)

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stiffness and drag as if all partners crossed every element at its worst.

        A spring's change of length is the sum of the contributions of two rods. Its
        square is at most twice the sum of their squares. Slip has four contributions,
        so there the factor is four.
        """
        return {name: self._bound(parts[name]) for name in self.members}

    def _bound(self, own: Parts) -> StabilityBound:
        assert own.radii is not None
        # Each spring acts on six nodes.
        per_rod = jnp.asarray(stiffest(own.n_elements), self.stiffness.dtype)
        crossings = self.partners * jnp.tile(per_rod, own.count)
        drag, sides, turning = self.damping, 2, None
        if self.friction_drag is not None:
            rub = self.friction_drag
            drag, sides = rub if drag is None else jnp.maximum(drag, rub), 4
            turning = 4 * self.partners * drag * own.radii**2
        return StabilityBound(
            nodes=2 * self.stiffness * crossings,
            node_drag=None if drag is None else sides * drag * crossings,
            element_drag=turning,
        )


def crossing_contact(
    *members: str,
    stiffness: Numbers,
    damping: Numbers | None = None,
    friction: Numbers | None = None,
    friction_drag: Numbers | None = None,
    itself: bool = False,
    onset: Numbers = 0.01,
    partners: int = 2,
    lists: NeighbourLists | None = None,
) -> CrossingContact:
    """Contact between all rods of the named members, counted once for each crossing.

    It is for rods that cross and whose elements are longer than some radii: nests,
    nets, knots. Rods that lie side by side repel each other like one crossing, however
    long they are: use `rod_contact` for bundles.

    Args:
        *members: Names of members; a member is one rod or several equal rods.
        stiffness: Force per penetration of a crossing [N/m].
        damping: Force per normal speed [kg/s].
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per slip speed [kg/s]; by default equal to
            `damping`.
        itself: Whether each rod also touches itself. Elements that are nearer to each
            other along the rod than pi times its radius do not touch.
        onset: Width of the smooth onset of contact over the mean of the radii [1].
        partners: Rods that may cross one element at the same time, for `stable_dt`.
        lists: Lists of neighbours, from `neighbour_lists`; by default every step tests
            all pairs of elements.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or friction has no drag.
        TypeError: If a name is not a string.
    """
    given = contact_numbers(
        members,
        stiffness,
        (damping, friction, friction_drag),
        onset,
        partners,
        lists,
        units=("N/m", "kg/s"),
    )
    return CrossingContact(**given, itself=bool(itself))
