"""Sums over pairs of elements, scattered to the elements of both members.

A list has more room than entries, and its entries come first. It is processed block by
block, and blocks without entries are skipped, so a step costs as much as there are
entries, not as there is room. The number of blocks is static and each has a branch, so
that sums are differentiable in reverse; under `jax.vmap` both branches are computed.
There are few blocks, since in reverse each goes through all elements.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.systems.contact.element_pairs import (
    Elements,
    IndexList,
    Pairs,
    of_table,
    table_of,
)

LEAST = 1024
"""Smallest number of list entries processed at once; shorter lists are one block."""
BLOCKS = 32
"""Largest number of blocks of a list."""

OfPairs = Callable[[Pairs], tuple[Any, Any]]
"""Function from pairs to numbers for their first elements and for their second."""


def sums_over_pairs(
    work: OfPairs, own: Elements, other: Elements, listed: IndexList | None
) -> tuple[Any, Any]:
    """Sums over pairs, on each element of the first member and of the second.

    Args:
        work: Function that is summed over pairs.
        own: All elements of the first member.
        other: All elements of the second member.
        listed: The pairs; `None` for all.
    """
    if listed is None or listed.there.shape[0] <= LEAST:
        pairs = Pairs.of(own, other, listed)
        on_own, on_other = work(pairs)
        return (
            pairs.on_own(on_own, own.radii.shape[0]),
            pairs.on_other(on_other, other.radii.shape[0]),
        )
    return _by_blocks(work, own, other, listed)


def _by_blocks(
    work: OfPairs, own: Elements, other: Elements, listed: IndexList
) -> tuple[Any, Any]:
    entries = listed.there.shape[0]
    block = max(LEAST, -(-entries // BLOCKS))
    tables = table_of(own), table_of(other)

    def cut(number: Array) -> IndexList:
        # The last block begins early, so that it ends with the list. Entries that the
        # block before it had are left out.
        due = number * block
        begin = jnp.minimum(due, entries - block)
        some: IndexList = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice(leaf, (begin,), (block,)), listed
        )
        fresh = begin + jnp.arange(block, dtype=begin.dtype) >= due
        return IndexList(some.own, some.other, some.there & fresh)

    def worked(some: IndexList) -> tuple[Any, Any]:
        one = of_table(tables[0][some.own], own)
        two = of_table(tables[1][some.other], other)
        return work(Pairs(one, two, some))

    def step(total: tuple[Array, Array], number: Array) -> tuple[Any, None]:
        def more(total: tuple[Array, Array]) -> tuple[Array, Array]:
            some = cut(number)
            on_own, on_other = worked(some)
            return (
                _added(total[0], some.own, table_of(on_own)),
                _added(total[1], some.other, table_of(on_other)),
            )

        holds = jnp.any(cut(number).there)
        return jax.lax.cond(holds, more, lambda total: total, total), None

    number = jnp.zeros((), jnp.int32)
    like = jax.eval_shape(lambda number: worked(cut(number)), number)
    sizes = own.radii.shape[0], other.radii.shape[0]
    none = [
        jnp.zeros((size, len(jax.tree.leaves(tree))), own.radii.dtype)
        for size, tree in zip(sizes, like, strict=True)
    ]
    numbers = jnp.arange(-(-entries // block), dtype=jnp.int32)
    on_own, on_other = jax.lax.scan(step, (none[0], none[1]), numbers)[0]
    return of_table(on_own, like[0]), of_table(on_other, like[1])


@jax.custom_jvp
def _added(total: Array, index: Array, rows: Array) -> Array:
    """A table with rows added at some indices.

    Its derivative uses indices of its own: XLA's CPU compiler (0.10.1, with the fusion
    that `configure_cpu` asks for) makes one kernel of two such sums by the same indices
    and aborts the process.
    """
    return total.at[index].add(rows)


@_added.defjvp
def _added_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    total, index, rows = primals
    change, _, changes = tangents
    again = jnp.clip(index, 0, total.shape[0] - 1)
    return _added(total, index, rows), change.at[again].add(changes)
