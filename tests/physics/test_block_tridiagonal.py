"""Block-tridiagonal systems against dense linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.block_tridiagonal import BlockTridiagonal
from physics.rods import difference, largest

N, M = 7, 6


def random_matrix(seed, dtype=jnp.float64, n=N, m=M):
    """A random matrix whose diagonal dominates, and a right side."""
    random = np.random.default_rng(seed)
    lower, diagonal, upper = random.normal(size=(3, n, m, m))
    lower[0] = upper[-1] = 0
    diagonal += 4 * m * np.eye(m)
    right = random.normal(size=(n, m))
    entries = (jnp.asarray(entry, dtype) for entry in (lower, diagonal, upper))
    return BlockTridiagonal(*entries), jnp.asarray(right, dtype)


def dense(matrix):
    """The whole matrix, zeros and all."""
    n, m = matrix.diagonal.shape[:2]
    whole = np.zeros((n, m, n, m))
    for k in range(n):
        whole[k, :, k] = matrix.diagonal[k]
        if k > 0:
            whole[k, :, k - 1] = matrix.lower[k]
        if k < n - 1:
            whole[k, :, k + 1] = matrix.upper[k]
    return whole.reshape(n * m, n * m)


def solve(matrix, right):
    return jax.jit(BlockTridiagonal.solve)(matrix, right)


@pytest.mark.parametrize(("n", "m"), [(N, M), (1, 3), (2, 1)])
def test_the_solution_is_that_of_the_dense_system(n, m, dtype):
    matrix, right = random_matrix(0, dtype, n, m)
    expected = np.linalg.solve(dense(matrix), np.asarray(right, float).ravel())
    error = np.max(np.abs(np.ravel(solve(matrix, right)) - expected))
    assert solve(matrix, right).dtype == dtype
    assert error < 10 * jnp.finfo(dtype).eps * np.max(np.abs(expected))


def test_product_and_transpose_are_those_of_the_dense_matrix():
    matrix, right = random_matrix(1)
    np.testing.assert_allclose(
        np.ravel(matrix.multiply(right)), dense(matrix) @ np.ravel(right), rtol=1e-13
    )
    np.testing.assert_array_equal(dense(matrix.transposed), dense(matrix).T)


def test_the_units_of_the_unknowns_do_not_matter():
    """Rows and columns scaled over twelve orders give the scaled solution."""
    matrix, right = random_matrix(2)
    units = jnp.asarray(10.0 ** np.linspace(-6, 6, M))
    scaled = jax.tree.map(
        lambda b: b * units[None, :, None] * units[None, None], matrix
    )
    expected = solve(matrix, right) / units[None]
    got = solve(scaled, right * units[None])
    np.testing.assert_allclose(got, expected, rtol=1e-11)


def test_as_many_negative_pivots_as_negative_eigenvalues():
    for seed in range(5):
        matrix, _ = random_matrix(seed)
        shifted = matrix.diagonal - 3 * (seed + 1) * M * jnp.eye(M)[None]
        symmetric = BlockTridiagonal(
            lower=jnp.swapaxes(jnp.roll(matrix.upper, 1, axis=0), 1, 2),
            diagonal=shifted + jnp.swapaxes(shifted, 1, 2),
            upper=matrix.upper,
        )
        eigenvalues = np.linalg.eigvalsh(dense(symmetric))
        assert int(symmetric.negative_pivots()) == np.sum(eigenvalues < 0)


def test_a_singular_matrix_gives_no_finite_solution():
    matrix, right = random_matrix(3)
    singular = BlockTridiagonal(*jax.tree.map(jnp.zeros_like, jax.tree.leaves(matrix)))
    assert not np.any(np.isfinite(solve(singular, right)))


def test_derivatives_of_the_solution():
    matrix, right = random_matrix(4)
    change, push = random_matrix(5)

    def moved(t):
        return solve(jax.tree.map(lambda a, b: a + t * b, matrix, change), right)

    # A (dx) = -(dA) x, and for the second derivative A (ddx) = -2 (dA)(dx).
    solution, slope = jax.jvp(moved, (0.0,), (1.0,))
    expected = solve(matrix, -change.multiply(solution))
    assert difference(slope, expected) < 1e-13
    second = jax.jvp(lambda t: jax.jvp(moved, (t,), (1.0,))[1], (0.0,), (1.0,))[1]
    expected = solve(matrix, -2 * change.multiply(slope))
    assert difference(second, expected) < 1e-13
    # Reverse mode is the transpose of forward mode.
    _, pull = jax.vjp(solve, matrix, right)
    at_matrix, at_right = pull(push)
    forward = jnp.vdot(push, slope)
    reverse = sum(
        jnp.vdot(a, b)
        for a, b in zip(*map(jax.tree.leaves, (at_matrix, change)), strict=True)
    )
    assert float(reverse) == pytest.approx(float(forward), rel=1e-12)
    expected = np.linalg.solve(dense(matrix).T, np.ravel(push))
    np.testing.assert_allclose(np.ravel(at_right), expected, rtol=1e-11)


def test_a_batch_of_systems_is_solved_as_one_by_one():
    several = [random_matrix(seed) for seed in range(3)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    together = jax.vmap(solve)(*batch)
    one_by_one = jnp.stack([solve(*system) for system in several])
    assert difference(together, one_by_one) < 1e-15 * largest(one_by_one) * 10
