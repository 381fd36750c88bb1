r"""Contact between rods, and of rods with themselves: the line law.

Contact points of each rod are tested against the segments of the other, and each
direction counts half. Over the segments $j$ of a rod and the nodes $v$ between them

$$E = \tfrac12 \sum_a w_a \Big[\sum_j \psi(p_{aj}) - \sum_v \psi(p_{av})\Big]
  + (\text{the rods exchanged}),$$

with the penetration $p = r_a + r_b - d$ at the closest point of a segment or at a node,
for the radii $r$ and the distance $d$ of the axes, the energy per length $\psi$ of
`jaxrod.contacts.contact_law`, and the rest length $w_a$ that a point $a$ represents. By
inclusion-exclusion over segments and the nodes between them every contact counts once,
also where the closest point passes from one segment to the next. So parallel rods press
on each other with the force $k p$ per length, for any sizes of their elements. Forces
of a pair act at one common point between the two surfaces. So momentum and angular
momentum are conserved exactly, also with damping and friction, and friction makes both
rods roll.
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

from jaxrod.contacts.points import fewer_points
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.element_pairs import Bounds, Elements, row_vector
from jaxrod.systems.contact.neighbour_lists import NeighbourLists
from jaxrod.systems.contact.penalty_contact import (
    ContactPair,
    contact_pair,
    pair_forces,
    weight_over_overlap,
)
from jaxrod.systems.contact.rod_segments import (
    ContactPoints,
    SegmentLoads,
    last_but_continued,
    points_at,
    points_needed,
    rod_segments,
)
from jaxrod.systems.contact.touching_rods import TouchingRods, rod_law, same_rod
from jaxrod.systems.coupling import AllParts, AllSeen, Parts, TiedPair
from jaxrod.validation import Numbers, check_count

SPACING = 1 / 3
"""Largest distance between neighbouring contact points divided by the radius [1]."""


@pytree
class RodContact(TouchingRods):
    """Contact per length between all rods of some members; see `rod_contact`.

    Example:
        >>> contact = systems.rod_contact("left", "right", stiffness=1e5)
        >>> contact.members, contact.self_contact, contact.max_contacts
        (('left', 'right'), False, 2)
    """

    points_per_element: tuple[int, ...] = static(default=())
    """Contact points per element: one number for all, or, after `fitted`, one per
    member."""

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> RodContact:
        """The coupling with the number of contact points and the tied nodes set."""
        fitted: Any = self.with_ties(parts, tied)
        given = self.points_per_element
        # One number from the factory; one for each member if this was fitted before.
        given = given * len(self.members) if len(given) == 1 else given
        per = given or tuple(
            points_needed("rod_contact", name, parts[name], SPACING)
            for name in self.members
        )
        return replace(fitted, points_per_element=per)

    def regridded(self, grids: Any) -> RodContact:
        """Copy with contact points as dense on the new elements as on the old ones."""
        made: Any = super().regridded(grids)
        per = tuple(
            grids.points_per_element(name, count)
            for name, count in zip(self.members, self.points_per_element, strict=True)
        )
        return replace(made, points_per_element=per)

    def thinned(self, share: float) -> RodContact:
        """Copy with a share of the contact points per element, at least one."""
        per = tuple(fewer_points(count, share) for count in self.points_per_element)
        return replace(self, points_per_element=per)

    def prepared(self, parts: AllParts) -> RodContact:
        """The coupling with `segments` set: the segments and points of members."""
        made = tuple(
            rod_segments(parts[name], per, last_but_continued(name, parts, self.tied))
            for name, per in zip(self.members, self.points_per_element, strict=True)
        )
        return replace(self, segments=made)

    has_contact_points: ClassVar[bool] = True

    def bounding_radii(self, a: int) -> Array:
        """Largest radius of each element of member `a`, for the search [m].

        It is the larger of the element's own radius and that of its first node.
        """
        return jnp.maximum(self.segments[a].first_radii, self.segments[a].radii)

    def allowed(self, a: int, b: int, own: Bounds, other: Bounds) -> Any:
        """Mask of the pairs of elements that may touch; `None` for all.

        Elements of two members or of two rods may touch. Elements of one rod may touch
        with self-contact if some point of the first is more than pi times the radius
        away from the second along the rod.
        """
        if a != b:
            return None
        one, two = own.elements, other.elements
        may = ~same_rod(one, two)
        if self.self_contact:
            assert one.starts is not None and two.starts is not None
            # The farthest point of an element is at its start or at its end.
            apart = jnp.maximum(two.starts - one.starts, one.ends - two.ends)
            may = may | (apart > math.pi * two.radii)
        return may

    def in_rows(self, a: int, own: Elements, seen: AllSeen) -> ContactPoints:
        """All contact points of member `a`, in place of its elements `own`."""
        rubs = self.friction is not None
        return points_at(self.segments[a], seen[self.members[a]], spins=rubs)

    def on_list(
        self, a: int, own: Elements, other: Elements, there: Array
    ) -> tuple[ContactPoints, Elements, Array]:
        """Contact points of the listed elements `own` and `other`, and a mask.

        All have a leading axis: over the points of an element for the first, of length
        one for the others. The mask `there` is true for entries in use.
        """
        points = points_on(row_vector(own), self.segments[a].per_element)
        return points, row_vector(other), row_vector(there)

    def weights(self, a: int, b: int, own: ContactPoints, other: Elements) -> Array:
        """Weights of point-segment pairs: half the point's rest length, or less [m].

        The half is there because the points of each rod are tested against the segments
        of the other. Weights are smaller near tied nodes and between neighbouring
        elements of one rod.
        """
        half = 0.5 * own.lengths
        share = self.share(a, b, own, other)
        return half if share is None else half * share

    def scales(self, own: ContactPoints, other: Elements) -> tuple[Array, Array]:
        """Radii and rest lengths of the segments, which limit self-contact [m]."""
        assert other.rest_lengths is not None
        return other.radii, other.rest_lengths

    def contact_pairs(
        self, own: ContactPoints, other: Elements, weights: Array
    ) -> Iterator[ContactPair]:
        """Pairs contact points with closest points on segments, and with second nodes.

        Pairs with second nodes have negative weights (inclusion-exclusion), or zero
        where no other segment follows.
        """
        apart, closest = nearest_on_segment(own, other)
        radii = own.radii, other.radii
        for fraction, weight in (
            (closest, weights),
            (jnp.ones_like(closest), -other.follows * weights),
        ):
            way = vectors.subtract(apart, vectors.scale(fraction, other.edge))
            yield contact_pair(way, (None, fraction), weight, radii, self.onset)

    def touching(self, own: ContactPoints, other: Elements, weights: Array) -> Array:
        """Mask of point-segment pairs whose surfaces are nearer than the onset.

        The second node of a segment is no nearer than the closest point.
        """
        apart, closest = nearest_on_segment(own, other)
        way = vectors.subtract(apart, vectors.scale(closest, other.edge))
        reach = (1 + 0.25 * self.onset) * (own.radii + other.radii)
        return (vectors.dot(way, way) < reach * reach) & (weights != 0)

    def pair_loads(
        self, own: ContactPoints, other: Elements, weights: Array
    ) -> tuple[SegmentLoads, SegmentLoads]:
        """Loads on points and on segments, for each pair of both, times `weights`."""
        closest, node = self.contact_pairs(own, other, weights)
        force, turns = pair_forces(closest, own, other, self.law)
        subtracted, others = pair_forces(node, own, other, self.law)
        fraction = closest.places[1]
        nexts = vectors.add(vectors.scale(fraction, force), subtracted)
        force = vectors.add(force, subtracted)
        own_turn = other_turns = None
        if turns is not None and others is not None:
            own_turn = vectors.add(turns[0], others[0])
            later = vectors.scale(fraction, turns[1])
            other_turns = (
                vectors.subtract(turns[1], later),
                vectors.add(later, others[1]),
            )
        return (
            SegmentLoads(on_points=force, turning_points=own_turn),
            SegmentLoads(
                forces=vectors.scale(-1.0, force),
                nexts=vectors.scale(-1.0, nexts),
                turning_nodes=other_turns,
            ),
        )

    def collected(
        self, own: ContactPoints, on_own: SegmentLoads, on_other: SegmentLoads
    ) -> tuple[SegmentLoads, SegmentLoads]:
        """Loads on first and second elements of a list, summed over contact points.

        `on_own` are the loads on the points `own`, and `on_other` those on second
        elements. Both have a leading axis over the points of an element.
        """
        force, turns = on_own.on_points, on_own.turning_points
        assert force is not None and own.fractions is not None
        nexts = vectors.scale(own.fractions, force)
        within = at_nodes = None
        if turns is not None:
            first, last = (own.fractions == end for end in (0, 1))
            at_nodes = vectors.scale(first, turns), vectors.scale(last, turns)
            within = vectors.scale(~(first | last), turns)
        both = (
            SegmentLoads(
                forces=force, nexts=nexts, turning=within, turning_nodes=at_nodes
            ),
            replace(on_other, forces=None),
        )
        one, two = jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), both)
        assert one.forces is not None
        # The force on the segment is opposite to that on the points: one sum is enough.
        return one, replace(two, forces=vectors.scale(-1.0, one.forces))

    def least_stiffness(self, parts: AllParts) -> Array:
        """Stiffness with which rods carry their own weight [N/m^2]."""
        return weight_over_overlap(parts[name] for name in self.members)

    def bound(self, own: Parts, every: list[Parts]) -> StabilityBound:
        """Bounds of stiffness and drag with `max_contacts` rods along the whole rod.

        A spring's change of length is the sum of the contributions of two rods. Its
        square is at most twice the sum of their squares. Slip has four contributions,
        from the velocities and spins of both rods, shared in proportion to inertia.
        `own` and `every` are the constants of the rod's member and of all members.
        """
        assert own.linear_density is not None
        # Length that a node represents, from its mass.
        lengths = self.max_contacts * own.node_masses / jnp.min(own.linear_density)
        if own.mass_matrix == "higher_order":
            # At least 5/12 of an element's mass is at either of its nodes.
            lengths = 1.2 * lengths
        stiffness = 2 * self.stiffness * lengths
        drag = None if self.damping is None else 2 * self.damping * lengths
        if self.friction_drag is None:
            return StabilityBound(nodes=stiffness, node_drag=drag)
        easiest = jnp.max(jnp.stack([_ease(parts) for parts in every]))
        rate = self.max_contacts * self.friction_drag * (_ease(own) + easiest)
        # Dashpots act across the surfaces and friction along them, so the larger one
        # counts.
        rub = rate * own.node_masses
        return StabilityBound(
            nodes=stiffness,
            node_drag=rub if drag is None else jnp.maximum(drag, rub),
            element_drag=rate * jnp.min(own.inertias, axis=0),
        )


def _ease(own: Parts) -> Array:
    """Largest mobility of a surface, 1/m + r^2/J, with m and J per length [m/kg]."""
    assert own.linear_density is not None and own.rest_lengths is not None
    assert own.radii is not None
    inertia = jnp.min(own.inertias, axis=0) / own.rest_lengths
    return jnp.max(1 / own.linear_density + own.radii**2 / inertia)


def rod_contact(
    *members: str,
    stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    friction: Numbers | None = None,
    friction_drag: Numbers | None = None,
    self_contact: bool = False,
    onset: Numbers = 0.01,
    points_per_element: int | None = None,
    max_contacts: int = 2,
    lists: NeighbourLists | None = None,
) -> RodContact:
    """Contact between all rods of the named members, per length of contact.

    Args:
        *members: Names of members; a member is one rod or several equal rods.
        stiffness: Force per length of contact and penetration [N/m^2]. If it is left
            out, `make_system` chooses it so that this contact halves `stable_dt`
            (`jaxrod.contacts.default_law`). It then also chooses damping and friction
            drag, unless they are given.
        damping: Force per length and normal speed [kg/(m s)]; zero by default if the
            stiffness is given.
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per length and slip speed [kg/(m s)]; by default
            equal to `damping`. It is chosen with the stiffness if both that and the
            damping are left out.
        self_contact: Whether each rod also touches itself. Two parts that are less than
            pi radii apart along the rod do not touch.
        onset: Width of the smooth onset of contact, divided by the mean of the radii
            [1].
        points_per_element: Contact points per element; by default enough that they are
            at most a third of a radius apart. Then the energy of crossing rods is the
            same to 3 % wherever they cross.
        max_contacts: Number of rods that may touch a rod at one place and time, for
            `stable_dt`: 2 for a few rods, 6 in a bundle.
        lists: Settings from `neighbour_lists`; by default there are no lists, and every
            step tests all points against all segments.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or friction is given without drag.
        TypeError: If a name is not a string.

    Example:
        >>> contact = systems.rod_contact("left", "right", stiffness=1e5)
        >>> system = jaxrod.make_system({"left": scene, "right": scene}, contact)
        >>> near = replace(state, positions=state.positions.at[1].add(0.03))
        >>> energy = system.potential_energy({"left": state, "right": near})
        >>> round(float(energy), 2)  # 1 m touches, 1 cm deep [J]
        5.0
    """
    if points_per_element is not None:
        check_count("points_per_element", points_per_element, 1, 1000)
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
        per_length=True,
    )
    per = () if points_per_element is None else (points_per_element,)
    return RodContact(**law, points_per_element=per)


def nearest_on_segment(own: ContactPoints, other: Elements) -> tuple[Vec3, Array]:
    """Vectors from segments' first nodes to points; fractions of closest points.

    Returns:
        Vectors from the first nodes of segments `other` to the points `own` [m], and
        the fractions along the segments at which these are closest to the points [1].
    """
    apart = vectors.subtract(own.position, other.first)
    over_square = 1 / vectors.dot(other.edge, other.edge)
    along = vectors.dot(apart, other.edge) * over_square
    return apart, jnp.clip(along, 0, 1)


def points_on(own: Elements, per_element: int) -> ContactPoints:
    """Contact points of elements `own` `(1, pairs)`, in arrays `(points, pairs)`.

    There are `per_element + 1` points on each element, both nodes included. The second
    node counts only at the end of a rod.
    """
    assert own.first_radii is not None and own.first_lengths is not None
    assert own.starts is not None and own.rest_lengths is not None
    assert own.last is not None and own.rods is not None
    counts = np.arange(per_element + 1)[:, None]
    fractions = jnp.asarray(counts / per_element, own.radii.dtype)
    spacing = own.rest_lengths / per_element
    at_end = 0.5 * own.last * spacing
    within = jnp.where(counts == per_element, at_end, spacing)
    moves = own.first_velocity is not None
    spin: Vec3 | None = None
    if own.spin is not None:
        on_nodes = counts % per_element == 0
        x, y, z = (
            jnp.where(on_nodes, at_node, within)
            for at_node, within in zip(own.spin_at(fractions), own.spin, strict=True)
        )
        spin = x, y, z
    return ContactPoints(
        position=vectors.add(own.first, own.on_axis(fractions)),
        velocity=own.velocity_at(fractions) if moves else None,
        spin=spin,
        radii=jnp.where(counts == 0, own.first_radii, own.radii),
        lengths=jnp.where(counts == 0, own.first_lengths, within),
        rods=own.rods,
        places=own.starts + fractions * own.rest_lengths,
        fractions=fractions,
    )
