"""Lists of what is near: how large they are, and how often they are made anew.

A list names, for every element of one member, the elements of another that come so near
that they may touch before the list is made anew: their surfaces are nearer than a
*skin*. It holds while no node has moved by more than half of that. Numbers of entries
are structure; what finds no entry is counted, never forgotten.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_count

SPARE = 1.5
"""Entries that are made over entries that are counted in a state."""
MOST_SLOTS = 10_000
"""More entries for each element are taken for a mistake."""


@pytree
class NeighbourLists:
    """How lists of neighbours are made; see `neighbour_lists`."""

    skin: Float[Array, ""]
    """Gap between surfaces up to which elements are listed, over the radius [1]."""
    refresh_every: int = static(default=32)
    """Steps between lists."""
    slots: int | None = static(default=None)
    """Entries for each element; `None`: counted in the state of `make_system`."""
    cell_slots: int | None = static(default=None)
    """Elements in three neighbouring cells of the grid by which neighbours are looked
    for; 0: no grid, all pairs are looked at; `None`: counted too."""


@pytree
class IndexList:
    """Neighbours of the elements of one member among those of another."""

    index: Int[Array, "slots own"]
    """Their numbers."""
    there: Bool[Array, "slots own"]
    """Which entries are taken."""


@pytree
class Found:
    """Lists of all pairs of members of a coupling, and where they were made."""

    lists: tuple[IndexList, ...]
    """For each pair of members."""
    places: tuple[Vec3, ...]
    """Nodes of the members then [m]."""
    missed: Float[Array, ""]
    """Most neighbours of an element, or of a row of cells, that found no entry [1]."""
    used: Float[Array, ""]
    """Most entries that an element needs [1]."""
    mean_used: Float[Array, ""]
    """Entries that elements need on average [1]."""
    in_cells: Float[Array, ""]
    """Most elements in three neighbouring cells [1]."""


@pytree
class NeighbourRecord:
    """What lists of neighbours may have missed since a run began, the worst of it.

    Under the name "neighbours" in the state of a system that has lists. It stays until
    the entry is taken out of the state.
    """

    missed: Float[Array, ""]
    """Most neighbours of an element that found no entry [1]."""
    moved: Float[Array, ""]
    """Farthest that a node moved from where lists were made, over half the skin [1]."""
    used: Float[Array, ""]
    """Most entries that an element needed [1]."""

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
    return math.ceil(SPARE * count) + 4


def neighbour_lists(
    *,
    refresh_every: int = 32,
    skin: Numbers = 0.5,
    slots: int | None = None,
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
        slots: Entries for each element; by default half as many again as the state
            given to `make_system` needs.
        cell_slots: Elements that three neighbouring cells may hold of the grid by
            which neighbours are looked for, 0 to look at all pairs instead; by default
            counted too, and all pairs up to some hundred elements.

    Returns:
        For the argument `lists` of `rod_contact` and `crossing_contact`.

    Raises:
        ValueError: If a number is out of range.
    """
    if slots is not None:
        check_count("slots", slots, 1, MOST_SLOTS)
    if cell_slots is not None:
        check_count("cell_slots", cell_slots, 0, MOST_SLOTS)
    return NeighbourLists(
        skin=as_array("skin", skin, "", positive=True),
        refresh_every=check_count("refresh_every", refresh_every, 1),
        slots=slots,
        cell_slots=cell_slots,
    )
