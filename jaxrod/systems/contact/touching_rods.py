"""Base class of contact laws between rods: pairs of elements, and sums over them.

A law defines which pairs of points of two elements count, and with which weights. Pairs
of elements are all those of two members, or those on neighbour lists
(`jaxrod.systems.contact.neighbour_lists`).

Elements that are near each other along a rod do not touch: a rod bent to a radius of
curvature equal to its own radius just touches itself half a turn away. So contact
begins at an arc length of pi times the radius between the elements. From there a factor
on contact, the share, rises from zero to one along the length of an element. The same
holds near nodes that are tied together, with the arc length measured along both rods.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.lanes.steps import by_kernel
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.element_pairs import (
    Bounds,
    Elements,
    column_vector,
    elements_at,
    farthest_from_chord,
    gather,
    row_vector,
    sums_over_all,
    sums_over_list,
    where,
)
from jaxrod.systems.contact.neighbour_lists import NeighbourLists, with_spare
from jaxrod.systems.contact.neighbour_search import FoundNeighbours, found_by
from jaxrod.systems.contact.penalty_contact import (
    ContactPair,
    PenaltyContact,
    check_members,
    law_numbers,
)
from jaxrod.systems.contact.rod_segments import (
    RodSegments,
    SegmentLoads,
    loads_on_member,
)
from jaxrod.systems.contact.smooth_axes import FARTHEST
from jaxrod.systems.coupling import (
    AllParts,
    AllSeen,
    Parts,
    TiedPair,
    check_named,
)
from jaxrod.validation import check_count, check_kind, is_traced

FEW_PAIRS = 40_000
"""Largest number of pairs of elements for which a search tests every pair by default,
without a grid of cells."""


@pytree
class TouchingRods(PenaltyContact):
    """Base class of the contact laws between all rods of the given members."""

    segments: tuple[RodSegments, ...] = ()
    """Segments and contact points of each member, set by `prepared`."""
    lists: NeighbourLists | None = None
    """Settings of neighbour lists; `None` to test all pairs at every step."""
    found: FoundNeighbours | None = None
    """Neighbour lists of the last search; `None` before it."""
    members: tuple[str, ...] = static(default=())
    """Names of the members."""
    self_contact: bool = static(default=False)
    """Whether each rod also touches itself."""
    tied: tuple[TiedPair, ...] = static(default=())
    """Pairs of nodes that are tied together; elements near them do not touch."""
    max_contacts: int = static(default=2)
    """Number of rods that may touch a rod at one place, for the stability bound."""

    has_contact_points: ClassVar[bool] = False
    """Whether the first element of a pair is represented by its contact points."""

    symmetric: ClassVar[bool] = False
    """Whether a pair of members or elements is tested in one order only, not in
    both."""

    smooth: ClassVar[bool] = False
    """Whether axes of elements are smooth curves instead of straight segments."""

    # Hooks of a law. A member is tested with its elements, or with the contact points
    # that the last three hooks make of them.

    def allowed(self, a: int, b: int, own: Bounds, other: Bounds) -> Any:
        """Mask of the pairs of members `a` and `b` that may touch; `None` for all."""
        raise _without(self, "allowed")

    def bounding_radii(self, a: int) -> Array:
        """Largest radius of each element of member `a`, for the search [m]."""
        raise _without(self, "bounding_radii")

    def weights(self, a: int, b: int, own: Any, other: Elements) -> Array:
        """Factors on force and energy of pairs of elements of members `a`, `b`."""
        raise _without(self, "weights")

    def scales(self, own: Any, other: Elements) -> tuple[Array, Array]:
        """Radius r and length l that limit the contact of a rod with itself [m].

        Its weight rises from 0 at an arc length of pi r between the elements to 1 at pi
        r + l.
        """
        raise _without(self, "scales")

    def contact_pairs(
        self, own: Any, other: Elements, weights: Array
    ) -> Iterator[ContactPair]:
        """Pairs of points that represent each pair of elements, with their weights."""
        raise _without(self, "contact_pairs")

    def pair_loads(
        self, own: Any, other: Elements, weights: Array
    ) -> tuple[SegmentLoads, SegmentLoads]:
        """Loads on the first and the second element of each pair, times `weights`."""
        raise _without(self, "pair_loads")

    def touching(self, own: Any, other: Elements, weights: Array) -> Array:
        """Mask of the pairs that may have loads; those of all others are zero.

        By default they are those with a weight. A law that tests the distance spares
        kernels of rows the arithmetic of all other pairs.
        """
        return weights != 0

    def bound(self, own: Parts, every: list[Parts]) -> StabilityBound:
        """Bounds of stiffness and drag of `own` if `max_contacts` rods touch it.

        `every` contains the constants of all members.
        """
        raise _without(self, "bound")

    def in_rows(self, a: int, own: Elements, seen: AllSeen) -> Any:
        """Elements `own` of member `a`, or contact points that represent them.

        They are the first of each pair when all pairs are tested, without lists. By
        default they are the elements; a law may take points on member `a` from `seen`.
        """
        return own

    def on_list(
        self, a: int, own: Elements, other: Elements, there: Array
    ) -> tuple[Any, Elements, Array]:
        """First elements (or contact points) of a list, second elements, and mask.

        By default they are the arguments: elements `own` of member `a`, elements
        `other`, and the mask `there`, true for entries in use.
        """
        return own, other, there

    def collected(
        self, own: Any, on_own: SegmentLoads, on_other: SegmentLoads
    ) -> tuple[SegmentLoads, SegmentLoads]:
        """Loads on the first and second elements of a list, from `pair_loads`.

        By default they are the arguments. A law with contact points `own` adds up the
        loads `on_own` of the points of each element.
        """
        return on_own, on_other

    # Methods that use these hooks.

    @property
    def is_symmetric(self) -> bool:
        """True: between round rods in a plane all forces are in this plane."""
        return True

    @property
    def is_contact(self) -> bool:
        """Always `True`: a replay can show these forces as contact forces."""
        return True

    @property
    def refresh_every(self) -> int | None:
        """Steps between searches; `None` without lists."""
        return None if self.lists is None else self.lists.refresh_every

    @property
    def is_sized(self) -> bool:
        """Whether the numbers of list entries are known; true without lists."""
        return self.lists is None or self.lists.is_sized

    @property
    def places_matter(self) -> bool:
        """Whether contact depends on the rods and the arc lengths of elements."""
        return (
            self.self_contact
            or bool(self.tied)
            or any(s.count > 1 for s in self.segments)
        )

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing or is not a rod."""
        for name in self.members:
            check_named(name, parts)
            if not parts[name].is_rod:
                raise ValueError(f"this contact is between rods, and {name!r} is rigid")

    def with_ties(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> TouchingRods:
        """The coupling with the tied nodes set; elements near them do not touch.

        If members have few elements, the search tests all pairs, without a grid.

        Raises:
            ValueError: If there is only one rod, and no self-contact.
        """
        self.check(parts)
        rods = sum(parts[name].count for name in self.members)
        if rods < 2 and not self.self_contact:
            raise ValueError(
                "one rod has nothing to touch but itself: give self_contact=True, or "
                "more members"
            )
        near = tuple(pair for pair in tied if {pair[0], pair[2]} <= set(self.members))
        lists = self.lists
        if lists is not None and lists.cell_slots is None:
            most = max(parts[n].count * parts[n].n_elements for n in self.members)
            if most * most <= FEW_PAIRS:
                lists = replace(lists, cell_slots=0)
        return replace(self, tied=near, lists=lists)

    def member_pairs(self) -> list[tuple[int, int]]:
        """Indices (a, b) of the pairs of members that are tested for contact."""
        count = len(self.members)
        return [
            (a, b)
            for a in range(count)
            for b in range(a if self.symmetric else 0, count)
            if a != b or self.self_contact or self.segments[a].count > 1
        ]

    def regridded(self, grids: Any) -> TouchingRods:
        """Copy whose neighbour lists are sized again by `make_system`."""
        if self.lists is None or not any(map(grids.changes, self.members)):
            return self
        unsized = replace(self.lists, pairs=None, candidates=None, cell_slots=None)
        return replace(self, lists=unsized)

    @property
    def kept_apart(self) -> tuple[tuple[str, str, bool], ...]:
        """Pairs of members that are tested, and whether each rod is with itself."""
        return tuple(
            (self.members[a], self.members[b], self.self_contact and a == b)
            for a, b in self.member_pairs()
            if a <= b
        )

    def share(self, a: int, b: int, own: Any, other: Elements) -> Array | None:
        """Weight 0..1 of each pair of members `a` and `b`; `None` if all are 1.

        It is below one near tied nodes, and for elements near each other along a rod.
        """
        share: Array | None = None
        if a == b:
            near: Array | float = 0.0
            if self.self_contact:
                gap = jnp.maximum(own.starts - other.ends, other.starts - own.ends)
                near = share_of_gap(gap, *self.scales(own, other))
            share = jnp.where(same_rod(own, other), near, 1)
        for one, i, two, j in self.tied:
            if (one, two) == (self.members[a], self.members[b]):
                nodes = (
                    rod_and_place(self.segments[a], i),
                    rod_and_place(self.segments[b], j),
                )
                length = self.scales(own, other)[1]
                tied = share_near_tie(own, other, nodes, length)
                share = tied if share is None else share * tied
        return share

    def _elements(self, seen: AllSeen, *, moves: bool) -> list[Elements]:
        """Elements of all members at one moment, with velocities if `moves`."""
        moves = moves and self.law.has_rates
        listed = self.found is not None
        return [
            elements_at(
                segments,
                seen[name],
                moves=moves,
                spins=moves and self.friction is not None,
                placed=self.places_matter,
                has_contact_points=self.has_contact_points and listed,
                smooth=self.smooth,
            )
            for segments, name in zip(self.segments, self.members, strict=True)
        ]

    def _rows(
        self, elements: list[Elements], seen: AllSeen
    ) -> Iterator[tuple[int, list[int], Any, Elements, Array]]:
        """All pairs of elements, as matrices `(second, first)` for each first member.

        The second members are joined in one column, so that the program has one part
        for each member, not for each pair of members.

        Returns:
            Index of the first member, indices of the second members, elements or
            contact points of the first, elements of the second, and weights.
        """
        met: dict[int, list[int]] = {}
        for a, b in self.member_pairs():
            met.setdefault(a, []).append(b)
        for a, others in met.items():
            own = row_vector(self.in_rows(a, elements[a], seen))
            weights = []
            for b in others:
                each = self.weights(a, b, own, column_vector(elements[b]))
                shape = elements[b].radii.shape[0], own.radii.shape[1]
                each = jnp.broadcast_to(each, shape)
                if self.symmetric and a == b:
                    each = jnp.where(np.triu(np.ones(shape, bool), 1), each, 0)
                weights.append(each)
            row = jax.tree.map(
                lambda *fields: jnp.concatenate(fields), *[elements[b] for b in others]
            )
            yield a, others, own, column_vector(row), jnp.concatenate(weights)

    def _listed(
        self, a: int, b: int, own: Elements, other: Elements, there: Array
    ) -> tuple[Any, Elements, Array]:
        """First elements (or contact points) of a list, second elements, and weights.

        Weights are zero where `there`, the mask of entries in use, is false.
        """
        met, other, there = self.on_list(a, own, other, there)
        return met, other, jnp.where(there, self.weights(a, b, met, other), 0)

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on all members."""
        total: dict[int, SegmentLoads] = {}

        def add(k: int, loads: SegmentLoads) -> None:
            total[k] = total.get(k, SegmentLoads()).added(loads)

        elements = self._elements(seen, moves=True)
        if self.found is None:
            for a, others, *pairs in self._rows(elements, seen):
                touch = self.touching(*pairs)
                loads = where(touch, self.pair_loads(*pairs))
                on_own, on_others = sums_over_all(*loads)
                add(a, on_own)
                start = 0
                for b in others:
                    here = slice(start, start + elements[b].radii.shape[0])
                    add(b, jax.tree.map(operator.itemgetter(here), on_others))
                    start = here.stop
        else:
            for (a, b), listed in zip(
                self.member_pairs(), self.found.lists, strict=True
            ):

                def work(
                    own: Elements, other: Elements, there: Array, a: int = a, b: int = b
                ) -> tuple[Array, tuple[SegmentLoads, SegmentLoads]]:
                    pairs = self._listed(a, b, own, other, there)
                    touch = self.touching(*pairs)
                    loads = where(touch, self.pair_loads(*pairs))
                    # Over the contact points of elements, if there are any.
                    some = jnp.any(touch.reshape(-1, there.shape[0]), axis=0)
                    return some, self.collected(pairs[0], *loads)

                on_own, on_other = sums_over_list(
                    work, elements[a], elements[b], listed
                )
                add(a, on_own)
                add(b, on_other)
        return {
            self.members[k]: loads_on_member(
                self.segments[k], seen[self.members[k]], loads
            )
            for k, loads in total.items()
        }

    def _all_contact_pairs(self, seen: AllSeen) -> Iterator[ContactPair]:
        """Pairs of points of all tested members, from lists if there are any."""
        elements = self._elements(seen, moves=False)
        if self.found is None:
            for _, _, *pairs in self._rows(elements, seen):
                yield from self.contact_pairs(*pairs)
            return
        for (a, b), listed in zip(self.member_pairs(), self.found.lists, strict=True):
            own = gather(elements[a], listed.own)
            other = gather(elements[b], listed.other)
            yield from self.contact_pairs(*self._listed(a, b, own, other, listed.there))

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]; NaN if lists were too short."""
        total = jnp.zeros((), self.stiffness.dtype)
        for pair in self._all_contact_pairs(seen):
            density = self.law.energy(pair.depth, pair.width)
            total = total + jnp.sum(pair.weight * density)
        if self.found is None:
            return total
        return jnp.where(self.found.missed > 0, jnp.nan, total)

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration divided by half the sum of the radii [1]."""
        worst = jnp.zeros((), self.stiffness.dtype)
        for pair in self._all_contact_pairs(seen):
            half = 0.5 * (pair.radii[0] + pair.radii[1])
            depth = jnp.where(pair.weight > 0, pair.depth, 0) / half
            worst = jnp.maximum(worst, jnp.max(depth))
        return worst

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Bounds of stiffness and drag, with `max_contacts` rods at every element."""
        every = [parts[name] for name in self.members]
        return {name: self.bound(parts[name], every) for name in self.members}

    # Lists.

    def search(self, seen: AllSeen) -> FoundNeighbours:
        """Neighbour lists of all pairs of members in a state; never differentiated."""
        assert self.lists is not None
        seen = jax.lax.stop_gradient(seen)
        every = [self._bounds(a, seen) for a in range(len(self.members))]
        places = tuple(seen[name].motion.position for name in self.members)
        return found_by(
            self.lists,
            every,
            self.member_pairs(),
            self.allowed,
            places,
            once=self.symmetric,
        )

    def moved(self, seen: AllSeen) -> Array:
        """Largest displacement of a node since the search divided by half the skin [1].

        For smooth axes it is an upper bound of the displacement of their points.
        """
        assert self.found is not None
        worst = jnp.zeros((), self.stiffness.dtype)
        for name, there in zip(self.members, self.found.places, strict=True):
            position = jax.lax.stop_gradient(seen[name].motion.position)
            way = vectors.subtract(position, there)
            worst = jnp.maximum(worst, jnp.max(vectors.dot(way, way)))
        farthest = FARTHEST if self.smooth else 1.0
        return farthest * jnp.sqrt(worst) / (0.5 * self._skin())

    def sized(self, seen: AllSeen) -> TouchingRods:
        """The coupling with lists sized for a concrete state, with spare entries.

        Raises:
            ValueError: If the state is traced, or numbers of the members or contact.
        """
        lists = self.lists
        if lists is None or self.is_sized:
            return self
        places = {
            "the contact": self,
            "the members": [own.parts for own in seen.values()],
            "the state": [own.motion for own in seen.values()],
        }
        traced = [words for words, tree in places.items() if is_traced(tree)]
        if traced:
            raise ValueError(
                "neighbours cannot be counted, because numbers of "
                f"{' and '.join(traced)} are traced: give neighbour_lists the numbers "
                "pairs, candidates and cell_slots, or make the system outside jit, "
                "grad and vmap"
            )
        return replace(self, lists=self.needed(seen, with_spare))

    def needed(self, seen: AllSeen, spare: Callable[[float], int]) -> NeighbourLists:
        """Settings of lists with as many entries as a state needs, and some to spare.

        Args:
            seen: Members in this state, which must not be traced.
            spare: Function from a count to the number of entries to allocate for it.
        """
        assert self.lists is not None
        lists, given = self.lists, self.lists
        # A count is correct only if the stage before had enough entries.
        for _ in range(3):
            trial = replace(
                lists,
                pairs=1 if lists.pairs is None else lists.pairs,
                candidates=1 if lists.candidates is None else lists.candidates,
                cell_slots=1 if lists.cell_slots is None else lists.cell_slots,
            )
            found = _searched(replace(self, lists=trial), seen)
            if lists.cell_slots is None:
                lists = replace(lists, cell_slots=spare(float(found.in_cells)))
            elif lists.candidates is None:
                counts = tuple(spare(float(count)) for count in found.candidates)
                lists = replace(lists, candidates=counts)
            elif lists.pairs is None:
                counts = tuple(spare(float(count)) for count in found.used)
                lists = replace(lists, pairs=counts)
            if given.is_sized or lists.is_sized:
                break
        return lists

    def _bounds(self, a: int, seen: AllSeen) -> Bounds:
        segments, dtype = self.segments[a], self.stiffness.dtype
        placed = self.places_matter
        elements = elements_at(
            segments, seen[self.members[a]], placed=placed, smooth=self.smooth
        )
        # Forces begin half an onset width before surfaces touch.
        radii = (1 + 0.25 * self.onset) * self.bounding_radii(a)
        if elements.bulges is not None:
            radii = radii + farthest_from_chord(elements.bulges)
            elements = replace(elements, bulges=None)
        numbers = jnp.asarray(np.arange(segments.radii.shape[0]), dtype)
        return Bounds(elements, radii + 0.5 * self._skin(), numbers)

    def _skin(self) -> Array:
        """Gap between surfaces up to which elements are listed [m]."""
        assert self.lists is not None
        largest = [jnp.max(segments.radii) for segments in self.segments]
        return self.lists.skin * jnp.max(jnp.stack(largest))


def _without(law: TouchingRods, hook: str) -> NotImplementedError:
    return NotImplementedError(
        f"{type(law).__name__} has no {hook}: a law of contact between rods has "
        "allowed, bounding_radii, weights, scales, contact_pairs, "
        "pair_loads and bound, as crossing_contact's has"
    )


def rod_law(
    members: tuple[str, ...],
    *numbers: Any,
    self_contact: bool,
    max_contacts: int,
    lists: NeighbourLists | None,
    per_length: bool,
) -> dict[str, Any]:
    """Validated fields that all contact laws between rods have in common.

    Args:
        members: Names of the members.
        *numbers: Parameters of the law in the order of `law_numbers`.
        self_contact: Whether each rod also touches itself.
        max_contacts: Number of rods that may touch a rod at one place and time.
        lists: Settings of neighbour lists; `None` for no lists.
        per_length: Whether the law is per unit length of contact.

    Raises:
        ValueError: If a number is out of range, or friction is given without drag.
        TypeError: If a name is not a string.
    """
    check_members(members)
    if lists is not None:
        check_kind("lists", lists, NeighbourLists)
    return {
        **law_numbers(*numbers, per_length=per_length),
        "members": members,
        "self_contact": bool(self_contact),
        "max_contacts": check_count("max_contacts", max_contacts, 1, 1000),
        "lists": lists,
    }


class Along(Protocol):
    """Interface of elements and contact points, as intervals of arc length on rods."""

    @property
    def radii(self) -> Array:
        """Radius of the rod at each element or point [m]."""

    @property
    def rods(self) -> Any:
        """Index of the rod that each element or point belongs to."""

    @property
    def starts(self) -> Any:
        """Rest arc length along its rod at which each element or point starts [m]."""

    @property
    def ends(self) -> Any:
        """Rest arc length along its rod at which each element or point ends [m]."""


def same_rod(own: Along, other: Along) -> Array:
    """Whether two elements (or points) of one member belong to the same rod."""
    return jnp.equal(own.rods, other.rods)


def share_of_gap(gap: Array, radius: Array, length: Array) -> Array:
    """Weight of contact along a rod: (gap - pi radius) / length, limited to 0..1 [1].

    Args:
        gap: Rest arc length between the elements; negative where they overlap [m].
        radius: Radius of the rod [m].
        length: Length over which the weight rises [m].
    """
    return jnp.clip((gap - math.pi * radius) / length, 0, 1)


def rod_and_place(segments: RodSegments, node: int) -> tuple[int, Array]:
    """Index of the rod of a node, and the node's rest arc length along it [m]."""
    return node // (segments.n_elements + 1), segments.node_places[node]


def from_node(where: Along, place: Array) -> Array:
    """Rest arc length along a rod from a node at `place` to elements; 0 inside [m]."""
    return jnp.maximum(jnp.maximum(where.starts - place, place - where.ends), 0)


def share_near_tie(
    own: Along,
    other: Along,
    nodes: tuple[tuple[int, Array], tuple[int, Array]],
    length: Array,
) -> Array:
    """Weight of contact near two tied nodes, from 0 to 1 [1].

    It depends on the sum of both arc lengths to the tie: zero up to pi times the mean
    radius, then rising linearly over `length`. It is one on other rods.

    Args:
        own: Elements or contact points of the first member.
        other: Elements of the second member.
        nodes: Index of the rod, and rest arc length along it, of each tied node [m].
        length: Length over which the weight rises [m].
    """
    (rod, place), (fellow, mark) = nodes
    reach = 0.5 * math.pi * (own.radii + other.radii)
    along = from_node(own, place) + from_node(other, mark)
    share = jnp.clip((along - reach) / length, 0, 1)
    concerned = jnp.equal(own.rods, rod) & jnp.equal(other.rods, fellow)
    return jnp.where(concerned, share, 1)


@jax.jit
def _searched(contact: TouchingRods, seen: AllSeen) -> FoundNeighbours:
    # A kernel, because XLA takes seconds to compile a search.
    found: FoundNeighbours = by_kernel(contact, "search", seen)
    return found
