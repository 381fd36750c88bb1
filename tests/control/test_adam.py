"""Adam on knots: its bounds, when it ends, and that interrupting loses nothing."""

import importlib

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import control

module = importlib.import_module("jaxrod.control.trajectories.adam")

TARGET = jnp.array([0.3, -0.2])


def move(data, state, control, k):
    """A point is pushed."""
    del data, k
    place, speed = state
    return place + 0.1 * speed, speed + 0.1 * control


def final(target, state):
    place, speed = state
    return place - target, 0.1 * speed


def running(target, state, control, k):
    del target, state, k
    return 0.01 * control


def problem(**changes):
    start = jnp.zeros(2), jnp.zeros(2)
    given = {"final": final, "running": running, "data": TARGET} | changes
    return control.make_problem(
        start, move, n_intervals=10, interval=0.1, n_controls=2, **given
    )


def solved(**settings):
    return control.adam(problem(), **{"n_knots": 4, "iterations": 60, **settings})


def test_the_cost_it_reports_is_that_of_the_motion_it_returns():
    seen = []
    found = solved(log=lambda k, value: seen.append((k, value)))
    assert seen == list(enumerate(found.history["cost"]))
    assert found.cost == pytest.approx(min(found.history["cost"]), rel=1e-12)
    assert found.cost < 0.05 * found.history["cost"][0]
    place, _ = (np.asarray(part[-1]) for part in found.states)
    np.testing.assert_allclose(place, TARGET, atol=0.05)
    assert found.iterations == 60 and "60 iterations" in found.reason
    assert not found.converged and not found.interrupted


def test_knots_stay_within_their_bounds():
    found = solved(learning_rate=10.0, iterations=5)
    assert float(jnp.max(jnp.abs(found.knots))) <= 1.0


def test_the_best_iterate_is_returned():
    optax = pytest.importorskip("optax")
    found = solved(iterations=6, optimiser=optax.sgd(100.0))
    costs = found.history["cost"]
    assert np.argmin(costs) < len(costs) - 1
    assert found.cost == pytest.approx(costs.min(), rel=1e-12)


def test_it_ends_where_the_cost_is_low_enough_and_goes_on_from_there():
    found = solved()
    again = solved(initial_knots=found.knots, enough=2 * found.cost)
    assert again.iterations == 1 and again.converged


def test_an_optimiser_of_ones_own_is_used():
    optax = pytest.importorskip("optax")
    found = solved(iterations=3, optimiser=optax.sgd(0.0))
    assert np.ptp(found.history["cost"]) == 0


def broken(monkeypatch, at, fault):
    """Lets a fault happen at some evaluation."""
    whole, calls = module.timed, []

    def timed(function, *arguments, **structure):
        result = whole(function, *arguments, **structure)
        calls.append(function)
        if calls.count(module._valued) == at and function is module._valued:
            return fault(result)
        return result

    monkeypatch.setattr(module, "timed", timed)


def interrupt(result):
    raise KeyboardInterrupt


def test_ctrl_c_returns_the_best_so_far(monkeypatch):
    broken(monkeypatch, 3, interrupt)
    found = solved()
    assert found.interrupted and found.iterations == 2
    assert found.cost == pytest.approx(min(found.history["cost"]), rel=1e-12)


def test_ctrl_c_before_there_is_anything_to_return_is_raised(monkeypatch):
    broken(monkeypatch, 1, interrupt)
    with pytest.raises(KeyboardInterrupt):
        solved()


def test_a_gradient_that_is_not_finite_ends_it_and_keeps_what_was_good(monkeypatch):
    def spoilt(result):
        (value, gradient), *times = result
        return (value, gradient * jnp.nan), *times

    broken(monkeypatch, 3, spoilt)
    found = solved()
    assert "not finite" in found.reason and found.iterations == 3
    assert jnp.all(jnp.isfinite(found.knots)) and np.isfinite(found.cost)
