"""Lists of what is near: how large they are, and how often they are made anew.

A list names pairs of elements, of one member and of another, that are so near that they
may touch before the list is made anew: their surfaces are nearer than a *skin*. It
holds while no node has moved by more than half of that. Numbers of entries are
structure; what finds no entry is counted, never forgotten. A list is one row of pairs,
not so many for each element: contact is uneven, and most of those would be idle.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree, static
from jaxrod.systems.element_pairs import IndexList
from jaxrod.validation import Numbers, as_array, check_count

SPARE = 1.5
"""Entries that are made over entries that are counted in a state."""
MOST_IN_CELLS = 10_000
"""Room for more elements in three cells is taken for a mistake."""


@pytree
class NeighbourLists:
    """How lists of neighbours are made; see `neighbour_lists`."""

    skin: Float[Array, ""]
    """Gap between surfaces up to which elements are listed, over the radius [1]."""
    refresh_every: int = static(default=32)
    """Steps between lists."""
    pairs: int | tuple[int, ...] | None = static(default=None)
    """Entries of every list, or of each; `None`: counted in the state of
    `make_system`."""
    candidates: int | tuple[int, ...] | None = static(default=None)
    """Pairs that are near enough to be looked at closely, likewise."""
    cell_slots: int | None = static(default=None)
    """Elements in three neighbouring cells of the grid by which neighbours are looked
    for; 0: no grid, all pairs are looked at; `None`: counted too."""

    @property
    def is_sized(self) -> bool:
        """Whether all numbers of entries are known."""
        return None not in (self.pairs, self.candidates, self.cell_slots)


@pytree
class Found:
    """Lists of all pairs of members of a coupling, and where they were made."""

    lists: tuple[IndexList, ...]
    """For each pair of members."""
    places: tuple[Vec3, ...]
    """Nodes of the members then [m]."""
    missed: Float[Array, ""]
    """Most entries that lacked in a list, of pairs, candidates or cells [1]."""
    used: Float[Array, " lists"]
    """Entries that each list needs [1]."""
    candidates: Float[Array, " lists"]
    """Candidates of each [1]."""
    in_cells: Float[Array, ""]
    """Most elements in three neighbouring cells [1]."""


@pytree
class NeighbourRecord:
    """What lists of neighbours may have missed since a run began, the worst of it.

    Under the name "neighbours" in the state of a system that has lists. It stays until
    the entry is taken out of the state.
    """

    missed: Float[Array, ""]
    """Most entries that lacked in a list [1]."""
    moved: Float[Array, ""]
    """Farthest that a node moved from where lists were made, over half the skin [1]."""
    used: Float[Array, ""]
    """Most entries that a list needed [1]."""

    @property
    def overflow(self) -> Bool[Array, ""]:
        """Flag: contact may have been missed, since lists had too few entries."""
        return ~(self.missed <= 0)

    @property
    def stale(self) -> Bool[Array, ""]:
        """Flag: contact may have been missed, since lists were too old."""
        return ~(self.moved <= 1)


RECORD = "neighbours"
"""Name of the record in the state of a system."""


def no_record(dtype: Any) -> NeighbourRecord:
    """The record with which a run begins."""
    zero = jnp.zeros((), dtype)
    return NeighbourRecord(zero, zero, zero)


def with_spare(count: float) -> int:
    """Entries for a number that was counted, and some for what is to come."""
    return math.ceil(SPARE * count) + 16


def neighbour_lists(
    *,
    refresh_every: int = 32,
    skin: Numbers = 0.5,
    pairs: int | None = None,
    candidates: int | None = None,
    cell_slots: int | None = None,
) -> NeighbourLists:
    """Lists of neighbours for contact among many rods.

    Lists are made at the beginning of every run and every `refresh_every` steps in it.
    Results are those without lists as long as neither flag of `health` rises: overflow,
    for too few entries, and stale, if a node moved by more than half the skin before
    the lists were made anew. `jaxrod.neighbours` counts what a state needs.

    Args:
        refresh_every: Steps between lists: about `skin * radius / (2 * dt * speed)` of
            the fastest node, less some.
        skin: Gap between surfaces up to which elements are listed, over the largest
            radius [1]. A larger one makes lists longer and good for more steps.
        pairs: Pairs of elements of two members (or of one) that may touch; by default
            half as many again as there are in the state given to `make_system`.
        candidates: Pairs whose distance is worked out for that, some times as many;
            by default counted too.
        cell_slots: Elements that three neighbouring cells may hold of the grid by
            which neighbours are looked for, 0 to look at all pairs instead; by default
            counted too, and all pairs up to some hundred elements.

    Returns:
        For the argument `lists` of `rod_contact` and `crossing_contact`.

    Raises:
        ValueError: If a number is out of range.
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
