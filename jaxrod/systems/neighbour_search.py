"""Which elements are near to each other: all pairs looked at, or a grid of cells.

The grid has cells of an edge no pair within reach is longer apart by, about the mean of
all middles; farther than 512 cells from there all is in the outermost ones, so that
neighbours are still in neighbouring cells and only their number grows. Elements are
sorted by cell, and three cells in a row are one stretch of that order: nine stretches
hold all that may be near. Their exact distances are looked at.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.element_pairs import Elements, beside, looked_up, upright
from jaxrod.systems.neighbour_lists import IndexList
from jaxrod.systems.segment_distance import nearest_places

CELLS = 1024
"""Cells along each axis: three times ten bits are one key."""
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
"""Which pairs of stretches, which broadcast, may touch at all; `None`: any."""


@pytree
class Candidates:
    """Elements that may be near, and whether they are."""

    index: Int[Array, "candidates own"]
    """Their numbers."""
    near: Bool[Array, "candidates own"]
    """Whether they are within reach."""
    in_cells: Float[Array, ""]
    """Most elements in three neighbouring cells; zero without cells [1]."""


def near_each_other(own: Stretches, other: Stretches, allowed: Allowed) -> Array:
    """Whether stretches, which broadcast, may touch and are within reach."""
    way = vectors.subtract(own.elements.first, other.elements.first)
    square = nearest_places(way, own.elements.edge, other.elements.edge)[2]
    reach = own.reach + other.reach
    near, may = square <= reach * reach, allowed(own, other)
    return near if may is None else near & may


def among_all(own: Stretches, other: Stretches, allowed: Allowed) -> Candidates:
    """All elements of the other member, for each of the one."""
    near = near_each_other(beside(own), upright(other), allowed)
    numbers = jnp.arange(near.shape[0], dtype=jnp.int32)
    index = jnp.broadcast_to(numbers[:, None], near.shape)
    return Candidates(index, near, jnp.zeros((), own.reach.dtype))


def in_cells(
    own: Stretches, other: Stretches, allowed: Allowed, slots: int
) -> Candidates:
    """Elements in the cells around, for each element of the one member.

    Args:
        own: Of the one member.
        other: Of the other.
        allowed: Which pairs may touch.
        slots: Elements that three neighbouring cells may hold.
    """
    edge = _cell_edge(own, other)
    centre = tuple(jnp.mean(component) for component in other.middle)
    keys = _key(*_cells(other, centre, edge))
    order = jnp.argsort(keys).astype(jnp.int32)
    ordered, inside = keys[order], looked_up(other, order)
    x, y, z = _cells(own, centre, edge)
    found, near, most = [], [], jnp.zeros((), jnp.int32)
    for dx, dy in np.ndindex(3, 3):
        u, v = x + (dx - 1), y + (dy - 1)
        exists = (u >= 0) & (u < CELLS) & (v >= 0) & (v < CELLS)
        low = _key(u, v, jnp.maximum(z - 1, 0))
        high = _key(u, v, jnp.minimum(z + 1, CELLS - 1))
        begin = jnp.searchsorted(ordered, low, side="left").astype(jnp.int32)
        end = jnp.searchsorted(ordered, high, side="right").astype(jnp.int32)
        held = jnp.where(exists, end - begin, 0)
        most = jnp.maximum(most, jnp.max(held))
        slot = jnp.arange(slots, dtype=jnp.int32)[:, None]
        place = jnp.minimum(begin[None, :] + slot, len(order) - 1)
        close = near_each_other(beside(own), looked_up(inside, place), allowed)
        found.append(order[place])
        near.append(close & (slot < held[None, :]))
    return Candidates(
        jnp.concatenate(found), jnp.concatenate(near), most.astype(own.reach.dtype)
    )


def listed(candidates: Candidates, slots: int) -> tuple[IndexList, Array]:
    """The candidates that are near, in a list, and how many there are of each.

    The place of the k-th of them is where their running count gets to k, found by
    halving: no scatter, and no sort.
    """
    count = jnp.cumsum(candidates.near.astype(jnp.int32), axis=0)
    size = count.shape[0]
    wanted = jnp.arange(1, slots + 1, dtype=jnp.int32)[:, None]
    place = jnp.zeros((slots, count.shape[1]), jnp.int32)
    step = 1 << (size.bit_length() - 1)
    while step:
        tried = jnp.minimum(place + step, size)
        before = jnp.take_along_axis(count, tried - 1, axis=0)
        place = jnp.where((before < wanted) & (place + step <= size), tried, place)
        step //= 2
    there = wanted <= count[-1:]
    place = jnp.minimum(place, size - 1)
    index = jnp.take_along_axis(candidates.index, place, axis=0)
    return IndexList(jnp.where(there, index, 0), there), count[-1]


def _cell_edge(own: Stretches, other: Stretches) -> Array:
    """Longest way between middles of a pair within reach, and a little [m]."""

    def half(stretches: Stretches) -> Array:
        edge = stretches.elements.edge
        longest = jnp.sqrt(jnp.max(vectors.dot(edge, edge)))
        return 0.5 * longest + jnp.max(stretches.reach)

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
