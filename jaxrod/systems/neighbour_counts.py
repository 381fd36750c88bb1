"""Counts of the neighbours in a state, for the sizes of neighbour lists."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from jaxrod.systems.contact.neighbour_lists import NeighbourLists, with_spare
from jaxrod.systems.stepping.assembly import seen_at_rest
from jaxrod.systems.system import System
from jaxrod.validation import check_kind, is_traced


@dataclass(frozen=True)
class Neighbours:
    """Counts of the neighbours of one coupling in a state, for each of its lists.

    Example:
        >>> lists = systems.neighbour_lists(pairs=100, candidates=400, cell_slots=0)
        >>> coil = systems.rod_contact(
        ...     "arm", self_contact=True, stiffness=1e5, lists=lists
        ... )
        >>> system = jaxrod.make_system({"arm": scene}, coil)
        >>> found = systems.neighbours(system, {"arm": state})[0]
        >>> found.members, found.pairs, found.occupancy < 1.0  # there is room
        ((('arm', 'arm'),), (18,), True)
    """

    members: tuple[tuple[str, str], ...]
    """Pairs of members, one for each list."""
    pairs: tuple[int, ...]
    """Number of pairs of elements in each list."""
    candidates: tuple[int, ...]
    """Number of candidate pairs of each list, whose exact distance was computed."""
    in_cells: int
    """Largest number of elements in three neighbouring cells of the search grid; 0
    without a grid."""
    occupancy: float
    """Largest ratio of needed to allocated entries, over all lists [1]; infinite if the
    lists have no sizes yet."""
    suggested: NeighbourLists
    """Settings with at least 1.5 times the entries that this state needs."""


def neighbours(system: System, state: Any) -> tuple[Neighbours, ...]:
    """Counts the entries that neighbour lists need in a state.

    Args:
        system: The system.
        state: A state of the system. To size lists, give the densest state that it
            will reach.

    Returns:
        One entry for each coupling with lists, in the order of `system.couplings`.

    Raises:
        ValueError: If a number of the system or of the state is traced.

    Example:
        >>> lists = systems.neighbour_lists(pairs=100, candidates=400, cell_slots=0)
        >>> coil = systems.rod_contact(
        ...     "arm", self_contact=True, stiffness=1e5, lists=lists
        ... )
        >>> system = jaxrod.make_system({"arm": scene}, coil)
        >>> found = systems.neighbours(system, {"arm": state})[0]
        >>> found.pairs, found.candidates, round(found.occupancy, 2)
        ((18,), (28,), 0.18)
    """
    check_kind("system", system, System)
    if is_traced(system, state):
        raise ValueError("neighbours are counted in concrete states, got a traced one")
    seen, _ = seen_at_rest(replace(system, couplings=()), state)
    parts = system.parts()
    return tuple(
        _counted(coupling.prepared(parts), seen)
        for coupling in system.couplings
        if coupling.lists is not None
    )


def _counted(coupling: Any, seen: Any) -> Neighbours:
    given: NeighbourLists = coupling.lists
    # The suggestion keeps the kind of search: over all pairs, or with a grid.
    cells = 0 if given.cell_slots == 0 else None
    bare = replace(given, pairs=None, candidates=None, cell_slots=cells)
    empty = replace(coupling, lists=bare)
    need: Any = empty.needed(seen, lambda count: max(1, int(count)))
    views = coupling.member_pairs()
    share = math.inf
    if given.is_sized:
        share = max(
            count / room
            for field in ("pairs", "candidates", "cell_slots")
            for count, room in zip(
                _each(getattr(need, field), views),
                _each(getattr(given, field), views),
                strict=True,
            )
            if room
        )
    return Neighbours(
        members=tuple((coupling.members[a], coupling.members[b]) for a, b in views),
        pairs=need.pairs,
        candidates=need.candidates,
        in_cells=need.cell_slots,
        occupancy=share,
        suggested=replace(
            need,
            pairs=tuple(map(with_spare, need.pairs)),
            candidates=tuple(map(with_spare, need.candidates)),
            cell_slots=0 if cells == 0 else with_spare(need.cell_slots),
        ),
    )


def _each(value: Any, views: list[tuple[int, int]]) -> tuple[int, ...]:
    return value if isinstance(value, tuple) else (value,) * len(views)
