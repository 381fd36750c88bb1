"""Block-tridiagonal systems, the same in pairs, and dense ones: linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.lanes.run_spec import in_one_kernel
from jaxrod.statics.block_matrices import (
    BlockTridiagonal,
    as_dense,
    in_pairs,
    matrix_of,
    of_five_bands,
)
from jaxrod.statics.elimination import eliminate
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


# A block-tridiagonal matrix as it is, in pairs of blocks, and as a dense one.
every_form = pytest.mark.parametrize(
    "form", [lambda matrix: matrix, in_pairs, as_dense]
)


def whole(matrix):
    """All entries of a block-tridiagonal matrix, zeros and all."""
    n, m = matrix.diagonal.shape[:2]
    entries = np.zeros((n, m, n, m))
    for k in range(n):
        entries[k, :, k] = matrix.diagonal[k]
        if k > 0:
            entries[k, :, k - 1] = matrix.lower[k]
        if k < n - 1:
            entries[k, :, k + 1] = matrix.upper[k]
    return entries.reshape(n * m, n * m)


def solve(matrix, right):
    return jax.jit(lambda matrix, right: matrix.solve(right))(matrix, right)


@pytest.mark.fast_sets(2)
@every_form
@pytest.mark.parametrize(("n", "m"), [(N, M), (1, 3), (2, 1)])
def test_the_solution_is_that_of_the_whole_system(n, m, form, dtype):
    matrix, right = random_matrix(0, dtype, n, m)
    expected = np.linalg.solve(whole(matrix), np.asarray(right, float).ravel())
    solution = solve(form(matrix), right)
    error = np.max(np.abs(np.ravel(solution) - expected))
    assert solution.dtype == dtype
    assert error < 10 * jnp.finfo(dtype).eps * np.max(np.abs(expected))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
def test_second_neighbours_are_in_pairs(n):
    random = np.random.default_rng(n)
    bands = random.normal(size=(5, n, 3, 3))
    bands[2] += 15 * np.eye(3)
    entries = np.zeros((n, 3, n, 3))
    for k in range(n):
        for shift in range(-2, 3):
            if 0 <= k + shift < n:
                entries[k, :, k + shift] = bands[shift + 2, k]
            else:
                bands[shift + 2, k] = 0
    entries = entries.reshape(3 * n, 3 * n)
    matrix = of_five_bands(jnp.asarray(bands), spare=1.0)
    right = random.normal(size=(n, 3))
    product = np.ravel(matrix.multiply(jnp.asarray(right)))
    np.testing.assert_allclose(product, entries @ right.ravel(), atol=1e-12)
    solution = np.ravel(matrix.solve(jnp.asarray(right)))
    expected = np.linalg.solve(entries, right.ravel())
    np.testing.assert_allclose(solution, expected, atol=1e-13)


@pytest.mark.fast_sets(1)
@every_form
def test_the_product_is_that_of_the_whole_matrix(form):
    matrix, right = random_matrix(1)
    np.testing.assert_allclose(
        np.ravel(form(matrix).multiply(right)),
        whole(matrix) @ np.ravel(right),
        rtol=1e-12,
    )


def test_transpose_and_dense_form_have_the_entries_they_should():
    matrix, _ = random_matrix(1)
    entries = as_dense(matrix).entries.reshape(N * M, N * M)
    np.testing.assert_array_equal(entries, whole(matrix))
    np.testing.assert_array_equal(whole(matrix.transposed), whole(matrix).T)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("n", [N, 25])
def test_columns_are_found_one_by_one_or_some_at_once(n):
    matrix, right = random_matrix(1, n=n)
    found = matrix_of(matrix.multiply, right)
    assert difference(found, as_dense(matrix)) == 0


@pytest.mark.fast_sets(1)
@every_form
def test_the_units_of_the_unknowns_do_not_matter(form):
    """Rows and columns scaled over twelve orders give the scaled solution."""
    matrix, right = random_matrix(2)
    units = jnp.asarray(10.0 ** np.linspace(-6, 6, M))
    scaled = jax.tree.map(
        lambda b: b * units[None, :, None] * units[None, None], matrix
    )
    expected = solve(matrix, right) / units[None]
    got = solve(form(scaled), right * units[None])
    np.testing.assert_allclose(got, expected, rtol=1e-11)


@pytest.mark.fast_sets(1)
@every_form
def test_what_has_positive_eigenvalues_alone_is_positive(form):
    answers = []
    for seed in range(6):
        matrix, _ = random_matrix(seed)
        shifted = matrix.diagonal - 4 * seed * jnp.eye(M)[None]
        symmetric = BlockTridiagonal(
            lower=jnp.swapaxes(jnp.roll(matrix.upper, 1, axis=0), 1, 2),
            diagonal=shifted + jnp.swapaxes(shifted, 1, 2),
            upper=matrix.upper,
        )
        expected = np.min(np.linalg.eigvalsh(whole(symmetric))) > 0
        answers.append(bool(form(symmetric).is_positive()))
        assert answers[-1] == expected
    assert any(answers) and not all(answers)
    unknown = jax.tree.map(lambda a: jnp.nan * a, symmetric)
    assert not bool(form(unknown).is_positive())


@every_form
@pytest.mark.parametrize("first", [1, 2])
def test_what_is_added_to_two_neighbouring_blocks_is_there(form, first):
    matrix, right = random_matrix(3)
    block = jnp.arange(4 * M * M, dtype=right.dtype).reshape(2 * M, 2 * M)
    change = form(matrix).stiffened(first, block).multiply(right)
    change = change - form(matrix).multiply(right)
    two = slice(first, first + 2)
    expected = (block @ right[two].ravel()).reshape(2, M)
    np.testing.assert_allclose(change[two], expected, rtol=1e-12)
    assert largest(change.at[two].set(0)) == 0


@every_form
def test_a_singular_matrix_gives_no_finite_solution(form):
    matrix, right = random_matrix(3)
    singular = jax.tree.map(jnp.zeros_like, matrix)
    assert not np.any(np.isfinite(solve(form(singular), right)))


@pytest.mark.slow
@every_form
def test_derivatives_of_the_solution(form):
    chain, right = random_matrix(4)
    change, push = random_matrix(5)
    matrix, change = form(chain), form(change)

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
    expected = np.linalg.solve(whole(chain).T, np.ravel(push))
    np.testing.assert_allclose(np.ravel(at_right), expected, rtol=1e-11)


def test_a_batch_of_systems_is_solved_as_one_by_one():
    several = [random_matrix(seed) for seed in range(3)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    together = jax.vmap(solve)(*batch)
    one_by_one = jnp.stack([solve(*system) for system in several])
    assert difference(together, one_by_one) < 1e-15 * largest(one_by_one) * 10


@pytest.mark.parametrize(("n", "m"), [(N, M), (4, 12), (3, 3)])
def test_kernels_eliminate_by_columns_and_get_the_same(n, m):
    matrix, right = random_matrix(5, n=n, m=m)
    blocks = matrix.lower, matrix.diagonal, matrix.upper, right
    solution, pivots = jax.jit(eliminate)(*blocks)
    # A function of its own: programs inside and outside of kernels are not one.
    with in_one_kernel():
        program = jax.make_jaxpr(lambda *given: eliminate(*given))(*blocks)
    by_columns = jax.core.eval_jaxpr(program.jaxpr, program.consts, *blocks)
    assert largest(by_columns[0] - solution) <= 1e-14 * largest(solution)
    assert largest(by_columns[1] - pivots) <= 1e-14 * largest(pivots)
