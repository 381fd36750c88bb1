"""Search for pairs of elements near each other: in a grid of cells, or over all pairs.

The edge of a cell is longer than the largest distance between the midpoints of a pair
within reach. The grid is centred at the mean of the second elements' midpoints.
Everything beyond 512 cells from there is in the outermost cells: neighbours are then
still in neighbouring cells, and only their number grows. Elements are sorted by cell,
and three cells in a row are one stretch of this order. Nine stretches hold all elements
that may be near, five if each pair of one member is searched once.

Pairs from these stretches are candidates if their midpoints are near enough for their
lengths. The exact distance is computed for candidates only. The k-th candidate of an
element is where its running count reaches k, found by bisection. Candidates are
processed in blocks, and the pairs that remain of a block are written after those of
earlier blocks. There is no sort except by cell, and no loop over empty blocks. A place
of a stretch without an element is tested, too: the number of places is known when a
kernel is written, so that it can store each row of counts where it belongs.
On CPUs, where one processor writes entries one after another, candidates of a search
over all pairs and the pairs that remain are scattered to their places, not bisected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.element_pairs import Bounds, NeighbourList, gather
from jaxrod.systems.contact.neighbour_lists import NeighbourLists
from jaxrod.systems.contact.segment_distance import nearest_places

CELLS = 1024
"""Number of cells along each axis: 2^10, so that three indices form a 30-bit key."""
BLOCK = 16_384
"""Number of candidate pairs whose exact distances are computed together."""
MOST_AT_ONCE = 1024
"""Largest number of second elements for which all pairs are tested together."""
_ROUNDING = 1e-3
"""Relative margin of the cell size, so that round-off cannot move an element into a
non-adjacent cell."""


Allowed = Callable[[Bounds, Bounds], Array | None]
"""Function from pairs of elements to a mask of those that may touch; `None` for all."""


@pytree
class FoundNeighbours:
    """Neighbour lists, node positions when they were made, and counts of entries."""

    lists: tuple[NeighbourList, ...]
    """Neighbour lists, one for each pair of members."""
    places: tuple[Vec3, ...]
    """Positions of the members' nodes at the search [m]."""
    missed: Float[Array, ""]
    """Entries needed minus entries available, the largest of pairs, candidates and cell
    slots; positive if pairs were missed [1]."""
    used: Float[Array, " lists"]
    """Number of pairs that each list needs [1]."""
    candidates: Float[Array, " lists"]
    """Number of candidates of each list: pairs whose exact distance is computed [1]."""
    in_cells: Float[Array, ""]
    """Largest number of elements in three neighbouring cells [1]."""


@pytree
class Rows:
    """Order in which second elements are tested against each first element.

    The second elements are sorted. Each first element is tested against some stretches
    of this order, each of consecutive elements. A row is the k-th element of one
    stretch, for all first elements together.
    """

    begin: Int[Array, "stretches own"]
    """Start of each stretch (consecutive elements to test) in `order`, for each first
    element."""
    held: Int[Array, "stretches own"]
    """Number of second elements in each stretch (consecutive elements to test) of
    `order`, for each first element."""
    order: Int[Array, " other"]
    """Indices of the second elements, sorted by cell if there are cells."""
    slots: int = static()
    """Number of rows per stretch: most elements tested in a stretch."""
    complete: bool = static(default=False)
    """Whether all rows are tested together: there is one stretch, which contains all
    second elements in order, at most `MOST_AT_ONCE`."""

    @property
    def count(self) -> int:
        """Number of rows to test: stretches times `slots`."""
        return self.begin.shape[0] * self.slots

    def places(self, row: Array, own: Array | slice) -> tuple[Array, Array]:
        """Positions in `order` of the second elements that a row tests, and a mask.

        They are tested against the first elements `own`. The mask is false where the
        stretch of a first element has no entry in this row.
        """
        stretch, slot = row // self.slots, row % self.slots
        place = self.begin[stretch, own] + slot
        most = self.order.shape[0] - 1
        return jnp.minimum(place, most), slot < self.held[stretch, own]


def near_each_other(own: Bounds, other: Bounds, allowed: Allowed) -> Array:
    """Mask of `allowed` pairs no further apart than the sum of their reaches.

    The distance is the shortest one between the straight axes of the elements.
    """
    way = vectors.subtract(own.elements.first, other.elements.first)
    square = nearest_places(way, own.elements.edge, other.elements.edge)[2]
    reach = own.reach + other.reach
    near, may = square <= reach * reach, allowed(own, other)
    return near if may is None else near & may


