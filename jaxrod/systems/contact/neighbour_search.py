"""Search for pairs of elements near each other: in a grid of cells, or over all pairs.

The edge of a cell is longer than the largest distance between the midpoints of a pair
within reach. The grid is centred at the mean of the second elements' midpoints.
Everything beyond 512 cells from there is in the outermost cells: neighbours are then
still in neighbouring cells, and only their number grows. Elements are sorted by cell,
and three cells in a row are one stretch of this order. Nine stretches hold all elements
that may be near, five if each pair of one member is searched once.

Pairs from these stretches are candidates if their midpoints are near enough for their
lengths. Elements of a stretch are neighbours in memory, so a processor tests a vector
of them at a time. Places of a stretch without an element are tested, too, as the number
of places must be known in advance. The exact distance is computed for candidates only.
Candidates are processed in blocks, and the pairs that remain of a block are written
after those of earlier blocks. There is no sort except by cell, and no loop over empty
blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.lanes.true_entries import count_at_most, true_entries
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.element_pairs import Bounds, NeighbourList, gather
from jaxrod.systems.contact.neighbour_lists import NeighbourLists
from jaxrod.systems.contact.segment_distance import nearest_places

CELLS = 1024
"""Number of cells along each axis: 2^10, so that three indices form a 30-bit key."""
BLOCK = 16_384
"""Number of candidate pairs whose exact distances are computed together."""
TESTED = 131_072
"""Number of pairs of midpoints that are compared together."""
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
class Stretches:
    """Second elements that are tested against each first element.

    The second elements are sorted. Each first element is tested against some stretches
    of this order, each of consecutive elements.
    """

    begin: Int[Array, "stretches own"]
    """Start of each stretch in `order`, for each first element."""
    held: Int[Array, "stretches own"]
    """Number of second elements in each stretch, for each first element."""
    order: Int[Array, " other"]
    """Indices of the second elements, sorted by cell if there are cells."""
    slots: int = static()
    """Largest number of elements that are tested in a stretch."""


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
        stretches = everything(own, other)
        if how.cell_slots:
            slots, alone = how.cell_slots, once and a == b
            stretches, held = stretches_of_cells(own, other, slots, once=alone)
            most = jnp.maximum(most, held)
        may = lambda one, two, a=a, b=b: allowed(a, b, one, two)
        many, few = _room(how.candidates, number), _room(how.pairs, number)
        some = candidates(own, other, stretches, many, once=once and a == b)
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


def everything(own: Bounds, other: Bounds) -> Stretches:
    """One stretch with all second elements, for each first element."""
    count, size = other.reach.shape[0], own.reach.shape[0]
    return Stretches(
        begin=jnp.zeros((1, size), jnp.int32),
        held=jnp.full((1, size), count, jnp.int32),
        order=jnp.arange(count, dtype=jnp.int32),
        slots=count,
    )


def stretches_of_cells(
    own: Bounds, other: Bounds, slots: int, *, once: bool
) -> tuple[Stretches, Array]:
    """Stretches of the second elements in the cells around each first element.

    Args:
        own: Elements of the first member.
        other: Elements of the second member.
        slots: Largest number of elements in three neighbouring cells.
        once: Whether each pair of elements of the same member is found only once. Then
            only the cells on one side are searched, and the column of cells that
            contains the element; this column is the first stretch.

    Returns:
        The stretches, and the largest number of elements in three neighbouring cells.
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
    begin, end = count_at_most(ordered, low - 1), count_at_most(ordered, high)
    held = jnp.where(exists, end - begin, 0)
    most = jnp.max(held)
    return Stretches(begin, held, order, slots), most


@pytree
class CandidateList:
    """Pairs near enough to compute their exact distance."""

    listed: NeighbourList
    """The candidates; the list is filled up to whole blocks of `BLOCK` entries."""
    count: Int[Array, ""]
    """Number of candidates, also those that the list has no room for."""
    block: int = static()
    """Number of candidates whose exact distances are computed together."""


