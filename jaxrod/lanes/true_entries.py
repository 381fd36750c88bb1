"""Indices of the true entries of a mask, as an operation with a kernel of its own.

A processor lists them in one pass, as fast as it reads the mask. XLA has no such
operation. It counts the entries up to each index, and writes the index to this place.
For a long mask and a shorter list it does so for words of 32 entries, and then looks
within the word for each entry of the list.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxrod.jax_internals.mesh_axes import varying_aval
from jaxrod.jax_internals.primitives import (
    define,
    new_primitive,
    no_tangent,
    unknown_rules,
)

WORD = 32
"""Number of entries whose true ones are counted together."""


@dataclass(frozen=True)
class Listing:
    """Length of a list, and how lanes compute it."""

    size: int

    def program(self, mask: Array) -> Array:
        """The list, by operations that lanes have."""
        return _by_sums(mask, self.size)


def true_entries(mask: Bool[Array, " entries"], size: int) -> Int[Array, " size"]:
    """Indices of the true entries of a mask, in ascending order.

    Args:
        mask: The mask.
        size: Length of the list. Entries beyond it are left out, and unused entries of
            the list are zero.
    """
    if unknown_rules() is not None:
        return _by_xla(mask, size)
    (found,) = _primitive().bind(mask, listing=Listing(size))
    return found


def count_at_most(ordered: Array, number: Array) -> Array:
    """Number of entries of a sorted array that are at most `number`, by bisection."""
    size = ordered.shape[0]
    place, step = jnp.zeros(number.shape, jnp.int32), 1 << (size.bit_length() - 1)
    while step:
        tried = place + step
        at_most = ordered[jnp.minimum(tried, size) - 1] <= number
        place = jnp.where(at_most & (tried <= size), tried, place)
        step //= 2
    return place


def _by_xla(mask: Array, size: int) -> Array:
    if mask.shape[0] <= 2 * size:
        return _by_sums(mask, size)
    return _by_words(mask, size)


def _by_sums(mask: Array, size: int) -> Array:
    place = jnp.cumsum(mask.astype(jnp.int32)) - 1
    number = jnp.arange(mask.shape[0], dtype=jnp.int32)
    place = jnp.where(mask, jnp.minimum(place, size), size)
    return jnp.zeros(size, jnp.int32).at[place].set(number, mode="drop")


def _by_words(mask: Array, size: int) -> Array:
    # With the barrier XLA takes half as long for the search.
    mask = lax.optimization_barrier(mask)
    rows = jnp.pad(mask, (0, -mask.shape[0] % WORD)).reshape(-1, WORD)
    bits = jnp.uint32(1) << jnp.arange(WORD, dtype=jnp.uint32)
    words = jnp.sum(jnp.where(rows, bits, jnp.uint32(0)), axis=1, dtype=jnp.uint32)
    held = lax.population_count(words).astype(jnp.int32)
    until = jnp.cumsum(held)
    begin = until - held
    number = jnp.arange(words.shape[0], dtype=jnp.int32)
    place = jnp.where(held > 0, jnp.minimum(begin, size), size)
    first = jnp.zeros(size, jnp.int32).at[place].set(number, mode="drop")
    which = lax.cummax(first)
    rank = jnp.arange(size, dtype=jnp.int32)
    found = WORD * which + _bit(words[which], rank - begin[which])
    return jnp.where(rank < until[-1], found, 0)


def _bit(words: Array, rank: Array) -> Array:
    """Index of the set bit of each word that has `rank` set bits below it."""
    place, step = jnp.zeros_like(rank), WORD // 2
    while step:
        part = (words >> place.astype(jnp.uint32)) & jnp.uint32((1 << step) - 1)
        below = lax.population_count(part).astype(jnp.int32)
        after = below <= rank
        place = jnp.where(after, place + step, place)
        rank = jnp.where(after, rank - below, rank)
        step //= 2
    return place


@cache
def _primitive() -> Any:
    """JAX primitive of `true_entries`, defined at the first call."""
    primitive = new_primitive("jaxrod_true_entries")
    define(
        primitive,
        _meaning,
        static="listing",
        shapes=lambda mask, listing: [varying_aval((listing.size,), jnp.int32, [mask])],
        batched=_batched,
        jvp=_jvp,
    )
    return primitive


def _meaning(mask: Array, *, listing: Listing) -> list[Array]:
    return [_by_xla(mask, listing.size)]


def _batched(arrays: Sequence[Any], axes: Sequence[Any], *, listing: Listing) -> Any:
    (mask,), (axis,) = arrays, axes
    made = jax.vmap(lambda one: _by_xla(one, listing.size), axis)(mask)
    return [made], [0]


def _jvp(primals: Any, tangents: Any, *, listing: Listing) -> Any:
    del tangents
    made = _primitive().bind(*primals, listing=listing)
    return made, [no_tangent(array) for array in made]