def found_by(
    how: NeighbourLists,
    every: Sequence[Bounds],
    views: Sequence[tuple[int, int]],
    allowed: Callable[[int, int, Bounds, Bounds], Array | None],
    places: tuple[Vec3, ...],
    *,
    once: bool,
) -> FoundNeighbours:
    """Finds the neighbours of all pairs of members, and lists them.

    Args:
        how: Settings of the lists, with their sizes.
        every: Elements of each member.
        views: Indices of the two members of each pair.
        allowed: Function from two members' indices and elements to the mask of elements
            that may touch.
        places: Positions of the members' nodes, to be stored with the lists [m].
        once: Whether two elements of the same member are listed as one pair, not two.
    """
    assert how.cell_slots is not None
    lists: list[NeighbourList] = []
    used, looked_at = [], []
    lacked, most = jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
    for number, (a, b) in enumerate(views):
        own, other = every[a], every[b]
        rows = all_rows(own, other)
        if how.cell_slots:
            rows, held = rows_of_cells(own, other, how.cell_slots, once=once and a == b)
            most = jnp.maximum(most, held)
        may = lambda one, two, a=a, b=b: allowed(a, b, one, two)
        many, few = _room(how.candidates, number), _room(how.pairs, number)
        some = candidates(own, other, rows, many, once=once and a == b)
        near, taken = pairs_within(own, other, some, may, few)
        count = some.count
        lists.append(near)
        looked_at.append(count)
        used.append(taken)
        lacked = jnp.maximum(lacked, jnp.maximum(count - many, taken - few))
    if how.cell_slots:
        lacked = jnp.maximum(lacked, most - how.cell_slots)
    dtype = every[0].reach.dtype
    return FoundNeighbours(
        tuple(lists),
        places,
        lacked.astype(dtype),
        jnp.stack(used).astype(dtype),
        jnp.stack(looked_at).astype(dtype),
        most.astype(dtype),
    )


def _room(given: int | tuple[int, ...] | None, number: int) -> int:
    """Entry `number` of `given`; one number in `given` holds for all lists."""
    assert given is not None
    return given[number] if isinstance(given, tuple) else given


def all_rows(own: Bounds, other: Bounds) -> Rows:
    """Rows that test all second elements against each first element."""
    count, size = other.reach.shape[0], own.reach.shape[0]
    return Rows(
        begin=jnp.zeros((1, size), jnp.int32),
        held=jnp.full((1, size), count, jnp.int32),
        order=jnp.arange(count, dtype=jnp.int32),
        slots=count,
        complete=count <= MOST_AT_ONCE,
    )


def rows_of_cells(
    own: Bounds, other: Bounds, slots: int, *, once: bool
) -> tuple[Rows, Array]:
    """Rows that test the second elements in the cells around each first element.

    Args:
        own: Elements of the first member.
        other: Elements of the second member.
        slots: Largest number of elements in three neighbouring cells.
        once: Whether each pair of elements of the same member is found only once. Then
            only the cells on one side are searched, and the column of cells that
            contains the element; this column is the first stretch.

    Returns:
        The rows, and the largest number of elements in three neighbouring cells.
    """
    edge = _cell_edge(own, other)
    centre = tuple(jnp.mean(component) for component in other.middle)
    keys = _key(*_cells(other, centre, edge))
    order = jnp.argsort(keys).astype(jnp.int32)
    ordered = keys[order]
    x, y, z = (cell[None, :] for cell in _cells(own, centre, edge))
    aside = np.array(list(np.ndindex(3, 3)), np.int32) - 1
    aside = aside[4:] if once else aside
    u, v = x + aside[:, :1], y + aside[:, 1:]
    exists = (u >= 0) & (u < CELLS) & (v >= 0) & (v < CELLS)
    low = _key(u, v, jnp.maximum(z - 1, 0))
    high = _key(u, v, jnp.minimum(z + 1, CELLS - 1))
    begin, end = _count(ordered, low - 1), _count(ordered, high)
    held = jnp.where(exists, end - begin, 0)
    most = jnp.max(held)
    return Rows(begin, held, order, slots), most


