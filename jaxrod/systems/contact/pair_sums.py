"""Sums over pairs of elements of two members: over all pairs, or over a neighbour list.

All pairs form a matrix `(second elements, first elements)`, whose sums along rows and
columns need neither gather nor scatter. A list gathers elements and scatters loads, and
is faster where most pairs are far apart. Laws compute both kinds of pairs with the same
functions.

A list has unused entries, all behind those in use. It is processed block by block, and
blocks without entries in use are skipped, so the cost of a step depends on the number
of entries in use, not on the length of the list. The number of blocks is static, and
each block is a branch of `lax.cond`, so that sums can be differentiated in reverse
mode; under `jax.vmap` both branches are computed. There are few blocks, since in
reverse mode each goes through all elements.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.lanes.choice import lanes_wanted
from jaxrod.systems.contact.element_pairs import (
    Elements,
    NeighbourList,
    pack,
    scatter_add,
    unpack,
)

LEAST = 1024
"""Smallest number of list entries in a block; a shorter list is one block."""
BLOCKS = 32
"""Largest number of blocks that a list is split into."""


def sums_over_all(on_own: Any, on_other: Any) -> tuple[Any, Any]:
    """Sums pair values over all pairs, on each first and on each second element.

    Args:
        on_own: Values that pairs add to their first elements, arrays `(second elements,
            first elements)`.
        on_other: Values that pairs add to their second elements, of the same shape.
    """
    return (
        jax.tree.map(lambda field: jnp.sum(field, axis=0), on_own),
        jax.tree.map(lambda field: jnp.sum(field, axis=1), on_other),
    )


def sums_over_list(
    work: Callable[[Elements, Elements, Array], tuple[Any, Any]],
    own: Elements,
    other: Elements,
    listed: NeighbourList,
) -> tuple[Any, Any]:
    """Sums pair values over listed pairs, on each first and on each second element.

    Args:
        work: Function from first elements, second elements and the mask of entries in
            use to pair values for the first elements and for the second.
        own: All elements of the first member.
        other: All elements of the second member.
        listed: Pairs of elements to sum over.
    """
    entries = listed.there.shape[0]
    block = max(LEAST, -(-entries // BLOCKS))
    tables = pack(own), pack(other)
    sizes = own.radii.shape[0], other.radii.shape[0]

    def worked(some: NeighbourList) -> tuple[Any, Any]:
        one = unpack(tables[0][some.own], own)
        two = unpack(tables[1][some.other], other)
        return work(one, two, some.there)

    if entries <= LEAST or lanes_wanted():
        on_own, on_other = _where(listed.there, worked(listed))
        return (
            scatter_add(on_own, listed.own, sizes[0]),
            scatter_add(on_other, listed.other, sizes[1]),
        )

    def cut(number: Array) -> NeighbourList:
        # The last block begins early, so that it ends with the list. Entries that were
        # already in the block before are left out.
        due = number * block
        begin = jnp.minimum(due, entries - block)
        some: NeighbourList = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice(leaf, (begin,), (block,)), listed
        )
        fresh = begin + jnp.arange(block, dtype=begin.dtype) >= due
        return NeighbourList(some.own, some.other, some.there & fresh)

    def step(total: tuple[Array, Array], number: Array) -> tuple[Any, None]:
        def more(total: tuple[Array, Array]) -> tuple[Array, Array]:
            some = cut(number)
            on_own, on_other = worked(some)
            return (
                _with_rows(total[0], some.own, pack(on_own)),
                _with_rows(total[1], some.other, pack(on_other)),
            )

        holds = jnp.any(cut(number).there)
        return jax.lax.cond(holds, more, lambda total: total, total), None

    number = jnp.zeros((), jnp.int32)
    like = jax.eval_shape(lambda number: worked(cut(number)), number)
    none = [
        jnp.zeros((size, len(jax.tree.leaves(tree))), own.radii.dtype)
        for size, tree in zip(sizes, like, strict=True)
    ]
    numbers = jnp.arange(-(-entries // block), dtype=jnp.int32)
    on_own, on_other = jax.lax.scan(step, (none[0], none[1]), numbers)[0]
    return unpack(on_own, like[0]), unpack(on_other, like[1])


def _where(there: Array, tree: Any) -> Any:
    """Sets the values of unused list entries to zero."""
    return jax.tree.map(lambda field: jnp.where(there, field, 0), tree)


@jax.custom_jvp
def _with_rows(total: Array, index: Array, rows: Array) -> Array:
    """Adds rows to a table at given row indices: `total.at[index].add(rows)`.

    Its derivative uses a copy of the indices: XLA's CPU compiler (0.10.1, with the
    fusion that `configure_cpu` asks for) merges two such sums over the same indices
    into one kernel and aborts the process.
    """
    return total.at[index].add(rows)


@_with_rows.defjvp
def _with_rows_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    total, index, rows = primals
    change, _, changes = tangents
    again = jnp.clip(index, 0, total.shape[0] - 1)
    return _with_rows(total, index, rows), change.at[again].add(changes)
