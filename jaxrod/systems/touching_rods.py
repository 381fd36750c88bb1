"""What laws of contact between rods have in common: pairs of elements, and their sums.

A law says which touches a pair of elements has. Pairs are all of two members, or those
on lists of neighbours (`jaxrod.systems.neighbour_lists`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling, TiedPair
from jaxrod.systems.element_pairs import (
    Elements,
    Pairs,
    beside,
    elements_at,
    looked_up,
    upright,
)
from jaxrod.systems.names import check_named
from jaxrod.systems.neighbour_lists import Found, IndexList, NeighbourLists, with_spare
from jaxrod.systems.neighbour_search import Stretches, among_all, in_cells, listed
from jaxrod.systems.strands import StrandLoads, Strands, loads_on_member
from jaxrod.systems.touches import Law, PairLoads, Touch
from jaxrod.validation import Numbers, as_array, check_count, check_kind, is_traced

FEW_PAIRS = 40_000
"""Pairs of elements that are all looked at, where nothing else is said."""


@pytree
class TouchingRods(Coupling):
    """Contact between all rods of some members, whatever the law."""

    stiffness: Float[Array, ""]
    """Force per penetration: [N/m^2] per length of contact, or [N/m]."""
    onset: Float[Array, ""]
    """Width of the smooth onset over the mean of the radii [1]."""
    damping: Float[Array, ""] | None = None
    """Force per speed along the normal: [kg/(m s)] per length, or [kg/s]."""
    friction: Float[Array, ""] | None = None
    """Coefficient of Coulomb friction [1]."""
    friction_drag: Float[Array, ""] | None = None
    """Largest friction per speed of slip: [kg/(m s)] per length, or [kg/s]."""
    strands: tuple[Strands, ...] = ()
    """Points and segments of each member, once prepared."""
    lists: NeighbourLists | None = None
    """How lists of neighbours are made; `None`: all pairs are looked at."""
    found: Found | None = None
    """The lists, once made."""
    members: tuple[str, ...] = static(default=())
    """Names of the members."""
    itself: bool = static(default=False)
    """Whether rods touch themselves."""
    tied: tuple[TiedPair, ...] = static(default=())
    """Pairs of nodes that are tied together, near which nothing touches."""
    partners: int = static(default=2)
    """Rods that may touch one place at a time, for the stability bound."""

    # What a law says.

    def views(self) -> list[tuple[int, int]]:
        """Pairs of members whose elements meet, by their numbers."""
        raise NotImplementedError

    def allowed(self, a: int, b: int, own: Stretches, other: Stretches) -> Any:
        """Which pairs of elements may touch; `None`: any."""
        raise NotImplementedError

    def bounding_radii(self, a: int) -> Array:
        """Largest radius that the law gives each element of a member [m]."""
        raise NotImplementedError

    def touches(self, a: int, b: int, pairs: Pairs) -> Iterator[Touch]:
        """All touches of pairs of elements."""
        raise NotImplementedError

    def pair_loads(self, a: int, b: int, pairs: Pairs) -> PairLoads:
        """Loads of all touches of pairs of elements."""
        raise NotImplementedError

    # What follows from it.

    @property
    def law(self) -> Law:
        """Its numbers."""
        return Law(self.stiffness, self.damping, self.friction, self.friction_drag)

    @property
    def refresh_every(self) -> int | None:
        """Steps between lists; `None` without."""
        return None if self.lists is None else self.lists.refresh_every

    @property
    def is_sized(self) -> bool:
        """Whether numbers of entries are known."""
        lists = self.lists
        return lists is None or None not in (lists.slots, lists.cell_slots)

    @property
    def places_matter(self) -> bool:
        """Whether places along rods say which pairs touch."""
        return self.itself or bool(self.tied) or any(s.count > 1 for s in self.strands)

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing or is no rod."""
        for name in self.members:
            check_named(name, parts)
            if not parts[name].is_rod:
                raise ValueError(f"rods touch rods here, and {name!r} is rigid")

    def with_ties(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> TouchingRods:
        """With what is tied and so does not touch.

        Raises:
            ValueError: If there is nothing to touch.
        """
        self.check(parts)
        rods = sum(parts[name].count for name in self.members)
        if rods < 2 and not self.itself:
            raise ValueError(
                "one rod has nothing to touch but itself: give itself=True, or more "
                "members"
            )
        near = tuple(pair for pair in tied if {pair[0], pair[2]} <= set(self.members))
        lists = self.lists
        if lists is not None and lists.cell_slots is None:
            most = max(parts[n].count * parts[n].n_elements for n in self.members)
            if most * most <= FEW_PAIRS:
                lists = replace(lists, cell_slots=0)
        return replace(self, tied=near, lists=lists)

    def all_pairs(
        self, seen: AllSeen, *, moves: bool
    ) -> Iterator[tuple[int, int, Pairs]]:
        """Pairs of elements of all members that meet, from lists where there are."""
        moves = moves and (self.damping is not None or self.friction is not None)
        spins = moves and self.friction is not None
        rows = [
            elements_at(
                strand,
                seen[name],
                moves=moves,
                spins=spins,
                placed=self.places_matter,
            )
            for strand, name in zip(self.strands, self.members, strict=True)
        ]
        for number, (a, b) in enumerate(self.views()):
            own = beside(rows[a])
            if self.found is None:
                yield a, b, Pairs(own, upright(rows[b]))
                continue
            found = self.found.lists[number]
            other = looked_up(rows[b], found.index)
            yield a, b, Pairs(own, other, found.index, found.there)

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on all members."""
        total: dict[int, StrandLoads] = {}
        for a, b, pairs in self.all_pairs(seen, moves=True):
            loads = self.pair_loads(a, b, pairs)
            size = self.strands[b].radii.shape[0]
            on_a = StrandLoads.on_segments(*pairs.over_others(loads.on_own))
            on_b = StrandLoads.on_segments(*pairs.over_own(loads.on_other, size))
            total[a] = total.get(a, StrandLoads()).added(on_a)
            total[b] = total.get(b, StrandLoads()).added(on_b)
        return {
            self.members[k]: loads_on_member(
                self.strands[k], seen[self.members[k]], loads
            )
            for k, loads in total.items()
        }

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]; not a number where lists have missed some."""
        total = jnp.zeros((), self.stiffness.dtype)
        for a, b, pairs in self.all_pairs(seen, moves=False):
            for touch in self.touches(a, b, pairs):
                total = total + jnp.sum(self.law.energy(touch))
        if self.found is None:
            return total
        return jnp.where(self.found.missed > 0, jnp.nan, total)

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration over half the sum of the radii."""
        worst = jnp.zeros((), self.stiffness.dtype)
        for a, b, pairs in self.all_pairs(seen, moves=False):
            for touch in self.touches(a, b, pairs):
                half = 0.5 * (touch.own_radius + touch.other_radius)
                depth = jnp.where(touch.weight > 0, touch.depth, 0) / half
                worst = jnp.maximum(worst, jnp.max(depth))
        return worst

    # Lists.

    def search(self, seen: AllSeen) -> Found:
        """Neighbours of all elements where members are; never differentiated."""
        assert self.lists is not None
        slots, cells = self.lists.slots, self.lists.cell_slots
        assert slots is not None and cells is not None
        seen = jax.lax.stop_gradient(seen)
        every = [self._stretches(a, seen) for a in range(len(self.members))]
        dtype = self.stiffness.dtype
        zero = jnp.zeros((), dtype)
        missed, used, total, most = zero, zero, zero, zero
        lists: list[IndexList] = []
        elements = 0
        for a, b in self.views():
            may = lambda own, other, a=a, b=b: self.allowed(a, b, own, other)
            if cells:
                candidates = in_cells(every[a], every[b], may, cells)
            else:
                candidates = among_all(every[a], every[b], may)
            entries, counts = listed(candidates, slots)
            lists.append(entries)
            largest = jnp.max(counts).astype(dtype)
            used, most = (
                jnp.maximum(used, largest),
                jnp.maximum(most, candidates.in_cells),
            )
            missed = jnp.maximum(missed, largest - slots)
            if cells:
                missed = jnp.maximum(missed, candidates.in_cells - cells)
            total = total + jnp.sum(counts).astype(dtype)
            elements += counts.shape[0]
        places = tuple(seen[name].motion.position for name in self.members)
        return Found(tuple(lists), places, missed, used, total / elements, most)

    def moved(self, seen: AllSeen) -> Array:
        """Farthest that a node is from where lists were made, over half the skin."""
        assert self.found is not None
        worst = jnp.zeros((), self.stiffness.dtype)
        for name, there in zip(self.members, self.found.places, strict=True):
            position = jax.lax.stop_gradient(seen[name].motion.position)
            way = vectors.subtract(position, there)
            worst = jnp.maximum(worst, jnp.max(vectors.dot(way, way)))
        return jnp.sqrt(worst) / (0.5 * self._skin())

    def sized(self, seen: AllSeen) -> TouchingRods:
        """With as many entries as a concrete state needs, and some to spare.

        Raises:
            ValueError: If the state is traced.
        """
        lists = self.lists
        if lists is None or self.is_sized:
            return self
        if is_traced(self, seen):
            raise ValueError(
                "neighbours cannot be counted in a state that is traced: give "
                "neighbour_lists the numbers slots and cell_slots"
            )
        needed = self.needed(seen)
        if lists.slots is None:
            lists = replace(lists, slots=with_spare(float(needed.used)))
        if lists.cell_slots is None:
            cells = float(needed.in_cells)
            lists = replace(lists, cell_slots=with_spare(cells))
        return replace(self, lists=lists)

    def needed(self, seen: AllSeen) -> Found:
        """What lists of a concrete state hold that have all the entries they need."""
        assert self.lists is not None
        lists = replace(
            self.lists,
            slots=1 if self.lists.slots is None else self.lists.slots,
            cell_slots=1 if self.lists.cell_slots is None else self.lists.cell_slots,
        )
        found = _searched(replace(self, lists=lists), seen)
        assert lists.cell_slots is not None
        if float(found.in_cells) > lists.cell_slots > 0:
            lists = replace(lists, cell_slots=int(found.in_cells))
            found = _searched(replace(self, lists=lists), seen)
        return found

    def _stretches(self, a: int, seen: AllSeen) -> Stretches:
        strand, dtype = self.strands[a], self.stiffness.dtype
        placed = self.places_matter
        elements = elements_at(
            strand, seen[self.members[a]], moves=False, spins=False, placed=placed
        )
        # Forces begin half a width of the onset before surfaces touch.
        radii = (1 + 0.25 * self.onset) * self.bounding_radii(a)
        numbers = jnp.asarray(np.arange(strand.radii.shape[0]), dtype)
        return Stretches(elements, radii + 0.5 * self._skin(), numbers)

    def _skin(self) -> Array:
        """Gap of surfaces up to which elements are listed [m]."""
        assert self.lists is not None
        largest = [jnp.max(strand.radii) for strand in self.strands]
        return self.lists.skin * jnp.max(jnp.stack(largest))


def same_rod(own: Elements, other: Elements) -> Array:
    """Whether elements of one member are of one rod."""
    assert own.rods is not None and other.rods is not None
    return own.rods == other.rods


@jax.jit
def _searched(contact: TouchingRods, seen: AllSeen) -> Found:
    return contact.search(seen)


def contact_numbers(
    members: tuple[str, ...],
    stiffness: Numbers,
    damped: tuple[Numbers | None, Numbers | None, Numbers | None],
    onset: Numbers,
    partners: int,
    lists: NeighbourLists | None,
    *,
    units: tuple[str, str],
) -> dict[str, Any]:
    """Checked fields that laws have in common.

    Args:
        members: Names.
        stiffness: Force per penetration.
        damped: Damping, friction and friction drag.
        onset: Width of the onset over the mean of the radii [1].
        partners: Rods that may touch one place.
        lists: How lists are made.
        units: Of the stiffness and of damping.

    Raises:
        ValueError: If a number is out of range, or friction has no drag.
        TypeError: If a name is none.
    """
    for name in members:
        if not isinstance(name, str):
            raise TypeError(f"members are named by strings, got {name!r}")
    if not members or len(set(members)) < len(members):
        raise ValueError(f"members must be named once each, got {list(members)}")
    damping, friction, friction_drag = damped
    drag = damping if friction_drag is None else friction_drag
    if friction is not None and drag is None:
        raise ValueError(
            f"friction needs friction_drag > 0 {units[1]}, what it resists per speed "
            "at the onset of slip (by default the damping), got none"
        )
    if lists is not None:
        check_kind("lists", lists, NeighbourLists)

    def number(name: str, value: Numbers | None, unit: str) -> Array | None:
        return None if value is None else as_array(name, value, unit, positive=True)

    return {
        "stiffness": as_array("stiffness", stiffness, units[0], positive=True),
        "onset": as_array("onset", onset, "", positive=True),
        "damping": number("damping", damping, units[1]),
        "friction": number("friction", friction, ""),
        "friction_drag": (
            None if friction is None else number("friction_drag", drag, units[1])
        ),
        "members": members,
        "partners": check_count("partners", partners, 1, 1000),
        "lists": lists,
    }