@pytree
class CandidateList:
    """Pairs near enough to compute their exact distance, stored as running counts."""

    rows: Rows
    """Second elements that were tested against each first element, in rows."""
    running: Int[Array, "rows own"]
    """Cumulative number of candidates of each first element, over the rows."""
    until: Int[Array, " own"]
    """Cumulative sum, over the first elements, of their candidates in all rows."""
    size: int = static()
    """Largest number of candidates that can be listed."""
    once: bool = static()
    """Whether both elements are of one member and each pair is listed once, the lower
    index first."""
    near: Bool[Array, "rows own"] | None = None
    """Mask of the candidates, if all rows were tested together."""

    @property
    def count(self) -> Array:
        """Number of candidates, also those beyond `size`."""
        return self.until[-1]

    def named(self, number: Array) -> NeighbourList:
        """Element indices of the candidates with the given numbers, from 0."""
        until, rows = self.until, self.rows
        column = jnp.minimum(_count(until, number), until.shape[0] - 1)
        before = jnp.where(column > 0, until[column - 1], 0)
        count = lambda row: self.running[row, column]
        row = _reached(count, number - before, rows.count)
        found = rows.order[rows.places(row, column)[0]]
        there = number < jnp.minimum(until[-1], self.size)
        if self.once:
            column, found = jnp.minimum(column, found), jnp.maximum(column, found)
        return NeighbourList(column, found, there)

    def all_of_them(self) -> NeighbourList:
        """Element indices of all candidates in order, up to `size`."""
        if self.near is None or jax.default_backend() != "cpu":
            return self.named(jnp.arange(self.size, dtype=jnp.int32))
        # One processor writes each candidate to its place faster than it bisects.
        width = self.near.shape[1]
        place = (self.until - self.running[-1])[None] + self.running - 1
        number = numbers_at(self.near.reshape(-1), place.reshape(-1), self.size)
        there = jnp.arange(self.size, dtype=jnp.int32) < self.count
        number = jnp.where(there, number, 0)
        found, column = number // width, number % width
        if self.once:
            column, found = jnp.minimum(column, found), jnp.maximum(column, found)
        return NeighbourList(column, found, there)


def numbers_at(chosen: Array, place: Array, size: int) -> Array:
    """Indices of the chosen entries of a row, written to their places in a list.

    Args:
        chosen: Mask of the entries.
        place: Place of each entry in the list; entries beyond the list are left out.
        size: Length of the list; it is zero where nothing is written.
    """
    number = jnp.arange(place.shape[0], dtype=jnp.int32)
    place = jnp.where(chosen, jnp.minimum(place, size), size)
    return jnp.zeros(size, jnp.int32).at[place].set(number, mode="drop")


def candidates(
    own: Bounds, other: Bounds, rows: Rows, size: int, *, once: bool
) -> CandidateList:
    """Finds pairs with midpoints close enough for their half lengths and reaches.

    Args:
        own: Elements of the first member.
        other: Elements of the second member.
        rows: Rows of second elements to test.
        size: Largest number of candidates that can be listed.
        once: Whether each pair of elements of the same member is listed only once. The
            first stretch contains both orders; there the lower index comes first.
    """
    x, y, z = own.middle
    reach = _half_length(own) + own.reach
    fields = (other.middle, _half_length(other) + other.reach, other.numbers)
    there = gather(fields, rows.order)

    def counted(before: Array, row: Array) -> tuple[Array, Array]:
        place, exists = rows.places(row, slice(None))
        (u, v, w), farther, fellow = gather(there, place)
        square = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2
        near = exists & (square <= (reach + farther) ** 2)
        if once:
            near = near & ((row >= rows.slots) | (own.numbers < fellow))
        after = before + near.astype(before.dtype)
        return after, after

    if rows.complete:
        # Every row has one second element, the same for all first elements.
        (u, v, w), farther, fellow = jax.tree.map(lambda leaf: leaf[:, None], there)
        here = ((x, y, z), reach, own.numbers)
        (a, b, c), reach, number = jax.tree.map(lambda leaf: leaf[None], here)
        square = (a - u) ** 2 + (b - v) ** 2 + (c - w) ** 2
        near = square <= (reach + farther) ** 2
        near = near & (number < fellow) if once else near
        running = jnp.cumsum(near.astype(jnp.int32), axis=0)
        until = jnp.cumsum(running[-1])
        return CandidateList(rows, running, until, size, once, near)
    none = jnp.zeros(x.shape, jnp.int32)
    every = jnp.arange(rows.count, dtype=jnp.int32)
    total, running = lax.scan(counted, none, every)
    return CandidateList(rows, running, jnp.cumsum(total), size, once)


