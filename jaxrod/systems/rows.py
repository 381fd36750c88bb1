"""Entries of a row: picked out, replaced, added up, by indices that are structure.

Without scatters: each entry of a row asks which values are for it. Sums are therefore
the same in every run, on every device. A few indices are compared one by one, which
fuses with its surroundings; many go by a table.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.systems.places import Indices

FEW = 8
"""Indices that are compared one by one."""


def picked(row: Array, index: Indices) -> Array:
    """Entries of a row."""
    if len(index) <= FEW:
        return jnp.stack([row[int(k)] for k in index.values])
    return row[index.values]


def replaced(row: Array, index: Indices, values: Array) -> Array:
    """A row with other entries at some indices, each of them there once."""
    size = row.shape[0]
    if len(index) <= FEW:
        numbers = np.arange(size)
        for k, place in enumerate(index.values):
            row = jnp.where(numbers == place, values[k], row)
        return row
    table = _table(index, size)[0]
    padded = jnp.concatenate([values, jnp.zeros_like(values[:1])])
    return jnp.where(table < len(index), padded[table], row)


def summed(values: Array, index: Indices, size: int) -> Array:
    """A row of a size to which values are added at their indices."""
    if len(index) <= FEW:
        numbers = np.arange(size)
        total = jnp.zeros(size, values.dtype)
        for k, place in enumerate(index.values):
            total = total + jnp.where(numbers == place, values[k], 0)
        return total
    return gathered_sum(values, index, size)


def gathered_sum(values: Array, index: Indices, size: int) -> Array:
    """The same by a table, for many indices."""
    padded = jnp.concatenate([values, jnp.zeros_like(values[:1])])
    return functools.reduce(
        jnp.add, [padded[entries] for entries in _table(index, size)]
    )


@functools.lru_cache(maxsize=256)
def _table(index: Indices, size: int) -> np.ndarray:
    """Numbers of the values for each entry, `(most, size)`; padded by their count."""
    counts = np.bincount(index.values, minlength=size)
    table = np.full((max(int(np.max(counts)), 1), size), len(index), np.int32)
    filled = np.zeros(size, np.int32)
    for k, place in enumerate(index.values):
        table[filled[place], place] = k
        filled[place] += 1
    return table
