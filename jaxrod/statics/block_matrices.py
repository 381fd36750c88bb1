r"""Linear systems of blocks along a rod: block-tridiagonal and dense matrices.

For Newton's method on a chain of elements: row $k$ couples the unknowns of block $k$
with those of its two neighbours,

$$L_k x_{k-1} + D_k x_k + U_k x_{k+1} = b_k.$$

Block elimination (the Thomas algorithm) solves it in two passes along the chain, with
work and memory in proportion to the number of blocks. Blocks are eliminated without
pivoting. That is safe for the matrices of rods: they are positive definite up to small
non-symmetric parts, whatever the units of the unknowns. LAPACK is not used: a call per
block would cost more than the elimination, and would not batch.

Where effects couple second neighbours, every two blocks are merged into one. Effects
that couple distant parts of a rod need the dense form. A rod of `n` elements has
`6 n + 3` unknowns, and the work of a dense solve grows with their cube. With tens of
elements it is about as much as the elimination along the chain, with hundreds far more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxrod.statics.elimination import eliminate
from jaxrod.structure import pytree, static

_COLUMNS_AT_ONCE = 128


@pytree
class BlockTridiagonal:
    """A square matrix of `n` by `n` blocks that is block-tridiagonal.

    Each field has a block for every row. The first block of `lower` and the last of
    `upper` lie outside the matrix and must be zero.
    """

    lower: Float[Array, "n m m"]
    """Block `k` couples row `k` to the unknowns of block `k - 1`."""
    diagonal: Float[Array, "n m m"]
    """Block `k` couples row `k` to the unknowns of block `k`."""
    upper: Float[Array, "n m m"]
    """Block `k` couples row `k` to the unknowns of block `k + 1`."""

    @property
    def transposed(self) -> BlockTridiagonal:
        """The transposed matrix."""
        return BlockTridiagonal(
            lower=_swapped(_later(self.upper)),
            diagonal=_swapped(self.diagonal),
            upper=_swapped(_earlier(self.lower)),
        )

    def multiply(self, vector: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """The matrix times a vector."""
        return (
            _times(self.lower, _later(vector))
            + _times(self.diagonal, vector)
            + _times(self.upper, _earlier(vector))
        )

    def solve(self, right: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """Solution for a right-hand side; not finite if the matrix is singular.

        Differentiable any number of times in both modes; reverse mode solves with
        the transposed matrix instead of going back through the elimination.
        """
        return lax.custom_linear_solve(
            self.multiply,
            right,
            lambda _, b: self._eliminate(b)[0],
            lambda _, b: self.transposed._eliminate(b)[0],
        )

    def is_positive(self) -> Bool[Array, ""]:
        """Whether all pivots are positive. False if the matrix is not finite.

        A symmetric matrix is then positive definite.
        """
        _, pivots = self._eliminate(jnp.zeros(self.diagonal.shape[:2], self.dtype))
        return jnp.all(pivots > 0)

    def _eliminate(
        self, right: Float[Array, "n m"]
    ) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
        return eliminate(self.lower, self.diagonal, self.upper, right)

    def stiffened(self, index: int, block: Float[Array, "2*m 2*m"]) -> BlockTridiagonal:
        """Matrix with a block added that couples blocks `index` and `index` + 1."""
        m = len(block) // 2
        own = self.diagonal.at[index].add(block[:m, :m])
        return BlockTridiagonal(
            lower=self.lower.at[index + 1].add(block[m:, :m]),
            diagonal=own.at[index + 1].add(block[m:, m:]),
            upper=self.upper.at[index].add(block[:m, m:]),
        )

    def with_blocks(self, blocks: Float[Array, "n m m"]) -> BlockTridiagonal:
        """Matrix with a block added to each of its diagonal blocks."""
        return replace(self, diagonal=self.diagonal + blocks)

    def factored(self) -> BlockTridiagonal:
        """The matrix itself: block elimination is fast without stored factors."""
        return self

    @property
    def dtype(self) -> jnp.dtype:
        """Dtype of the entries."""
        return self.diagonal.dtype


def _later(blocks: Array) -> Array:
    """Blocks shifted by one row: row `k` has the old row `k - 1`, the first is zero."""
    return jnp.pad(blocks[:-1], ((1, 0),) + ((0, 0),) * (blocks.ndim - 1))


def _earlier(blocks: Array) -> Array:
    """Blocks shifted by one row: row `k` has the old row `k + 1`, the last is zero."""
    return jnp.pad(blocks[1:], ((0, 1),) + ((0, 0),) * (blocks.ndim - 1))


def _swapped(blocks: Array) -> Array:
    return jnp.swapaxes(blocks, 1, 2)


def _times(blocks: Array, vector: Array) -> Array:
    """Each block times its vector, without matrix units, which would round to TF32."""
    return jnp.sum(blocks * vector[:, None, :], axis=2)


@pytree
class PairedBlocks:
    """A square matrix of `n` by `n` blocks that couples second neighbours.

    Every two blocks make one block of a block-tridiagonal matrix. If their number is
    odd, an extra block makes it even.
    """

    pairs: BlockTridiagonal
    """The matrix of pairs of blocks."""
    n: int = static()
    """Number of blocks."""

    def multiply(self, vector: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """The matrix times a vector."""
        return self._parted(self.pairs.multiply(self._paired(vector)))

    def solve(self, right: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """Solution for a right-hand side; see `BlockTridiagonal.solve`."""
        return self._parted(self.pairs.solve(self._paired(right)))

    def is_positive(self) -> Bool[Array, ""]:
        """Whether all pivots are positive: see `BlockTridiagonal.is_positive`."""
        return self.pairs.is_positive()

    def stiffened(self, index: int, block: Float[Array, "2*m 2*m"]) -> PairedBlocks:
        """Matrix with a block added that couples blocks `index` and `index` + 1."""
        first, m = index // 2, len(block) // 2
        if index % 2 == 0:
            diagonal = self.pairs.diagonal.at[first].add(block)
            return replace(self, pairs=replace(self.pairs, diagonal=diagonal))
        # The second block of a pair and the first of the next one.
        around = jnp.pad(block, m)
        return replace(self, pairs=self.pairs.stiffened(first, around))

    def with_blocks(self, blocks: Float[Array, "n m m"]) -> PairedBlocks:
        """Matrix with a block added to each of its diagonal blocks."""
        first, second = _first_and_second(blocks)
        none = jnp.zeros_like(first)
        added = self.pairs.with_blocks(quarters(first, none, none, second))
        return replace(self, pairs=added)

    def factored(self) -> PairedBlocks:
        """The matrix itself: block elimination is fast without stored factors."""
        return self

    def _paired(self, vector: Float[Array, "n m"]) -> Float[Array, "half 2*m"]:
        return jnp.concatenate(_first_and_second(vector), axis=1)

    def _parted(self, vector: Float[Array, "half 2*m"]) -> Float[Array, "n m"]:
        return vector.reshape(2 * len(vector), -1)[: self.n]


def in_pairs(matrix: BlockTridiagonal) -> PairedBlocks:
    """Converts a block-tridiagonal matrix to `PairedBlocks`."""
    none = jnp.zeros_like(matrix.diagonal)
    bands = none, matrix.lower, matrix.diagonal, matrix.upper, none
    return of_five_bands(bands, spare=1.0)


def of_five_bands(bands: Sequence[Float[Array, "n m m"]], spare: float) -> PairedBlocks:
    """Matrix whose rows of blocks couple two blocks on either side.

    Args:
        bands: Blocks of each row, from the second neighbour before it to the second
            neighbour after it.
        spare: Number on the diagonal of the extra block that makes the number of blocks
            even.
    """
    before_last, before, diagonal, after, after_next = bands
    n, m, _ = diagonal.shape
    (a0, a1), (b0, b1), (d0, d1), (u0, u1), (v0, v1) = (
        _first_and_second(band)
        for band in (before_last, before, diagonal, after, after_next)
    )
    none = jnp.zeros_like(a0)
    if n % 2:
        d1 = d1.at[-1].set(spare * jnp.eye(m, dtype=d1.dtype))
    pairs = BlockTridiagonal(
        lower=quarters(a0, b0, none, a1),
        diagonal=quarters(d0, u0, b1, d1),
        upper=quarters(v0, none, u1, v1),
    )
    return PairedBlocks(pairs, n)


def _first_and_second(blocks: Array) -> tuple[Array, Array]:
    """Blocks with even and with odd indices; a zero block makes them equally many."""
    n = len(blocks)
    even = jnp.pad(blocks, ((0, n % 2),) + ((0, 0),) * (blocks.ndim - 1))
    return even[0::2], even[1::2]


def quarters(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Blocks [[a, b], [c, d]], each assembled from four quarters."""
    return jnp.concatenate(
        [jnp.concatenate([a, b], axis=2), jnp.concatenate([c, d], axis=2)], axis=1
    )


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

    def stiffened(self, index: int, block: Float[Array, "2*m 2*m"]) -> Dense:
        """Matrix with a block added that couples blocks `index` and `index` + 1."""
        m = len(block) // 2
        two = slice(index, index + 2)
        added = block.reshape(2, m, 2, m)
        return Dense(self.entries.at[two, :, two, :].add(added))

    def with_blocks(self, blocks: Float[Array, "n m m"]) -> Dense:
        """Matrix with a block added to each of its diagonal blocks."""
        one = jnp.eye(len(blocks), dtype=blocks.dtype)
        return Dense(self.entries + one[:, None, :, None] * blocks[:, :, None, :])

    def factored(self) -> FactoredDense:
        """LU factors of the scaled matrix, for several solutions."""
        scale, scaled = self._scaled()
        return FactoredDense(scale, lu_factors(scaled))

    def _scaled(self) -> tuple[Float[Array, "n m"], Float[Array, "size size"]]:
        """Scale s of the unknowns, and the matrix s A s, whose diagonal is one.

        Displacements and rotations have different units, but pivots are chosen by size.
        """
        n, m = self.entries.shape[:2]
        flat = self.entries.reshape(n * m, n * m)
        diagonal = jnp.abs(jnp.diagonal(flat))
        scale = lax.stop_gradient(lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1)))
        return scale.reshape(n, m), scale[:, None] * flat * scale[None, :]


