"""Block elimination along a rod, in two layouts of the same operations.

In a kernel, each column of a block is one vector, which stays in a register while the
other columns are reduced. XLA would spend more on the many small operations than on
their arithmetic, so it gets whole blocks. 21 blocks of six unknowns take 2.0
microseconds by columns and 4.6 by blocks in a kernel, and 24 by columns and 4.4 by
blocks in XLA (AMD EPYC, float64).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod.lanes.run_spec import is_in_one_kernel

Blocks = Float[Array, "n m m"]
_HIGH = 8
"""Columns are padded with zeros to a multiple of this length, which fills a vector."""


def eliminate(
    lower: Blocks, diagonal: Blocks, upper: Blocks, right: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """Solves a block-tridiagonal system, down the chain and back up.

    Args:
        lower: Blocks that couple each row to the one before.
        diagonal: Blocks on the diagonal.
        upper: Blocks that couple each row to the next.
        right: Right-hand side.

    Returns:
        The solution and the pivots.
    """
    return _eliminated(lower, diagonal, upper, right, is_in_one_kernel())


@partial(jax.jit, static_argnames="in_kernel")
def _eliminated(
    lower: Blocks,
    diagonal: Blocks,
    upper: Blocks,
    right: Float[Array, "n m"],
    in_kernel: bool,
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """Result of `eliminate`, compiled so that it is traced once for equal shapes."""
    way = _by_columns if in_kernel else _by_blocks
    return way(lower, diagonal, upper, right)


def _by_blocks(
    lower: Blocks, diagonal: Blocks, upper: Blocks, right: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    size = right.shape[-1]
    # Each row, once its diagonal block is the identity, has only these left: its upper
    # block and its right-hand side.
    beside = jnp.concatenate([upper, right[:, :, None]], axis=2)

    def down(
        above: Array, row: tuple[Array, Array, Array]
    ) -> tuple[Array, tuple[Array, Array]]:
        lower, diagonal, beside = row
        left = lower[:, 0, None] * above[None, 0]
        for j in range(1, size):
            left = left + lower[:, j, None] * above[None, j]
        right_side = beside - jnp.pad(left[:, size:], ((0, 0), (size, 0)))
        reduced, pivots = _reduce(diagonal - left[:, :size], right_side)
        return reduced, (reduced, pivots)

    def up(below: Array, row: Array) -> tuple[Array, Array]:
        solution = row[:, size]
        for j in range(size):
            solution = solution - row[:, j] * below[j]
        return solution, solution

    first = jnp.zeros_like(beside[0])
    _, (reduced, pivots) = lax.scan(down, first, (lower, diagonal, beside))
    _, solution = lax.scan(up, jnp.zeros_like(right[0]), reduced, reverse=True)
    return solution, pivots


def _reduce(diagonal: Array, beside: Array) -> tuple[Array, Array]:
    """Inverse of a block times the columns `beside` it (Gauss-Jordan), and pivots."""
    size = diagonal.shape[0]
    rows = jnp.concatenate([diagonal, beside], axis=1)
    pivots = []
    for pivot in range(size):
        pivots.append(rows[pivot, 0])
        column, rows = rows[:, 0], rows[:, 1:]
        row = rows[pivot] / column[pivot]
        is_pivot = jnp.arange(size)[:, None] == pivot
        rows = jnp.where(is_pivot, row[None], rows - column[:, None] * row[None])
    return rows, jnp.stack(pivots)


def _by_columns(
    lower: Blocks, diagonal: Blocks, upper: Blocks, right: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    size = right.shape[-1]
    more = -size % _HIGH

    def padded(blocks: Blocks) -> Float[Array, "n m high"]:
        """Columns of each block."""
        return jnp.pad(jnp.swapaxes(blocks, 1, 2), ((0, 0), (0, 0), (0, more)))

    columns = (
        *map(padded, (lower, diagonal, upper)),
        jnp.pad(right, ((0, 0), (0, more))),
    )

    def down(
        above: tuple[Array, ...], row: tuple[Array, ...]
    ) -> tuple[tuple[Array, ...], tuple[tuple[Array, ...], Array]]:
        lower, diagonal, upper, right = row

        def less(own: Array, column: Array) -> Array:
            for k in range(size):
                own = own - lower[k] * column[k]
            return own

        left = [less(diagonal[j], above[j]) for j in range(size)]
        left += [*(upper[j] for j in range(size)), less(right, above[size])]
        pivots = []
        for pivot in range(size):
            first, *left = left
            pivots.append(first[pivot])
            inverse = 1 / first[pivot]
            is_pivot = jnp.arange(size + more) == pivot
            shares = [column[pivot] * inverse for column in left]
            left = [
                jnp.where(is_pivot, share, column - first * share)
                for share, column in zip(shares, left, strict=True)
            ]
        return tuple(left), (tuple(left), jnp.stack(pivots))

    def up(below: Array, row: Sequence[Array]) -> tuple[Array, Array]:
        *upper, solution = row
        for j in range(size):
            solution = solution - upper[j] * below[j]
        return solution, solution

    none = jnp.zeros_like(columns[-1][0])
    _, (reduced, pivots) = lax.scan(down, (none,) * (size + 1), tuple(columns))
    _, solution = lax.scan(up, none, reduced, reverse=True)
    return solution[:, :size], pivots
