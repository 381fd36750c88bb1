"""Which elements are near to each other: in a grid of cells, or among all.

The grid has cells of an edge no pair within reach is longer apart by, about the mean of
all middles; farther than 512 cells from there all is in the outermost ones, so that
neighbours are still in neighbouring cells and only their number grows. Elements are
sorted by cell, and three cells in a row are one stretch of that order: nine stretches
hold all that may be near, five where each pair of one member is looked for once.

Of those, pairs are candidates whose middles are near enough for their lengths, and of
the candidates the exact distance is worked out. The k-th candidate of an element is
where its running count gets to k, found by halving; candidates are worked through in
blocks, and what is left of a block is put behind what is left of those before. No
scatter, no sort but that by cells, and no more rows and blocks than there is something
in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree, static
from jaxrod.systems.element_pairs import Elements, IndexList, looked_up
from jaxrod.systems.neighbour_lists import Found, NeighbourLists
from jaxrod.systems.segment_distance import nearest_places

CELLS = 1024
"""Cells along each axis: three times ten bits are one key."""
BLOCK = 16_384
"""Candidates that are worked through at once."""
_ROUNDING = 1e-3
"""Of a cell, what its edge is longer, so that rounding puts nothing a cell farther."""


@pytree
class Stretches:
    """Straight elements to look for neighbours of."""

    elements: Elements
    """Where they are, and where on their rods."""
    reach: Float[Array, " elements"]
    """Farthest from the axis that the surface, its onset and half the skin are [m]."""
    numbers: Float[Array, " elements"]
    """Their numbers in their member."""

    @property
    def middle(self) -> Vec3:
        """Middles [m]."""
        return vectors.add(self.elements.first, vectors.scale(0.5, self.elements.edge))


Allowed = Callable[[Stretches, Stretches], Array | None]
"""Which pairs of stretches may touch at all; `None`: any."""


@pytree
class Rows:
    """Others to look at for each element, one after the other."""

    begin: Int[Array, "stretches own"]
    """Where stretches of the others begin, in their order."""
    held: Int[Array, "stretches own"]
    """How many others are in them."""
    order: Int[Array, " other"]
    """The others, in order."""
    wide: Int[Array, ""]
    """Rows of each stretch: the most that one holds, as far as there is room."""
    slots: int = static()
    """How many of a stretch there is room for."""

    @property
    def room(self) -> int:
        """Rows that there may be."""
        return self.begin.shape[0] * self.slots

    @property
    def count(self) -> Array:
        """Rows that there are."""
        return self.begin.shape[0] * self.wide

    def places(self, row: Array, own: Array | slice) -> tuple[Array, Array]:
        """Places in the order of the others of a row, and whether there are such."""
        stretch, slot = row // self.wide, row % self.wide
        place = self.begin[stretch, own] + slot
        most = self.order.shape[0] - 1
        return jnp.minimum(place, most), slot < self.held[stretch, own]


def near_each_other(own: Stretches, other: Stretches, allowed: Allowed) -> Array:
    """Whether pairs of stretches may touch and are within reach."""
    way = vectors.subtract(own.elements.first, other.elements.first)
    square = nearest_places(way, own.elements.edge, other.elements.edge)[2]
    reach = own.reach + other.reach
    near, may = square <= reach * reach, allowed(own, other)
    return near if may is None else near & may


def found_by(
    how: NeighbourLists,
    every: Sequence[Stretches],
    views: Sequence[tuple[int, int]],
    allowed: Callable[[int, int, Stretches, Stretches], Array | None],
    places: tuple[Vec3, ...],
    *,
    once: bool,
) -> Found:
    """Lists of all pairs of members.

    Args:
        how: How they are made, with numbers of entries.
        every: Elements of each member.
        views: The pairs of members.
        allowed: Which elements of two members may touch.
        places: Nodes of the members, to be kept with the lists [m].
        once: Whether two elements of one member are one pair, not two.
    """
    assert how.cell_slots is not None
    lists: list[IndexList] = []
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
        near, taken = near_ones(own, other, some, may, few)
        count = some.count
        lists.append(near)
        looked_at.append(count)
        used.append(taken)
        lacked = jnp.maximum(lacked, jnp.maximum(count - many, taken - few))
    if how.cell_slots:
        lacked = jnp.maximum(lacked, most - how.cell_slots)
    dtype = every[0].reach.dtype
    return Found(
        tuple(lists),
        places,
        lacked.astype(dtype),
        jnp.stack(used).astype(dtype),
        jnp.stack(looked_at).astype(dtype),
        most.astype(dtype),
    )


def _room(given: int | tuple[int, ...] | None, number: int) -> int:
    """Entries of a list."""
    assert given is not None
    return given[number] if isinstance(given, tuple) else given


def all_rows(own: Stretches, other: Stretches) -> Rows:
    """All others, for each element."""
    count, size = other.reach.shape[0], own.reach.shape[0]
    return Rows(
        begin=jnp.zeros((1, size), jnp.int32),
        held=jnp.full((1, size), count, jnp.int32),
        order=jnp.arange(count, dtype=jnp.int32),
        wide=jnp.asarray(count, jnp.int32),
        slots=count,
    )


def rows_of_cells(
    own: Stretches, other: Stretches, slots: int, *, once: bool
) -> tuple[Rows, Array]:
    """Others in the cells around each element, and the most in three of them.

    Args:
        own: Of the one member.
        other: Of the other.
        slots: Elements that three neighbouring cells may hold.
        once: Whether of two elements of one member only one is to find the other: then
            only the cells on one side are looked into, and an element's own column,
            which is the first stretch.
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
    begin = jnp.searchsorted(ordered, low, side="left").astype(jnp.int32)
    end = jnp.searchsorted(ordered, high, side="right").astype(jnp.int32)
    held = jnp.where(exists, end - begin, 0)
    most = jnp.max(held)
    return Rows(begin, held, order, jnp.clip(most, 1, slots), slots), most