def candidates(
    own: Bounds, other: Bounds, stretches: Stretches, size: int, *, once: bool
) -> CandidateList:
    """Finds pairs with midpoints close enough for their half lengths and reaches.

    Args:
        own: Elements of the first member.
        other: Elements of the second member.
        stretches: Second elements to test.
        size: Largest number of candidates that can be listed.
        once: Whether each pair of elements of the same member is listed only once. The
            first stretch contains both orders; there the lower index comes first.

    Raises:
        ValueError: More pairs would be tested than indices of 32 bits can count.
    """
    n, slots = own.reach.shape[0], stretches.slots
    width = stretches.begin.shape[0] * slots
    rows = min(n, max(1, TESTED // width))
    blocks = -(-n // rows)
    if blocks * rows * width >= 2**31:
        raise ValueError(
            f"a search among {n} elements with {width} places each tests more than "
            "2^31 pairs: use smaller cell_slots, or more members"
        )
    every = ((*own.middle, _half_length(own) + own.reach), own.numbers)
    mine = jax.tree.map(lambda leaf: _in_blocks(leaf, blocks, rows), every)
    where = tuple(
        _in_blocks(leaf.T, blocks, rows) for leaf in (stretches.begin, stretches.held)
    )
    # Behind the last element there is room for a whole stretch.
    theirs = tuple(
        jnp.pad(leaf[stretches.order], (0, slots))
        for leaf in (*other.middle, _half_length(other) + other.reach, other.numbers)
    )
    slot = jnp.arange(slots, dtype=jnp.int32)[None, None]
    is_first = jnp.arange(len(stretches.begin))[None, :, None] == 0
    cut = lambda column, at: lax.dynamic_slice(column, (at,), (slots,))
    window = jax.vmap(jax.vmap(cut, in_axes=(None, 0)), in_axes=(None, 0))

    def tested(block: Any) -> Array:
        mine, (begin, held) = block
        (x, y, z, reach), number = jax.tree.map(lambda leaf: leaf[:, None, None], mine)
        u, v, w, farther, fellow = (window(column, begin) for column in theirs)
        square = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2
        near = (slot < held[:, :, None]) & (square <= (reach + farther) ** 2)
        return near & (~is_first | (number < fellow)) if once else near

    near = lax.map(tested, (mine, where)).reshape(-1)
    block = min(BLOCK, size)
    number = true_entries(near, -(-size // block) * block)
    count = jnp.sum(near, dtype=jnp.int32)
    column = lax.div(number, jnp.int32(width))
    row = number - width * column
    stretch = lax.div(row, jnp.int32(slots))
    slot = row - slots * stretch
    place = stretches.begin[stretch, column] + slot
    found = stretches.order[jnp.minimum(place, stretches.order.shape[0] - 1)]
    if once:
        column, found = jnp.minimum(column, found), jnp.maximum(column, found)
    listed = jnp.arange(number.shape[0], dtype=jnp.int32) < jnp.minimum(count, size)
    return CandidateList(NeighbourList(column, found, listed), count, block)


def _in_blocks(rows: Array, blocks: int, size: int) -> Array:
    """Rows in blocks of a size, with zeros behind the last row."""
    more = blocks * size - rows.shape[0]
    padded = jnp.pad(rows, ((0, more), *[(0, 0)] * (rows.ndim - 1)))
    return padded.reshape(blocks, size, *rows.shape[1:])


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
    block, entries = some.block, some.listed.there.shape[0]

    def more(carry: tuple[Array, Array, Array]) -> Array:
        return carry[0] < jnp.minimum(some.count, entries)

    def worked(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        begin, taken, kept = carry
        listed: NeighbourList = jax.tree.map(
            lambda leaf: lax.dynamic_slice(leaf, (begin,), (block,)), some.listed
        )
        near = listed.there & near_each_other(
            gather(own, listed.own), gather(other, listed.other), allowed
        )
        # Both indices are in one array: XLA's CPU compiler aborts the process for two
        # updates of a batch at the same index.
        pairs = jnp.stack([listed.own, listed.other], axis=-1)
        pairs = pairs[true_entries(near, block)]
        # Entries after the last near pair are overwritten by the next block. Once the
        # list is full, further pairs go into the part that is cut off at the end.
        behind = (jnp.minimum(taken, size), jnp.zeros_like(taken))
        kept = lax.dynamic_update_slice(kept, pairs, behind)
        return begin + block, taken + jnp.sum(near, dtype=jnp.int32), kept

    none = jnp.zeros((), jnp.int32)
    room = jnp.zeros((size + block, 2), jnp.int32)
    start = none, none, room
    # A single block needs no loop.
    _, taken, kept = (
        worked(start) if block == entries else lax.while_loop(more, worked, start)
    )
    there = jnp.arange(size, dtype=jnp.int32) < taken
    kept = jnp.where(there[:, None], kept[:size], 0)
    return NeighbourList(kept[:, 0], kept[:, 1], there), taken


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
