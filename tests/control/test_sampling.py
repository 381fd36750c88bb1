"""Sampling finds known minima within bounds, and is repeatable."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import control

STEP, COUNT = 0.1, 12
SOLVERS = {"mppi": control.mppi, "cross_entropy": control.cross_entropy}


def moved(data, state, force, k):
    x, v = state
    return jnp.stack([x + STEP * v, v + STEP * force[0]])


def final(data, state):
    return state - data


def problem(bound=5.0, goal=0.6):
    return control.make_problem(
        jnp.zeros(2),
        moved,
        n_intervals=COUNT,
        interval=STEP,
        n_controls=1,
        final=final,
        data=jnp.asarray([goal, 0.0]),
        lower=-bound,
        upper=bound,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
def test_a_mass_is_brought_to_rest_elsewhere(name):
    found = SOLVERS[name](problem(), n_knots=3, iterations=30)
    assert found.cost < 1e-4 < 0.36  # the last is what doing nothing costs
    assert np.all(np.diff(found.history["cost"]) <= 0)
    np.testing.assert_allclose(found.states[-1], [0.6, 0.0], atol=0.02)
    again = SOLVERS[name](problem(), n_knots=3, iterations=30)
    assert again.cost == found.cost and again.compile_s == 0
    other = SOLVERS[name](problem(), n_knots=3, iterations=30, seed=1)
    assert other.cost != found.cost
    assert name in repr(found) and "30 times 64 samples" in found.reason


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", SOLVERS)
def test_bounds_hold(name):
    found = SOLVERS[name](problem(bound=0.2), n_knots=3, iterations=30)
    assert np.max(np.abs(found.controls)) <= 0.2 + 1e-12
    assert found.cost > 0.05


@pytest.mark.parametrize("name", SOLVERS)
def test_samples_are_drawn_and_weighed_as_the_method_says(name):
    """The same draws, in loops: what is best and where the next are drawn about."""
    own, samples, iterations, spread = problem(), 6, 3, 0.4
    how = {"elites": 2} if name == "cross_entropy" else {"temperature": 0.5}
    found = SOLVERS[name](
        own, n_knots=2, samples=samples, iterations=iterations, spread=spread, **how
    )
    half = 5.0
    middle, deviation = np.zeros((2, 1)), np.full((2, 1), spread * half)
    best, least, costs = middle, np.inf, []

    @jax.jit
    @jax.vmap
    def valued(knots):
        return control.trajectories.problem.cost(
            own, control.trajectories.problem.over_time(knots, COUNT)
        )

    for k, key in enumerate(jax.random.split(jax.random.key(0), iterations)):
        noise = np.asarray(jax.random.normal(key, (samples, 2, 1)))
        drawn = np.clip(middle + deviation * noise, -half, half)
        drawn[0] = best
        values = np.asarray(valued(jnp.asarray(drawn)))
        order = np.argsort(values)
        if values[order[0]] < least:
            best, least = drawn[order[0]], values[order[0]]
        if name == "cross_entropy":
            elite = drawn[order[:2]]
            middle, deviation = elite.mean(axis=0), elite.std(axis=0) + 1e-3 * half
        else:
            weights = np.exp(-(values - values.min()) / (0.5 * values.std()))
            middle = np.einsum("s,skc->kc", weights / weights.sum(), drawn)
            deviation = np.full((2, 1), 0.1 ** ((k + 1) / iterations) * spread * half)
        costs.append(least)
    np.testing.assert_allclose(found.history["cost"], costs, rtol=1e-9)
    np.testing.assert_allclose(found.knots, best, rtol=1e-9)
    assert len(set(costs)) > 1


def test_compiling_and_running_take_no_longer_than_the_call():
    began = time.perf_counter()
    found = control.mppi(problem(), n_knots=4, samples=3, iterations=2)
    passed = time.perf_counter() - began
    assert found.compile_s > 0 and found.run_s > 0
    assert found.compile_s + found.run_s <= passed


def test_bad_arguments_are_named():
    for solver, settings, message in (
        (control.mppi, {"samples": 1}, "samples must be at least 2"),
        (control.mppi, {"temperature": 0.0}, "temperature must be positive"),
        (control.mppi, {"spread": 0.0}, "spread must be positive"),
        (control.cross_entropy, {"elites": 65}, "elites must be at most 64"),
        (control.cross_entropy, {"iterations": 0}, "iterations must be at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            solver(problem(), **settings)
    with pytest.raises(TypeError, match="problem must be"):
        control.mppi(3)
