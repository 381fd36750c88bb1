"""Gather and scatter of entries of a row, a flat array, by static indices.

There are no scatter operations: each entry of a row collects the values that go to it.
So sums are the same in every run, on every device. Stretches of consecutive indices are
sliced and inserted as a whole, at a cost in proportion to their length. A few other
indices are compared one by one. More of them are compared with all entries at once,
which fuses with the surrounding program and has the same form when it is transposed.
For a very large number of indices a table is used.
"""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.systems.coupling import AllSeen
from jaxrod.systems.joints.places import Indices, Points

FEW = 8
"""Largest number of indices that are compared one by one."""
MOST_STRETCHES = 16
"""Largest number of stretches of consecutive indices that are sliced one by one."""
MOST_COMPARED = 2**22
"""Largest number of pairs of an index and an entry that are compared at once.

It is this large because in reverse mode XLA's CPU compiler (0.10.1, with the fusion
that `configure_cpu` asks for) gives up on some programs that gather entries."""


def gather(row: Array, index: Indices) -> Array:
    """Entries of a row at the given indices (gather)."""
    size = row.shape[0]
    stretches = _stretches(index)
    if stretches is not None:
        cut = [row[k : k + last - first] for k, first, last in stretches]
        return cut[0] if len(cut) == 1 else jnp.concatenate(cut)
    if len(index) <= FEW:
        return jnp.stack([row[int(k)] for k in index.values])
    if len(index) * size <= MOST_COMPARED:
        return jnp.sum(jnp.where(_same(index, size), row[None, :], 0), axis=1)
    return row[index.values]


def scatter_set(row: Array, index: Indices, values: Array) -> Array:
    """Copy of a row with `values` at the indices `index`, which must be distinct."""
    size = row.shape[0]
    if _stretches(index) is None and len(index) <= FEW:
        numbers = np.arange(size)
        for k, place in enumerate(index.values):
            row = jnp.where(numbers == place, values[k], row)
        return row
    there = np.zeros(size, bool)
    there[index.values] = True
    return jnp.where(there, scatter_add(values, index, size), row)


def scatter_add(values: Array, index: Indices, size: int) -> Array:
    """Row of `size` zeros plus `values`, each added at its `index` (scatter-add)."""
    stretches = _stretches(index)
    if stretches is not None:
        zero = jnp.zeros((), values.dtype)
        widened = [
            jax.lax.pad(values[first:last], zero, [(k, size - k - last + first, 0)])
            for k, first, last in stretches
        ]
        return functools.reduce(jnp.add, widened)
    if len(index) <= FEW:
        numbers = np.arange(size)
        total = jnp.zeros(size, values.dtype)
        for k, place in enumerate(index.values):
            total = total + jnp.where(numbers == place, values[k], 0)
        return total
    if len(index) * size <= MOST_COMPARED:
        return jnp.sum(jnp.where(_same(index, size), values[:, None], 0), axis=0)
    padded = jnp.concatenate([values, jnp.zeros_like(values[:1])])
    return functools.reduce(
        jnp.add, [padded[entries] for entries in _table(index, size)]
    )


@functools.lru_cache(maxsize=256)
def _stretches(index: Indices) -> tuple[tuple[int, int, int], ...] | None:
    """Stretches of consecutive indices: `(first index, begin, end)` each.

    Begin and end are positions in the list of indices. `None` if there are too many
    stretches, or more than half as many as indices.
    """
    cuts = np.flatnonzero(np.diff(index.values) != 1) + 1
    bounds = [0, *cuts.tolist(), len(index)]
    if len(bounds) - 1 > MOST_STRETCHES or 2 * (len(bounds) - 1) > max(len(index), 2):
        return None
    return tuple(
        (int(index.values[first]), first, last)
        for first, last in itertools.pairwise(bounds)
    )


@functools.lru_cache(maxsize=256)
def _same(index: Indices, size: int) -> np.ndarray:
    """Mask `(indices, size)`: true at (i, j) where the index number i equals j."""
    return index.values[:, None] == np.arange(size)[None, :]


@functools.lru_cache(maxsize=256)
def _table(index: Indices, size: int) -> np.ndarray:
    """Table `(most, size)`: in column j the positions of the values added to entry j.

    `most` is the largest number of values for one entry. Columns are padded with the
    number of all values, which is the position of an appended zero.
    """
    counts = np.bincount(index.values, minlength=size)
    table = np.full((max(int(np.max(counts)), 1), size), len(index), np.int32)
    filled = np.zeros(size, np.int32)
    for k, place in enumerate(index.values):
        table[filled[place], place] = k
        filled[place] += 1
    return table


def sum_of_loads(*given: tuple[Points, Loads], seen: AllSeen) -> dict[str, Loads]:
    """Loads on whole members, from loads at places.

    Args:
        *given: Pairs of places on one member, such as `Anchors.points`, and loads
            there: forces [N] and couples [N m], one entry for each place.
        seen: The members by name, as the hooks of couplings get them.

    Returns:
        Loads by member, with an entry for each of its nodes and elements.

    Example:
        >>> seen = {"arm": extend.Seen(scene.as_member().parts(), motion)}
        >>> tip = extend.anchors([("arm", "tip")], {"arm": state})
        >>> push = extend.Loads((jnp.ones(1), jnp.zeros(1), jnp.zeros(1)))
        >>> total = extend.sum_of_loads((tip.points, push), seen=seen)
        >>> total["arm"].forces[0].shape, float(total["arm"].forces[0][-1])
        ((11,), 1.0)
    """
    total: dict[str, Loads] = {}
    for points, loads in given:
        parts = seen[points.member].parts
        size = parts.n_nodes, parts.inertias.shape[1]
        forces = _spread(loads.forces, points.nodes, size[0])
        couples = _spread(loads.couples, points.elements, size[1])
        earlier = total.get(points.member, Loads())
        total[points.member] = Loads(
            _added(earlier.forces, forces), _added(earlier.couples, couples)
        )
    return total


def _spread(vector: Vec3 | None, index: Indices, size: int) -> Vec3 | None:
    if vector is None:
        return None
    x, y, z = (scatter_add(component, index, size) for component in vector)
    return x, y, z


def _added(a: Vec3 | None, b: Vec3 | None) -> Vec3 | None:
    if a is None or b is None:
        return b if a is None else a
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
