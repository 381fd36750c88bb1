"""Neighbour lists: their sizes, and how often they are rebuilt.

A list holds pairs of elements of two members that may touch before it is rebuilt: the
gap between their surfaces is below a *skin*. The list is valid while no node has moved
by more than half the skin. The number of entries is static; pairs that do not fit are
counted and reported by `health`. A list is one row of pairs. With a fixed number of
entries for each element most entries would be unused, since contact is uneven.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import Coupling
from jaxrod.validation import Numbers, as_array, check_count

SPARE = 1.5
"""Ratio of allocated entries to entries counted in a state [1]."""
MOST_IN_CELLS = 10_000
"""Largest `cell_slots` that is accepted; a larger number must be a mistake."""


@pytree
class NeighbourLists:
    """Settings of neighbour lists; see `neighbour_lists`.

    Example:
        >>> lists = systems.neighbour_lists(refresh_every=20)
        >>> lists.is_sized  # `make_system` counts the entries in its `state`
        False
        >>> systems.neighbour_lists(pairs=100, candidates=400, cell_slots=0).is_sized
        True
    """

    skin: Float[Array, ""]
    """Gap between surfaces up to which elements are listed, divided by the largest
    radius of the rods [1]."""
    refresh_every: int = static(default=32)
    """Number of time steps between searches."""
    pairs: int | tuple[int, ...] | None = static(default=None)
    """Largest number of pairs in a list: one number for all lists, or one for each;
    `None` to count them in the state given to `make_system`."""
    candidates: int | tuple[int, ...] | None = static(default=None)
    """Largest number of pairs near enough to compute their exact distance: one number
    for all lists, or one for each; `None` to count them in the state given to
    `make_system`."""
    cell_slots: int | None = static(default=None)
    """Largest number of elements in three neighbouring cells of the search grid; 0 for
    no grid, so that all pairs are tested; `None` to count them in the state given to
    `make_system`."""

    @property
    def is_sized(self) -> bool:
        """Whether `pairs`, `candidates` and `cell_slots` are all known."""
        return None not in (self.pairs, self.candidates, self.cell_slots)


@pytree
class NeighbourRecord:
    """Worst shortage and age of neighbour lists since a run began.

    It is stored under the name "neighbours" in the state of a system that has lists,
    and stays until it is removed from the state.

    Example:
        >>> record = systems.NeighbourRecord(
        ...     missed=jnp.array(0.0), moved=jnp.array(1.2), used=jnp.array(80.0)
        ... )
        >>> bool(record.overflow), bool(record.stale)  # long enough, but too old
        (False, True)
    """

    missed: Float[Array, ""]
    """Largest shortage of entries in a list; positive if pairs were missed [1]."""
    moved: Float[Array, ""]
    """Largest displacement of a node between two searches, divided by half the skin
    [1]."""
    used: Float[Array, ""]
    """Largest number of entries that a list needed [1]."""

    @property
    def overflow(self) -> Bool[Array, ""]:
        """Flag: contact may have been missed because lists had too few entries."""
        return ~(self.missed <= 0)

    @property
    def stale(self) -> Bool[Array, ""]:
        """Flag: contact may have been missed because lists were too old."""
        return ~(self.moved <= 1)


RECORD = "neighbours"
"""Key of the `NeighbourRecord` in the state of a system."""


def no_record(dtype: Any) -> NeighbourRecord:
    """Record at the beginning of a run: all zero."""
    zero = jnp.zeros((), dtype)
    return NeighbourRecord(zero, zero, zero)


def with_shortage(
    record: NeighbourRecord, couplings: Sequence[Coupling]
) -> NeighbourRecord:
    """Copy of the record, updated with the counts of entries in the last searches."""
    missed, used = record.missed, record.used
    for coupling in couplings:
        if coupling.refresh_every is not None:
            own: Any = coupling
            missed = jnp.maximum(missed, own.found.missed)
            used = jnp.maximum(used, jnp.max(own.found.used))
    return replace(record, missed=missed, used=used)


def with_spare(count: float) -> int:
    """Number of entries to allocate for a count: 1.5 times the count, plus 16."""
    return math.ceil(SPARE * count) + 16


def neighbour_lists(
    *,
    refresh_every: int = 32,
    skin: Numbers = 0.5,
    pairs: int | None = None,
    candidates: int | None = None,
    cell_slots: int | None = None,
) -> NeighbourLists:
    """Settings of neighbour lists, for contact among many rods.

    Lists are made at the beginning of every run and every `refresh_every` steps in it.
    Results are the same as without lists as long as `health` raises neither of two
    flags: `overflow` for too few entries, and `stale` if a node moved by more than half
    the skin before the lists were rebuilt. `jaxrod.systems.neighbours` counts the
    entries that a state needs.

    Args:
        refresh_every: Steps between searches. It should be somewhat less than `skin *
            radius / (2 * dt * speed)`, with the speed of the fastest node.
        skin: Gap between surfaces up to which elements are listed, divided by the
            largest radius [1]. A larger skin makes lists longer and valid for more
            steps.
        pairs: Largest number of pairs of elements of two members (or of one) that may
            touch; by default somewhat more than 1.5 times the number in the state given
            to `make_system`.
        candidates: Largest number of pairs whose exact distance is computed, several
            times `pairs`; also counted by default.
        cell_slots: Largest number of elements in three neighbouring cells of the search
            grid, or 0 to test all pairs instead. By default it is 0 if no member has
            more than 200 elements, and counted otherwise. A search takes time and
            memory in proportion to it.

    Returns:
        Settings for the argument `lists` of `rod_contact` and `crossing_contact`.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> lists = systems.neighbour_lists(refresh_every=20)
        >>> coil = systems.rod_contact(
        ...     "arm", self_contact=True, stiffness=1e5, lists=lists
        ... )
        >>> coil.refresh_every, coil.is_sized  # `make_system` counts in its `state`
        (20, False)
    """
    for name, value in (("pairs", pairs), ("candidates", candidates)):
        if value is not None:
            check_count(name, value, 1)
    if cell_slots is not None:
        check_count("cell_slots", cell_slots, 0, MOST_IN_CELLS)
    return NeighbourLists(
        skin=as_array("skin", skin, "", positive=True),
        refresh_every=check_count("refresh_every", refresh_every, 1),
        pairs=pairs,
        candidates=candidates,
        cell_slots=cell_slots,
    )