@pytree
class Candidates:
    """Pairs whose middles are near, as running counts."""

    rows: Rows
    """Which others were looked at."""
    running: Int[Array, "rows own"]
    """Of an element, as far as a row."""
    until: Int[Array, " own"]
    """Of all elements as far as one."""
    size: int = static()
    """How many may be named."""
    once: bool = static()
    """Whether the lower of two numbers is to be the first."""

    @property
    def count(self) -> Array:
        """How many there are."""
        return self.until[-1]

    def named(self, number: Array) -> IndexList:
        """Those of some numbers."""
        until, rows = self.until, self.rows
        column = jnp.searchsorted(until, number, side="right").astype(jnp.int32)
        column = jnp.minimum(column, until.shape[0] - 1)
        before = jnp.where(column > 0, until[column - 1], 0)
        count = lambda row: self.running[row, column]
        row = _reached(count, number - before, rows.count, rows.room)
        found = rows.order[rows.places(row, column)[0]]
        there = number < jnp.minimum(until[-1], self.size)
        if self.once:
            column, found = jnp.minimum(column, found), jnp.maximum(column, found)
        return IndexList(column, found, there)


def candidates(
    own: Stretches, other: Stretches, rows: Rows, size: int, *, once: bool
) -> Candidates:
    """Pairs whose middles are near.

    Args:
        own: Of the one member.
        other: Of the other.
        rows: Which others to look at.
        size: How many may be named.
        once: Whether of two elements of one member only one has the other: in the
            first stretch, where both are, the first.
    """
    x, y, z = own.middle
    reach = _half_length(own) + own.reach
    fields = (other.middle, _half_length(other) + other.reach, other.numbers)
    there = looked_up(fields, rows.order)

    def counted(row: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        before, running = carry
        place, exists = rows.places(row, slice(None))
        (u, v, w), farther, fellow = looked_up(there, place)
        square = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2
        near = exists & (square <= (reach + farther) ** 2)
        if once:
            near = near & ((row >= rows.wide) | (own.numbers < fellow))
        after = before + near.astype(before.dtype)
        return after, lax.dynamic_update_index_in_dim(running, after, row, 0)

    none = jnp.zeros(x.shape, jnp.int32)
    running = jnp.zeros((rows.room, *x.shape), jnp.int32)
    total, running = lax.fori_loop(0, rows.count, counted, (none, running))
    return Candidates(rows, running, jnp.cumsum(total), size, once)


def near_ones(
    own: Stretches, other: Stretches, some: Candidates, allowed: Allowed, size: int
) -> tuple[IndexList, Array]:
    """Those of some candidates that are within reach, and how many there are.

    Args:
        own: Of the one member.
        other: Of the other.
        some: The candidates.
        allowed: Which pairs may touch.
        size: Entries of the list that is made.
    """
    block = min(BLOCK, some.size)
    within = jnp.arange(block, dtype=jnp.int32)

    def more(carry: tuple[Array, Array, Array]) -> Array:
        return carry[0] < jnp.minimum(some.count, some.size)

    def worked(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        begin, taken, kept = carry
        listed = some.named(begin + within)
        near = listed.there & near_each_other(
            looked_up(own, listed.own), looked_up(other, listed.other), allowed
        )
        running = jnp.cumsum(near.astype(jnp.int32))
        place = jnp.searchsorted(running, within, side="right").astype(jnp.int32)
        place = jnp.minimum(place, block - 1)
        # Both numbers as one row: XLA's CPU compiler aborts the process over two
        # updates of a batch by the same index.
        pairs = jnp.stack([listed.own, listed.other], axis=-1)[place]
        # What follows the last that is near is written over by the next block. Once the
        # list is full, all goes into what is cut off in the end.
        behind = (jnp.minimum(taken, size), jnp.zeros_like(taken))
        kept = lax.dynamic_update_slice(kept, pairs, behind)
        return begin + block, taken + running[-1], kept

    none = jnp.zeros((), jnp.int32)
    room = jnp.zeros((size + block, 2), jnp.int32)
    _, taken, kept = lax.while_loop(more, worked, (none, none, room))
    there = jnp.arange(size, dtype=jnp.int32) < taken
    kept = jnp.where(there[:, None], kept[:size], 0)
    return IndexList(kept[:, 0], kept[:, 1], there), taken


def _reached(
    running: Callable[[Array], Array], rank: Array, size: Array, room: int
) -> Array:
    """First place at which a running count is above a rank, by halving.

    Args:
        running: The count at a place.
        rank: The rank.
        size: Places that there are.
        room: The most that there may be.
    """
    place, step = jnp.zeros_like(rank), 1 << (room.bit_length() - 1)
    while step:
        tried = jnp.minimum(place + step, size)
        below = running(tried - 1) <= rank
        place = jnp.where(below & (place + step <= size), tried, place)
        step //= 2
    return jnp.minimum(place, size - 1)


def _half_length(stretches: Stretches) -> Array:
    edge = stretches.elements.edge
    return 0.5 * jnp.sqrt(vectors.dot(edge, edge))


def _cell_edge(own: Stretches, other: Stretches) -> Array:
    """Longest way between middles of a pair within reach, and a little [m]."""

    def half(stretches: Stretches) -> Array:
        return jnp.max(_half_length(stretches)) + jnp.max(stretches.reach)

    return (1 + _ROUNDING) * (half(own) + half(other))


def _cells(
    stretches: Stretches, centre: tuple[Array, ...], edge: Array
) -> tuple[Array, Array, Array]:
    """Cells of the middles along each axis."""

    def along(component: Array, middle: Array) -> Array:
        cell = jnp.floor((component - middle) / edge) + CELLS // 2
        return jnp.clip(cell, 0, CELLS - 1).astype(jnp.int32)

    x, y, z = (along(c, m) for c, m in zip(stretches.middle, centre, strict=True))
    return x, y, z


def _key(x: Array, y: Array, z: Array) -> Array:
    return (x * CELLS + y) * CELLS + z
