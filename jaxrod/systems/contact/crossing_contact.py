r"""Contact between rods by the crossing law: each crossing counts once.

Over the segments $i$, $j$ of two rods and the nodes between segments

$$E = \sum_{ij} \big[\psi(p_{ij}) - \psi(p_{vj}) - \psi(p_{iw}) + \psi(p_{vw})\big].$$

Here $\psi$ is the energy of a spring with the smooth onset of
`jaxrod.contacts.contact_law`, and $v$ and $w$ are the second nodes of the segments $i$
and $j$. The penetrations $p$ are those at the closest points of both segments, at the
second node of one segment and the closest point of the other, and at both second nodes.
Segments are pieces of curves that are smooth at nodes
(`jaxrod.systems.contact.smooth_axes`): on polylines, rods at rest on each other would
slide to nodes, where their energy is lower. By inclusion-exclusion over segments and
the nodes between them a crossing counts once, wherever it is and however long segments
are compared with their radius. The sum is smooth, since a node subtracts exactly the
energy that both its segments have there.
Rods that lie side by side also count once, however long the contact is. The law is
meant for nests, nets and knots of long elements. Forces are exactly those of the
energy, and act at one common point of both rods.

Subtracted terms have springs only. Dashpots and friction act at the closest points of
two segments and are reduced in proportion to the normal force that is subtracted. A
subtracted dashpot would act at another point, which moves differently, and would feed
in energy. So next to a node dashpots and friction belong to only one of its two
segments. If the nodes of a rod are numbered in the opposite order, these forces change
there by an amount of first order in the length of a segment.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.contact.element_pairs import (
    Bounds,
    Elements,
    bulge_shares,
    farthest_along,
)
from jaxrod.systems.contact.neighbour_lists import NeighbourLists
from jaxrod.systems.contact.penalty_contact import (
    ContactPair,
    contact_pair,
    pair_forces,
    weight_over_overlap,
)
from jaxrod.systems.contact.rod_segments import (
    SegmentLoads,
    closed_rods,
    last_but_continued,
    rod_segments,
)
from jaxrod.systems.contact.segment_distance import (
    Products,
    apart,
    between,
    crossedness,
    from_products,
    middles,
    nearest_on_curves,
    nearest_places,
    nearest_to_node,
    products,
)
from jaxrod.systems.contact.smooth_axes import stiffest
from jaxrod.systems.contact.touching_rods import TouchingRods, rod_law
from jaxrod.systems.coupling import AllParts, Parts, TiedPair
from jaxrod.validation import Numbers

Tree = TypeVar("Tree")


@pytree
class CrossingContact(TouchingRods):
    """Contact between rods, once for each crossing; see `crossing_contact`.

    Example:
        >>> contact = systems.crossing_contact("left", "right", stiffness=1e3)
        >>> contact.members, contact.self_contact, contact.max_contacts
        (('left', 'right'), False, 2)
    """

    symmetric: ClassVar[bool] = True
    smooth: ClassVar[bool] = True

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> CrossingContact:
        """Copy with the `tied` nodes of its members, near which nothing touches."""
        fitted: Any = self.with_ties(parts, tied)
        return fitted

    def prepared(self, parts: AllParts) -> CrossingContact:
        """The coupling with `segments` set: radii and lengths of segments."""
        made = tuple(
            rod_segments(
                parts[name],
                1,
                last_but_continued(name, parts, self.tied),
                closed_rods(name, parts, self.tied),
            )
            for name in self.members
        )
        return replace(self, segments=made)

    def bounding_radii(self, a: int) -> Array:
        """Radii of the elements of member `a` [m]."""
        return self.segments[a].radii

    def allowed(self, a: int, b: int, own: Bounds, other: Bounds) -> Any:
        """Mask of pairs of members `a`, `b` with weights above zero; `None` for all."""
        share = self.share(a, b, own.elements, other.elements)
        return None if share is None else share > 0

    def scales(self, own: Elements, other: Elements) -> tuple[Array, Array]:
        """Mean radius and mean rest length of each pair of elements [m].

        They set the arc length along a rod at which it begins to touch itself.
        """
        assert own.rest_lengths is not None and other.rest_lengths is not None
        return (
            0.5 * (own.radii + other.radii),
            0.5 * (own.rest_lengths + other.rest_lengths),
        )

    def weights(self, a: int, b: int, own: Elements, other: Elements) -> Array:
        """Weights of pairs: one, or less near ties and for neighbours on a rod [1]."""
        share = self.share(a, b, own, other)
        return jnp.ones_like(own.radii + other.radii) if share is None else share

    def contact_pairs(
        self, own: Elements, other: Elements, weights: Array
    ) -> Iterator[ContactPair]:
        """Five pairs of points for each pair of elements, with their weights.

        Two segments touch at their closest points and, to the degree that they are
        parallel, at the midpoints of their overlap. By inclusion-exclusion, pairs of a
        second node and a segment are subtracted, and pairs of second nodes are added.
        """
        way = vectors.subtract(own.first, other.first)
        lines = way, own.edge, other.edge
        have = products(*lines)
        share = crossedness(have)
        s, t = nearest_on_curves(way, own, other, nearest_places(*lines)[:2])
        on_other = nearest_to_node(way, own, other, have.on_other(1.0))
        back = vectors.scale(-1.0, way)
        on_own = nearest_to_node(back, other, own, have.on_own(1.0))
        one = jnp.ones_like(s)
        radii = own.radii + 0 * s, other.radii + 0 * s
        for places, weight in (
            ((s, t), share * weights),
            (middles(have), (1 - share) * weights),
            ((one, on_other), -own.follows * weights),
            ((on_own, one), -other.follows * weights),
            ((one, one), own.follows * other.follows * weights),
        ):
            between = apart(way, own, other, places)
            yield contact_pair(between, places, weight, radii, self.onset)

    def touching(self, own: Elements, other: Elements, weights: Array) -> Array:
        """Mask of the pairs whose chords are near enough for their axes to touch.

        The chords are a distance d apart, along the unit vector n between their closest
        points. Two points of the axes are at least d - e apart, where e is how far the
        axes bulge towards each other along n: points of chords are d or more apart
        along n.
        """
        way = vectors.subtract(own.first, other.first)
        s, t, square = nearest_places(way, own.edge, other.edge)
        reach = (1 + 0.25 * self.onset) * (own.radii + other.radii)
        towards = between(way, own.edge, other.edge, (s, t))
        away = vectors.scale(-1.0, towards)
        bulging = jnp.zeros_like(square)
        for one, along in ((own, away), (other, towards)):
            if one.bulges is not None:
                bulging = bulging + farthest_along(one.bulges, along)
        # Both sides are multiplied by d, which may be zero.
        return (square - bulging <= reach * jnp.sqrt(square)) & (weights != 0)

    def pair_loads(
        self, own: Elements, other: Elements, weights: Array
    ) -> tuple[SegmentLoads, SegmentLoads]:
        """Loads on the first and the second element of each pair, times `weights`."""
        nearest, middle, *nodes = self.contact_pairs(own, other, weights)
        law = self.law
        pushes = [
            pair.weight * law.spring(pair.depth, pair.width)
            for pair in (nearest, middle, *nodes)
        ]
        all_of_it, left = pushes[0] + pushes[1], sum(pushes)
        pushed = all_of_it > 0
        share = jnp.clip(left / jnp.where(pushed, all_of_it, 1), 0, 1)
        both = [pair_forces(pair, own, other, law, share) for pair in (nearest, middle)]
        spring = replace(law, damping=None, friction=None, friction_drag=None)
        subtracted = [pair_forces(pair, own, other, spring)[0] for pair in nodes]
        forces = [force for force, _ in both] + subtracted
        at_places = map(_conjugate, (nearest, middle, *nodes), forces)
        conjugate, bulges = functools.reduce(_summed, at_places)
        shifting = self._shifting(nearest, middle, own, other)
        force, own_edge, other_edge = _summed(conjugate, shifting)
        own_turn = other_turn = None
        turns = [turn for _, turn in both]
        if turns[0] is not None and turns[1] is not None:
            own_turn, other_turn = _summed(
                _turning_nodes(nearest, turns[0]), _turning_nodes(middle, turns[1])
            )
        back = vectors.scale(-1.0, force)
        return (
            _on_elements(force, own_edge, own_turn, bulges[0]),
            _on_elements(back, other_edge, other_turn, bulges[1]),
        )

    def _shifting(
        self, nearest: ContactPair, middle: ContactPair, own: Elements, other: Elements
    ) -> tuple[Vec3, Vec3, Vec3]:
        """Forces due to changes of the weight c of closest points, and of midpoints.

        The energy of two segments is c times that of contact at their closest points,
        `nearest`, plus 1 - c times that of contact at the midpoints of their overlap,
        `middle`. At the closest points the distance is stationary, so the shift of
        these points along the segments does not contribute.

        Returns:
            Forces conjugate to the vector between the first nodes and to both edges.
        """
        lines = vectors.subtract(own.first, other.first), own.edge, other.edge
        weight = nearest.weight + middle.weight
        first, second = (
            self.law.energy(pair.depth, pair.width) for pair in (nearest, middle)
        )
        push = middle.weight * self.law.spring(middle.depth, middle.width)
        # Broadcast to one shape: derivatives are then those of each pair, not sums over
        # all pairs of an edge.
        shape = jnp.shape(weight)
        have: Products = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, shape), products(*lines)
        )

        def changing(have: Products) -> tuple[Array, tuple[Array, Array]]:
            return crossedness(have), middles(have)

        _, pulled = jax.vjp(changing, have)
        s, t = middle.places
        assert s is not None
        tangents = own.tangent(s), other.tangent(t)
        along = (
            push * vectors.dot(middle.normal, tangents[0]),
            -push * vectors.dot(middle.normal, tangents[1]),
        )
        (slopes,) = pulled((weight * (second - first), along))
        return from_products(slopes, *lines)

    def least_stiffness(self, parts: AllParts) -> Array:
        """Stiffness with which one crossing carries a whole rod [N/m]."""
        members = [parts[name] for name in self.members]
        lengths = []
        for own in members:
            assert own.rest_lengths is not None
            lengths.append(jnp.sum(own.rest_lengths) / own.count)
        return weight_over_overlap(members) * jnp.max(jnp.stack(lengths))

    def bound(self, own: Parts, every: list[Parts]) -> StabilityBound:
        """Bounds of stiffness and drag as if `max_contacts` rods crossed every element.

        A spring's change of length is the sum of the contributions of two rods. Its
        square is at most twice the sum of their squares. Slip has four contributions,
        so its factor is four.
        """
        assert own.radii is not None
        # Each spring acts on six nodes.
        per_rod = jnp.asarray(stiffest(own.n_elements), self.stiffness.dtype)
        crossings = self.max_contacts * jnp.tile(per_rod, own.count)
        drag, turning = self.law.largest_drag, None
        sides = 2 if self.friction_drag is None else 4
        if self.friction_drag is not None and drag is not None:
            turning = 4 * self.max_contacts * drag * own.radii**2
        return StabilityBound(
            nodes=2 * self.stiffness * crossings,
            node_drag=None if drag is None else sides * drag * crossings,
            element_drag=turning,
        )


Bulges = tuple[Vec3, Vec3]
"""Forces conjugate to the bulges of elements at their first and second nodes [N]. A
bulge is the tangent of a smooth axis at a node minus the edge."""


def _conjugate(
    pair: ContactPair, force: Vec3
) -> tuple[tuple[Vec3, Vec3, Vec3], tuple[Bulges, Bulges]]:
    """Forces on edges and bulges of two elements, from the force at a pair of points.

    `force` acts on the first element, its opposite on the second. A bulge is the
    tangent of a smooth axis at a node minus the edge.

    Returns:
        Forces conjugate to the vector between the first nodes and to both edges, and
        forces conjugate to the bulges of both elements.
    """
    s, t = pair.places
    assert s is not None
    back = vectors.scale(-1.0, force)
    edges = force, vectors.scale(s, force), vectors.scale(t, back)
    return edges, (_on_bulges(s, force), _on_bulges(t, back))


def _on_bulges(fraction: Array, force: Vec3) -> Bulges:
    first, second = bulge_shares(fraction)
    return vectors.scale(first, force), vectors.scale(second, force)


def _turning_nodes(
    pair: ContactPair, turns: tuple[Vec3, Vec3]
) -> tuple[tuple[Vec3, Vec3], tuple[Vec3, Vec3]]:
    """Couples at both nodes of each element, from the couples at a pair of points.

    `turns` are the couples on the first and on the second element. Both nodes share
    them with the weights 1 - s and s, at the fraction s along the element.
    """

    def shared(place: Array, turn: Vec3) -> tuple[Vec3, Vec3]:
        later = vectors.scale(place, turn)
        return vectors.subtract(turn, later), later

    s, t = pair.places
    assert s is not None
    return shared(s, turns[0]), shared(t, turns[1])


def _on_elements(
    force: Vec3, edge: Vec3, turning: tuple[Vec3, Vec3] | None, bulges: Bulges
) -> SegmentLoads:
    """Loads on nodes and tangents of segments, from forces on edges and bulges.

    A bulge is a tangent minus the edge, so a force on it also acts on the edge. `force`
    is the total force, `edge` the force conjugate to the edge, and `turning` are the
    couples at both nodes.
    """
    nexts = vectors.subtract(edge, vectors.add(*bulges))
    return SegmentLoads(
        forces=force, nexts=nexts, turning_nodes=turning, tangents=bulges
    )


def _summed(a: Tree, b: Tree) -> Tree:
    return jax.tree.map(jnp.add, a, b)


def crossing_contact(
    *members: str,
    stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    friction: Numbers | None = None,
    friction_drag: Numbers | None = None,
    self_contact: bool = False,
    onset: Numbers = 0.01,
    max_contacts: int = 2,
    lists: NeighbourLists | None = None,
) -> CrossingContact:
    """Contact between all rods of the named members, counted once for each crossing.

    It is for rods that cross and whose elements are longer than a few radii: nests,
    nets, knots. Rods that lie side by side repel each other like one crossing, however
    long they are: use `rod_contact` for bundles.

    Args:
        *members: Names of members; a member is one rod or several equal rods.
        stiffness: Force per penetration of a crossing [N/m]. If it is left out,
            `make_system` chooses it so that this contact halves `stable_dt`
            (`jaxrod.contacts.default_law`). It then also chooses damping and friction
            drag, unless they are given.
        damping: Force per normal speed [kg/s]; zero by default if the stiffness is
            given.
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per slip speed [kg/s]; by default equal to
            `damping`. It is chosen with the stiffness if both that and the damping are
            left out.
        self_contact: Whether each rod also touches itself. Elements that are nearer to
            each other along the rod than pi times its radius do not touch.
        onset: Width of the smooth onset of contact, divided by the mean of the radii
            [1].
        max_contacts: Rods that may cross one element at the same time, for `stable_dt`.
        lists: Settings from `neighbour_lists`; by default there are no lists, and every
            step tests all pairs of elements.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or friction is given without drag.
        TypeError: If a name is not a string.

    Example:
        >>> contact = systems.crossing_contact("warp", "weft", stiffness=1e3)
        >>> system = jaxrod.make_system({"warp": scene, "weft": scene}, contact)
        >>> system.couplings[0].members, system.couplings[0].is_contact
        (('warp', 'weft'), True)
    """
    law = rod_law(
        members,
        stiffness,
        damping,
        friction,
        friction_drag,
        onset,
        self_contact=self_contact,
        max_contacts=max_contacts,
        lists=lists,
        per_length=False,
    )
    return CrossingContact(**law)
