"""Least squares: known minima, bounds, ridges, many at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.control import least_squares


def rosenbrock(point):
    return jnp.stack([10 * (point["b"] - point["a"] ** 2), 1 - point["a"]])


START = {"a": jnp.asarray(-1.2), "b": jnp.asarray(1.0)}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_a_known_minimum_is_found(mode):
    found = least_squares(rosenbrock, START, iterations=200, mode=mode)
    assert bool(found.converged)
    assert float(found.solution["a"]) == pytest.approx(1, abs=1e-8)
    assert float(found.solution["b"]) == pytest.approx(1, abs=1e-8)
    costs = np.asarray(found.costs[: int(found.iterations) + 1])
    assert np.all(np.diff(costs) <= 0)


@pytest.mark.slow
@pytest.mark.parametrize("batched", [False, True])
def test_an_iteration_whose_first_damping_would_be_rejected_is_not_lost(dtype, batched):
    start = jnp.asarray([-1.0, 1.0], dtype)

    def made(point):
        return rosenbrock({"a": point[0], "b": point[1]})

    def search(start):
        return least_squares(
            made, start, initial_damping=3e-3, iterations=40, several=True
        )

    values, slopes = np.asarray(made(start)), np.asarray(jax.jacfwd(made)(start))
    normal = slopes.T @ slopes
    damped = normal + 3e-3 * np.diag(np.diag(normal))
    alone = np.asarray(start) - np.linalg.solve(damped, slopes.T @ values)
    assert np.sum(np.asarray(made(jnp.asarray(alone))) ** 2) > np.sum(values**2)

    if batched:
        found = jax.jit(jax.vmap(search))(jnp.stack([start, -start]))
        found = jax.tree.map(lambda leaf: leaf[0], found)
    else:
        found = jax.jit(search)(start)
    costs = np.asarray(found.costs[: int(found.iterations) + 1])
    assert found.costs.dtype == dtype
    assert np.all(np.diff(costs[costs > 1e-4]) < 0), "each batch has a better point"
    np.testing.assert_allclose(found.solution, [1, 1], atol=1e-3)


@pytest.mark.parametrize("damping", [1e-12, 1e9])
def test_a_first_damping_that_is_far_off_costs_few_iterations(damping):
    start = jnp.asarray([-1.2, 1.0])
    found = least_squares(
        lambda z: rosenbrock({"a": z[0], "b": z[1]}),
        start,
        initial_damping=damping,
        several=True,
    )
    assert bool(found.converged) and int(found.iterations) < 40
    np.testing.assert_allclose(found.solution, [1, 1], atol=1e-8)


def linear(seed, rows, columns):
    random = np.random.default_rng(seed)
    return random.normal(size=(rows, columns)), random.normal(size=rows)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(("rows", "columns"), [(9, 4), (3, 8), (5, 5)])
def test_linear_problems_with_a_ridge_have_their_closed_form(rows, columns):
    matrix, right = linear(rows, rows, columns)
    start, rho = np.linspace(-1, 1, columns), 0.3
    found = least_squares(
        lambda z: matrix @ z - right, jnp.asarray(start), ridge=rho, tolerance=1e-14
    )
    normal = matrix.T @ matrix + rho * np.eye(columns)
    expected = np.linalg.solve(normal, matrix.T @ right + rho * start)
    np.testing.assert_allclose(found.solution, expected, atol=1e-7)


def test_bounds_hold_and_the_rest_is_best_within_them():
    from scipy.optimize import lsq_linear

    matrix, right = linear(7, 8, 5)
    found = least_squares(
        lambda z: matrix @ z - right,
        jnp.zeros(5),
        lower=-0.1,
        upper=0.2,
        tolerance=1e-14,
    )
    expected = lsq_linear(matrix, right, (-0.1, 0.2), tol=1e-14).x
    np.testing.assert_allclose(found.solution, expected, atol=1e-6)
    assert np.isin(np.round(expected, 6), (-0.1, 0.2)).any()


def test_points_that_are_not_finite_are_never_taken():
    # From 0.1 the full step of Newton's method for log z = 0 is short of what is right;
    # from 5 it leads below zero, where there is no logarithm.
    found = least_squares(
        lambda z: jnp.log(z), jnp.asarray([5.0]), initial_damping=1e-9
    )
    assert bool(found.converged)
    assert float(found.solution[0]) == pytest.approx(1, abs=1e-6)


@pytest.mark.slow
def test_many_problems_at_once_are_each_alone():
    starts = jnp.linspace(-1.5, 1.5, 5)

    def one(a):
        return least_squares(
            rosenbrock, {"a": a, "b": jnp.ones_like(a)}, iterations=100
        )

    together = jax.jit(jax.vmap(one))(starts)
    for k, a in enumerate(starts):
        np.testing.assert_allclose(
            together.solution["a"][k], one(a).solution["a"], atol=1e-10
        )


def test_what_changes_nothing_stays_where_it_is():
    found = least_squares(lambda z: z[:1] - 2, jnp.asarray([0.0, 3.0]), mode="forward")
    np.testing.assert_allclose(found.solution, [2.0, 3.0], atol=1e-8)


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="mode must be"):
        least_squares(rosenbrock, START, mode="central")
    with pytest.raises(ValueError, match="at least one number"):
        least_squares(lambda z: z, jnp.zeros(0))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("unit", [1.0, 1e12])
def test_units_of_one_unknown_do_not_end_the_search_of_another(unit):
    """A double root is come near to by a half a step: slowly, but to the end."""

    def made(point):
        return jnp.stack([point["a"] / unit - 1, point["b"] ** 2])

    start = {"a": jnp.asarray(0.5 * unit), "b": jnp.asarray(1.0)}
    found = least_squares(made, start, iterations=100)
    assert abs(float(found.solution["b"])) < 1e-3
