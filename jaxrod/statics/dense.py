"""Dense linear systems: for effects that couple distant parts of a rod.

This is the counterpart of `jaxrod.statics.block_tridiagonal` for a full matrix. A rod
of `n` elements has `6 n + 3` unknowns, and work grows with their cube. With tens of
elements it is about as much as the elimination along the chain, with hundreds far more.
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
    """A square matrix of `n` by `n` blocks, all of which may be nonzero."""

    entries: Float[Array, "n m n m"]
    """Entries by row block, row, column block and column."""

    def multiply(self, vector: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """The matrix times a vector."""
        return jnp.sum(self.entries * vector[None, None], axis=(2, 3))

    def solve(self, right: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """Solution for a right-hand side; not finite if the matrix is singular.

        Differentiable any number of times in both modes; reverse mode solves with
        the transposed matrix.
        """
        scale, scaled = self._scaled()
        solution = jnp.linalg.solve(scaled, jnp.ravel(scale * right))
        return scale * solution.reshape(right.shape)

    def is_positive(self) -> Bool[Array, ""]:
        """Whether the symmetric part of the matrix is positive definite.

        False if it is not finite.
        """
        _, scaled = self._scaled()
        factor = jnp.linalg.cholesky(0.5 * (scaled + scaled.T), symmetrize_input=False)
        return jnp.all(jnp.isfinite(factor))

    def stiffened(self, index: int, block: Float[Array, "m m"]) -> Dense:
        """Matrix with a block added to its diagonal."""
        return Dense(self.entries.at[index, :, index, :].add(block))

    def _scaled(self) -> tuple[Float[Array, "n m"], Float[Array, "size size"]]:
        """Scale of the unknowns, and the matrix scaled so that its diagonal is one.

        Displacements and rotations have different units, but pivots are chosen by size.
        """
        n, m = self.entries.shape[:2]
        flat = self.entries.reshape(n * m, n * m)
        diagonal = jnp.abs(jnp.diagonal(flat))
        scale = lax.stop_gradient(lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1)))
        return scale.reshape(n, m), scale[:, None] * flat * scale[None, :]


def dense(matrix: BlockTridiagonal) -> Dense:
    """Dense form of a block-tridiagonal matrix."""
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
    """Matrix of any linear function, from `n m` directions."""
    seeds = jnp.eye(like.size, dtype=like.dtype).reshape(like.size, *like.shape)
    if like.size <= _COLUMNS_AT_ONCE:
        answers = jax.vmap(function)(seeds)
    else:
        # In one batch, pairs of nodes times directions would take gigabytes.
        answers = lax.map(function, seeds, batch_size=_COLUMNS_AT_ONCE)
    return Dense(jnp.moveaxis(answers, 0, -1).reshape(*like.shape, *like.shape))