@pytree
class FactoredDense:
    """LU factors of a dense matrix that was scaled to a diagonal of one."""

    scale: Float[Array, "n m"]
    """Factors that scale rows and columns, 1 / sqrt(diagonal)."""
    factors: LU
    """Factors of the scaled matrix."""

    def solve(self, right: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """Solution for a right-hand side; not finite if the matrix is singular."""
        solution = self.factors.solve(jnp.ravel(self.scale * right))
        return self.scale * solution.reshape(right.shape)


@pytree
class LU:
    """LU factors of a square matrix with permuted rows, for several solutions.

    Unlike those of `jax.scipy.linalg` they have the permutation itself, which XLA would
    otherwise find for every solution.
    """

    triangles: Float[Array, "size size"]
    """Both triangular factors in one matrix; the lower one has a diagonal of one."""
    order: Int[Array, " size"]
    """Numbers of the matrix's rows, in the order of the factors' rows."""

    def solve(self, right: Float[Array, " size"]) -> Float[Array, " size"]:
        """Solution for a right-hand side; not finite if the matrix is singular."""
        column = right[self.order][:, None]
        for lower in (True, False):
            column = lax.linalg.triangular_solve(
                self.triangles,
                column,
                left_side=True,
                lower=lower,
                unit_diagonal=lower,
            )
        return column[:, 0]


def lu_factors(matrix: Float[Array, "size size"]) -> LU:
    """LU factors of a square matrix, with partial pivoting."""
    triangles, _, order = lax.linalg.lu(matrix)
    return LU(triangles, order)


def as_dense(matrix: BlockTridiagonal) -> Dense:
    """Dense form of a block-tridiagonal matrix."""
    n = len(matrix.diagonal)
    blocks = (matrix.lower, matrix.diagonal, matrix.upper)
    entries = sum(
        jnp.eye(n, k=shift, dtype=matrix.dtype)[:, None, :, None] * part[:, :, None, :]
        for shift, part in zip((-1, 0, 1), blocks, strict=True)
    )
    assert isinstance(entries, Array)
    return Dense(entries)


def matrix_of(
    function: Callable[[Float[Array, "n m"]], Float[Array, "n m"]],
    like: Float[Array, "n m"],
) -> Dense:
    """Dense matrix of a linear function, evaluated for all `n m` unit vectors."""
    seeds = jnp.eye(like.size, dtype=like.dtype).reshape(like.size, *like.shape)
    if like.size <= _COLUMNS_AT_ONCE:
        answers = jax.vmap(function)(seeds)
    else:
        # In one batch the intermediate values of all directions may take gigabytes.
        answers = lax.map(function, seeds, batch_size=_COLUMNS_AT_ONCE)
    return Dense(jnp.moveaxis(answers, 0, -1).reshape(*like.shape, *like.shape))