def pairs_within(
    own: Bounds, other: Bounds, some: CandidateList, allowed: Allowed, size: int
) -> tuple[NeighbourList, Array]:
    """List of the candidates that are within reach and may touch, and their number.

    Args:
        own: Elements of the first member.
        other: Elements of the second member.
        some: Candidates to test.
        allowed: Function for the mask of pairs that may touch.
        size: Number of entries of the list; pairs beyond it are counted but not listed.
    """
    block = min(BLOCK, some.size)
    within = jnp.arange(block, dtype=jnp.int32)

    def more(carry: tuple[Array, Array, Array]) -> Array:
        return carry[0] < jnp.minimum(some.count, some.size)

    def worked(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        begin, taken, kept = carry
        whole = block == some.size
        listed = some.all_of_them() if whole else some.named(begin + within)
        near = listed.there & near_each_other(
            gather(own, listed.own), gather(other, listed.other), allowed
        )
        running = jnp.cumsum(near.astype(jnp.int32))
        if jax.default_backend() == "cpu":
            place = numbers_at(near, running - 1, block)
        else:
            place = jnp.minimum(_count(running, within), block - 1)
        # Both indices are in one array: XLA's CPU compiler aborts the process for two
        # updates of a batch at the same index.
        pairs = jnp.stack([listed.own, listed.other], axis=-1)[place]
        # Entries after the last near pair are overwritten by the next block. Once the
        # list is full, further pairs go into the part that is cut off at the end.
        behind = (jnp.minimum(taken, size), jnp.zeros_like(taken))
        kept = lax.dynamic_update_slice(kept, pairs, behind)
        return begin + block, taken + running[-1], kept

    none = jnp.zeros((), jnp.int32)
    room = jnp.zeros((size + block, 2), jnp.int32)
    start = none, none, room
    # A single block needs no loop.
    _, taken, kept = (
        worked(start) if block == some.size else lax.while_loop(more, worked, start)
    )
    there = jnp.arange(size, dtype=jnp.int32) < taken
    kept = jnp.where(there[:, None], kept[:size], 0)
    return NeighbourList(kept[:, 0], kept[:, 1], there), taken


def _reached(running: Callable[[Array], Array], rank: Array, size: int) -> Array:
    """First index at which a running count exceeds `rank`, by bisection.

    Args:
        running: Function from an index to the count there.
        rank: Count to exceed.
        size: Number of indices.
    """
    place, step = jnp.zeros_like(rank), 1 << (size.bit_length() - 1)
    while step:
        tried = jnp.minimum(place + step, size)
        below = running(tried - 1) <= rank
        place = jnp.where(below & (place + step <= size), tried, place)
        step //= 2
    return jnp.minimum(place, size - 1)


def _count(ordered: Array, number: Array) -> Array:
    """Number of entries of a sorted array that are at most `number`, by bisection."""
    size = ordered.shape[0]
    place, step = jnp.zeros(number.shape, jnp.int32), 1 << (size.bit_length() - 1)
    while step:
        tried = place + step
        at_most = ordered[jnp.minimum(tried, size) - 1] <= number
        place = jnp.where(at_most & (tried <= size), tried, place)
        step //= 2
    return place


def _half_length(bounds: Bounds) -> Array:
    edge = bounds.elements.edge
    return 0.5 * jnp.sqrt(vectors.dot(edge, edge))


def _cell_edge(own: Bounds, other: Bounds) -> Array:
    """Edge of a cell: largest distance of midpoints within reach, plus a margin [m]."""

    def half(bounds: Bounds) -> Array:
        return jnp.max(_half_length(bounds)) + jnp.max(bounds.reach)

    return (1 + _ROUNDING) * (half(own) + half(other))


def _cells(
    bounds: Bounds, centre: tuple[Array, ...], edge: Array
) -> tuple[Array, Array, Array]:
    """Indices along x, y and z of the cells that contain the midpoints of elements.

    The grid has its middle at `centre` [m] and cells of the edge length `edge` [m].
    Midpoints outside of it are in the outermost cells.
    """

    def along(component: Array, middle: Array) -> Array:
        cell = jnp.floor((component - middle) / edge) + CELLS // 2
        return jnp.clip(cell, 0, CELLS - 1).astype(jnp.int32)

    x, y, z = (along(c, m) for c, m in zip(bounds.middle, centre, strict=True))
    return x, y, z


def _key(x: Array, y: Array, z: Array) -> Array:
    return (x * CELLS + y) * CELLS + z
