"""Common part of laws of contact between rods: pairs of elements, and sums over them.

A law defines the touches of a pair of elements. Pairs are all pairs of two members, or
those on lists of neighbours (`jaxrod.systems.contact.neighbour_lists`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.element_pairs import (
    Elements,
    Pairs,
    elements_at,
    farthest_from_chord,
)
from jaxrod.systems.contact.neighbour_lists import Found, NeighbourLists, with_spare
from jaxrod.systems.contact.neighbour_search import Stretches, found_by
from jaxrod.systems.contact.pair_sums import sums_over_pairs
from jaxrod.systems.contact.smooth_axes import FARTHEST
from jaxrod.systems.contact.strands import StrandLoads, Strands, loads_on_member
from jaxrod.systems.contact.touches import Law, PairLoads, Touch
from jaxrod.systems.sites.coupling import (
    AllParts,
    AllSeen,
    Coupling,
    TiedPair,
    check_named,
)
from jaxrod.validation import is_traced

FEW_PAIRS = 40_000
"""Largest number of pairs of elements for which a search tests all by default."""


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
    """Largest friction per slip speed: [kg/(m s)] per length, or [kg/s]."""
    strands: tuple[Strands, ...] = ()
    """Points and segments of each member, once prepared."""
    lists: NeighbourLists | None = None
    """Settings of lists of neighbours; `None` to test all pairs in every step."""
    found: Found | None = None
    """The lists, once made."""
    members: tuple[str, ...] = static(default=())
    """Names of the members."""
    itself: bool = static(default=False)
    """Whether rods touch themselves."""
    tied: tuple[TiedPair, ...] = static(default=())
    """Pairs of nodes that are tied together; near them nothing touches."""
    partners: int = static(default=2)
    """Rods that may touch one place at a time, for the stability bound."""

    dotted: ClassVar[bool] = False
    """Whether the law has contact points on elements."""

    once: ClassVar[bool] = False
    """Whether the law counts two elements of one member as one pair, not two."""

    smooth: ClassVar[bool] = False
    """Whether the law has smooth axes, not polylines."""

    # Hooks of a law.

    def views(self) -> list[tuple[int, int]]:
        """Numbers of pairs of members whose elements meet."""
        raise _without(self, "views")

    def allowed(self, a: int, b: int, own: Stretches, other: Stretches) -> Any:
        """Mask of the pairs of elements that may touch; `None` for all."""
        raise _without(self, "allowed")

    def bounding_radii(self, a: int) -> Array:
        """Largest radius of each element of a member under the law [m]."""
        raise _without(self, "bounding_radii")

    def touches(self, a: int, b: int, pairs: Pairs) -> Iterator[Touch]:
        """All touches of pairs of elements."""
        raise _without(self, "touches")

    def pair_loads(self, a: int, b: int, pairs: Pairs) -> PairLoads:
        """Loads of all touches of pairs of elements."""
        raise _without(self, "pair_loads")

    # Methods that use these hooks.

    @property
    def law(self) -> Law:
        """Numbers of the law."""
        return Law(self.stiffness, self.damping, self.friction, self.friction_drag)

    @property
    def is_contact(self) -> bool:
        """True: a replay can show its forces."""
        return True

    @property
    def refresh_every(self) -> int | None:
        """Steps between searches; `None` without lists."""
        return None if self.lists is None else self.lists.refresh_every

    @property
    def is_sized(self) -> bool:
        """Whether the sizes of lists are known."""
        return self.lists is None or self.lists.is_sized

    @property
    def places_matter(self) -> bool:
        """Whether it depends on rods and places along them which pairs touch."""
        return self.itself or bool(self.tied) or any(s.count > 1 for s in self.strands)

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing or is not a rod."""
        for name in self.members:
            check_named(name, parts)
            if not parts[name].is_rod:
                raise ValueError(f"rods touch rods here, and {name!r} is rigid")

    def with_ties(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> TouchingRods:
        """The coupling with the tied nodes, near which nothing touches.

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
        """Pairs of elements of all members that meet, from lists if there are any."""
        rows = self._rows(seen, moves=moves)
        for number, (a, b) in enumerate(self.views()):
            listed = None if self.found is None else self.found.lists[number]
            yield a, b, Pairs.of(rows[a], rows[b], listed)

    def _rows(self, seen: AllSeen, *, moves: bool) -> list[Elements]:
        """Elements of all members."""
        moves = moves and (self.damping is not None or self.friction is not None)
        spins = moves and self.friction is not None
        return [
            elements_at(
                strand,
                seen[name],
                moves=moves,
                spins=spins,
                placed=self.places_matter,
                dotted=self.dotted,
                smooth=self.smooth,
            )
            for strand, name in zip(self.strands, self.members, strict=True)
        ]

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on all members."""
        total: dict[int, StrandLoads] = {}
        rows = self._rows(seen, moves=True)
        for number, (a, b) in enumerate(self.views()):
            listed = None if self.found is None else self.found.lists[number]

            def pushed(pairs: Pairs, a: int = a, b: int = b) -> tuple[Any, Any]:
                loads = self.pair_loads(a, b, pairs)
                return loads.on_own, loads.on_other

            on_own, on_other = sums_over_pairs(pushed, rows[a], rows[b], listed)
            on_a, on_b = (StrandLoads.on_segments(*on) for on in (on_own, on_other))
            total[a] = total.get(a, StrandLoads()).added(on_a)
            total[b] = total.get(b, StrandLoads()).added(on_b)
        return {
            self.members[k]: loads_on_member(
                self.strands[k], seen[self.members[k]], loads
            )
            for k, loads in total.items()
        }

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]; NaN if lists have missed some."""
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
        """Neighbours of all elements in the given state; never differentiated."""
        assert self.lists is not None
        seen = jax.lax.stop_gradient(seen)
        every = [self._stretches(a, seen) for a in range(len(self.members))]
        places = tuple(seen[name].motion.position for name in self.members)
        return found_by(
            self.lists, every, self.views(), self.allowed, places, once=self.once
        )

    def moved(self, seen: AllSeen) -> Array:
        """Largest displacement of a node since the search, over half the skin [1].

        For smooth axes it is the bound for places on the axes.
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
            ValueError: If the state is traced.
        """
        lists = self.lists
        if lists is None or self.is_sized:
            return self
        if is_traced(self, seen):
            raise ValueError(
                "neighbours cannot be counted in a state that is traced: give "
                "neighbour_lists the numbers pairs, candidates and cell_slots"
            )
        return replace(self, lists=self.needed(seen, with_spare))

    def needed(self, seen: AllSeen, spare: Callable[[float], int]) -> NeighbourLists:
        """Lists with as many entries as a concrete state needs, and some to spare.

        Args:
            seen: Members in this state.
            spare: Function from a count to the number of entries for it.
        """
        assert self.lists is not None
        lists, given = self.lists, self.lists
        # A count is right only if the stage before had enough room.
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

    def _stretches(self, a: int, seen: AllSeen) -> Stretches:
        strand, dtype = self.strands[a], self.stiffness.dtype
        placed = self.places_matter
        elements = elements_at(
            strand, seen[self.members[a]], placed=placed, smooth=self.smooth
        )
        # Forces begin half an onset width before surfaces touch.
        radii = (1 + 0.25 * self.onset) * self.bounding_radii(a)
        if elements.bulges is not None:
            radii = radii + farthest_from_chord(elements.bulges)
            elements = replace(elements, bulges=None)
        numbers = jnp.asarray(np.arange(strand.radii.shape[0]), dtype)
        return Stretches(elements, radii + 0.5 * self._skin(), numbers)

    def _skin(self) -> Array:
        """Gap between surfaces up to which elements are listed [m]."""
        assert self.lists is not None
        largest = [jnp.max(strand.radii) for strand in self.strands]
        return self.lists.skin * jnp.max(jnp.stack(largest))


def _without(law: TouchingRods, hook: str) -> NotImplementedError:
    return NotImplementedError(
        f"{type(law).__name__} has no {hook}: a law of contact between rods has views, "
        "allowed, bounding_radii, touches and pair_loads, as crossing_contact's has"
    )


def same_rod(own: Elements, other: Elements) -> Array:
    """Whether two elements of one member belong to the same rod."""
    assert own.rods is not None and other.rods is not None
    return own.rods == other.rods


@jax.jit
def _searched(contact: TouchingRods, seen: AllSeen) -> Found:
    return contact.search(seen)
