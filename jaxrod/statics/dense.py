"""Dense linear systems: for effects that couple distant parts of a rod.

The counterpart of `jaxrod.statics.block_tridiagonal` for a matrix without zeros to make
use of. A rod of `n` elements has `6 n + 3` unknowns, work grows with their cube: with
tens of elements about as much as the elimination along the chain, with hundreds far
more.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod.statics.block_tridiagonal import BlockTridiagonal
from jaxrod.structure import pytree

_COLUMNS_AT_ONCE = 128


@pytree
class Dense:
    """A square matrix of `n` by `n` blocks, any of which may be there."""

    entries: Float[Array, "n m n m"]
    """Row block, row, column block, column."""

    def multiply(self, vector: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """The matrix times a vector."""
        return jnp.sum(self.entries * vector[None, None], axis=(2, 3))

    def solve(self, right: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """The solution for a right side, not finite if the matrix is singular.

        Differentiable any number of times in both modes; reverse mode solves with
        the transposed matrix.
        """
        scale, scaled = self._scaled()
        solution = jnp.linalg.solve(scaled, jnp.ravel(scale * right))
        return scale * solution.reshape(right.shape)

    def is_positive(self) -> Bool[Array, ""]:
        """Whether the matrix is positive definite, but for small antisymmetric parts.

        False where it is not finite.
        """
        _, scaled = self._scaled()
        factor = jnp.linalg.cholesky(0.5 * (scaled + scaled.T), symmetrize_input=False)
        return jnp.all(jnp.isfinite(factor))

    def stiffened(self, index: int, block: Float[Array, "m m"]) -> Dense:
        """The matrix with something added to a block of its diagonal."""
        return Dense(self.entries.at[index, :, index, :].add(block))

    def _scaled(self) -> tuple[Float[Array, "n m"], Float[Array, "size size"]]:
        """The matrix in unknowns that make its diagonal one, and their unit.

        Displacements and turns have other units, pivots are chosen by size.
        """
        n, m = self.entries.shape[:2]
        flat = self.entries.reshape(n * m, n * m)
        diagonal = jnp.abs(jnp.diagonal(flat))
        scale = lax.stop_gradient(lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1)))
        return scale.reshape(n, m), scale[:, None] * flat * scale[None, :]


def dense(matrix: BlockTridiagonal) -> Dense:
    """The same matrix with its zeros."""
    n = len(matrix.diagonal)
    blocks = (matrix.lower, matrix.diagonal, matrix.upper)
    entries = sum(
        jnp.eye(n, k=shift, dtype=matrix.dtype)[:, None, :, None] * part[:, :, None, :]
        for shift, part in zip((-1, 0, 1), blocks, strict=True)
    )
    assert isinstance(entries, Array)
    return Dense(entries)


def columns(
    function: Callable[[Float[Array, "n m"]], Float[Array, "n m"]],
    like: Float[Array, "n m"],
) -> Dense:
    """The matrix of any linear function, by `n m` directions."""
    seeds = jnp.eye(like.size, dtype=like.dtype).reshape(like.size, *like.shape)
    if like.size <= _COLUMNS_AT_ONCE:
        answers = jax.vmap(function)(seeds)
    else:
        # All at once, pairs of nodes times directions would take gigabytes.
        answers = lax.map(function, seeds, batch_size=_COLUMNS_AT_ONCE)
    return Dense(jnp.moveaxis(answers, 0, -1).reshape(*like.shape, *like.shape))
