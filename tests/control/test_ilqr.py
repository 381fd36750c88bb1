"""Iterative linear-quadratic regulation: exact where it must be, within bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import control
from jaxrod.control.trajectories.ilqr import Linear, backward, box_step

STEP, COUNT = 0.1, 30


def cart_moved(data, state, force, k):
    """A double integrator, exactly."""
    x, v = state["x"], state["v"]
    a = force / data["mass"]
    return {"x": x + STEP * v + STEP**2 / 2 * a, "v": v + STEP * a}


def cart_running(data, state, force, k):
    return {"x": data["q"] * state["x"], "u": data["r"] * force}


def cart_final(data, state):
    return 3 * state["x"], 2 * state["v"]


def cart(bound=np.inf):
    return control.make_problem(
        {"x": jnp.asarray([1.0]), "v": jnp.asarray([0.5])},
        cart_moved,
        n_intervals=COUNT,
        interval=STEP,
        n_controls=1,
        running=cart_running,
        final=cart_final,
        data={"mass": jnp.asarray(2.0), "q": jnp.asarray(0.3), "r": jnp.asarray(0.1)},
        lower=-bound,
        upper=bound,
    )


def as_least_squares(problem):
    """The whole problem, linear in its controls: matrix and right side."""

    def flat(controls):
        made = control.trajectories.problem.residuals(problem, controls)
        return jax.flatten_util.ravel_pytree(made)[0]

    zero = jnp.zeros((COUNT, 1))
    return np.asarray(jax.jacfwd(flat)(zero)[:, :, 0]), np.asarray(flat(zero))


def test_a_linear_problem_is_solved_in_a_step_and_its_gains_are_those_of_riccati():
    problem = cart()
    found = control.ilqr(problem, initial_damping=1e-12, iterations=3)
    matrix, right = as_least_squares(problem)
    expected, *_ = np.linalg.lstsq(matrix, -right, rcond=None)
    np.testing.assert_allclose(found.controls[:, 0], expected, atol=1e-7)
    assert found.cost == pytest.approx(np.sum((matrix @ expected + right) ** 2))
    # The textbook's recursion, with squares.
    a = np.array([[1, STEP], [0, 1]])
    b = np.array([[STEP**2 / 2], [STEP]]) / 2.0
    order = [1, 0]  # leaves of a dict come in the order of their names
    value, state_cost, gains = np.diag([9.0, 4.0]), np.diag([0.09, 0.0]), []
    for _ in range(COUNT):
        total = value + state_cost
        gain = -np.linalg.solve(b.T @ total @ b + 0.01, b.T @ total @ a)
        value = (a + b @ gain).T @ total @ (a + b @ gain) + 0.01 * gain.T @ gain
        gains.append(gain)
    made = np.asarray(found.gains)[:, :, order]
    np.testing.assert_allclose(made, gains[::-1], rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_bounds_hold_and_the_rest_is_best_within_them():
    from scipy.optimize import lsq_linear

    problem = cart(bound=0.8)
    found = control.ilqr(problem, iterations=60, tolerance=1e-12)
    matrix, right = as_least_squares(problem)
    expected = lsq_linear(matrix, -right, (-0.8, 0.8), tol=1e-13).x
    assert np.sum(np.abs(expected) > 0.8 - 1e-6) > 3
    np.testing.assert_allclose(found.controls[:, 0], expected, atol=2e-4)
    held = np.abs(found.controls[:, 0]) >= 0.8
    assert held.any() and np.all(found.gains[held] == 0)
    assert np.all(np.diff(found.history["cost"]) <= 0)


def test_small_boxes_are_solved_exactly():
    from scipy.optimize import lsq_linear

    random = np.random.default_rng(3)
    for k in range(30):
        matrix, right = random.normal(size=(6, 4)), random.normal(size=6)
        matrix = matrix @ np.diag([1, 1, 1, 0.1 ** (k % 3)])
        lower, upper = -random.uniform(0, 0.4, 4), random.uniform(0, 0.4, 4)
        point, held = jax.jit(box_step)(
            *map(jnp.asarray, (matrix, right, lower, upper))
        )
        expected = lsq_linear(matrix, -right, (lower, upper), tol=1e-14).x
        np.testing.assert_allclose(point, expected, atol=1e-6)
        assert not np.any(held & (point > lower + 1e-6) & (point < upper - 1e-6))


def test_what_comes_before_knows_where_a_held_control_ends_up():
    """Two intervals; the second control may move by a little and is held there."""
    random = np.random.default_rng(8)
    a, b = random.normal(size=(2, 2, 2)), random.normal(size=(2, 2, 1))
    final, right = random.normal(size=(2, 2)), random.normal(size=2)
    # x_2 = a_1 b_0 u_0 + b_1 u_1, and damping is another row of each control.
    matrix = final @ np.hstack([a[1] @ b[0], b[1]])
    # Alone it would go farther than its bound.
    bound = -0.3 * (matrix[:, 1] @ right) / np.sum(matrix[:, 1] ** 2)
    expected = -(matrix[:, 0] @ (right + matrix[:, 1] * bound)) / np.sum(
        matrix[:, 0] ** 2
    )
    wide = 10.0
    start = np.array([[0.0], [np.sign(bound) * wide - bound]])
    nothing = np.zeros((2, 0))
    linear = Linear(
        *map(
            jnp.asarray,
            (a, b, nothing, np.zeros((2, 0, 2)), np.zeros((2, 0, 1)), right, final),
        )
    )
    changes, gains = jax.jit(backward)(
        linear,
        jnp.asarray(start),
        jnp.asarray([-wide]),
        jnp.asarray([wide]),
        jnp.asarray([1e-18]),
    )
    np.testing.assert_allclose(changes[:, 0], [expected, bound], rtol=1e-7)
    assert np.all(gains[1] == 0)


def test_feedback_answers_what_the_open_loop_does_not():
    found = control.ilqr(cart(), iterations=3)

    def pushed(state, k):
        return {**state, "v": state["v"] + jnp.where(k == 10, 1.0, 0.0)}

    calm = control.rolled_out(found.problem, found.policy)
    np.testing.assert_allclose(calm.cost, found.cost, rtol=1e-9)
    np.testing.assert_allclose(calm.controls, found.controls, atol=1e-9)
    caught = control.rolled_out(found.problem, found.policy, pushed)
    missed = control.rolled_out(found.problem, found.open_loop, pushed)
    assert float(caught.cost) < 0.2 * float(missed.cost)


@pytest.mark.slow
def test_a_solution_says_what_it_is():
    found = control.ilqr(cart(), iterations=3)
    assert "ilqr" in repr(found) and "with feedback" in repr(found)
    assert found.times[-1] == pytest.approx(STEP * COUNT)
    knots = control.levenberg_marquardt(cart(), n_knots=4, iterations=5)
    with pytest.raises(ValueError, match="levenberg_marquardt has no feedback"):
        knots.policy(found.problem.start, 0)
    with pytest.raises(ValueError, match="states of a rod"):
        found.replay()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"iterations": 0}, "iterations must be at least 1"),
        ({"initial_damping": 0.0}, "initial_damping must be positive"),
        ({"tolerance": -1.0}, "tolerance must be positive"),
        ({"initial_controls": np.zeros((2, 1))}, "initial_controls must have shape"),
        ({"initial_controls": np.full((COUNT, 1), 3.0)}, "within the bounds .* got 3"),
    ],
)
def test_bad_arguments_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        control.ilqr(cart(bound=1.0), **settings)


def test_what_is_no_problem_is_refused():
    with pytest.raises(TypeError, match="problem must be"):
        control.ilqr(None)
