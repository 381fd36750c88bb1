"""Sums over pairs of elements: what pairs do, added up on the elements of both members.

A list has room for more than it holds, and what it holds comes first. It is worked
through block by block, and blocks without an entry are left out: what a step costs
goes by the entries that are taken, not by the room. Blocks are a loop of a number that
is structure, each with a branch, so that sums are differentiable in reverse; under
`jax.vmap` both branches are worked out. There are few of them, since in reverse each
goes through all elements.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.systems.element_pairs import (
    Elements,
    IndexList,
    Pairs,
    of_table,
    table_of,
)

LEAST = 1024
"""Entries of a list that are worked through at once, or more."""
BLOCKS = 32
"""Blocks of a list, at most."""

OfPairs = Callable[[Pairs], tuple[Any, Any]]
"""What pairs do: numbers for the one elements, and for the others."""


def sums_over_pairs(
    work: OfPairs, own: Elements, other: Elements, listed: IndexList | None
) -> tuple[Any, Any]:
    """Sums of what pairs do, on each of the ones and on each of the others.

    Args:
        work: What pairs do.
        own: All elements of the one member.
        other: All elements of the other.
        listed: The pairs; `None`: all.
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
        # The last block begins sooner than it should, so as to end with the list:
        # what the one before had is left out.
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
    """A table to whose rows others are added.

    Its slope looks up indices of its own: XLA's CPU compiler (0.10.1, with the fusion
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
