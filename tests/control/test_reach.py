"""Reaching: the problem is what it says, and Levenberg-Marquardt solves it."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import control
from jaxrod.control.trajectories.problem import cost, over_time, residuals
from jaxrod.control.trajectories.reach import time_steps
from jaxrod.envs import actuated_arm

TARGET = (0.4, 0.6, 0.2)


def arm(n=3, dtype=None):
    return actuated_arm(n, n_controls=4, dtype=dtype)


def short(**settings):
    """A twentieth of a second of a coarse arm."""
    settings = {"duration": 0.05, "control_interval": 0.0125} | settings
    return control.reach(arm(), settings.pop("target", (0.02, 0.99, 0.01)), **settings)


def some_knots(problem, count=3):
    noise = jax.random.normal(jax.random.key(1), (count, problem.n_controls))
    return 0.2 * noise.astype(problem.lower.dtype)


@pytest.mark.parametrize("n_knots", [1, 2, 3, 5, 12])
def test_controls_are_interpolated_linearly_between_knots(n_knots):
    rng = np.random.default_rng(n_knots)
    knots = rng.normal(size=(n_knots, 2))
    places = (np.arange(10) + 0.5) / 10 * (n_knots - 1)
    expected = [np.interp(places, np.arange(n_knots), column) for column in knots.T]
    found = over_time(jnp.asarray(knots), 10)
    np.testing.assert_allclose(found, np.transpose(expected), atol=1e-14)


@pytest.mark.slow
def test_a_reach_costs_what_its_formula_says():
    problem = short(speed_weight=0.3, running_weight=0.7, effort_weight=0.2)
    controls = over_time(some_knots(problem), problem.n_intervals)
    assert controls.shape == (4, 8)
    states = control.trajectories.problem.trajectory(problem, controls)
    squares = np.sum(
        (np.asarray(states.tip) - np.asarray(problem.data.target)) ** 2, axis=1
    )
    speed = np.sum(np.asarray(states.velocities[-1, :, -1]) ** 2)
    expected = (
        squares[-1]
        + 0.3 * speed
        + 0.7 * np.mean(squares[1:])
        + 0.2 * np.mean(np.asarray(controls) ** 2)
    )
    assert float(cost(problem, controls)) == pytest.approx(expected, rel=1e-12)
    again = jaxrod.advance(
        problem.data.arm.with_controls(controls[0].reshape(2, 4)),
        problem.start,
        problem.data.dt,
        problem.data.steps_per_interval,
    )
    np.testing.assert_allclose(states.positions[1], again.positions, atol=1e-12)


@pytest.mark.slow
def test_gradients_and_both_jacobians_agree_with_differences():
    problem = short(running_weight=0.5, effort_weight=0.1)
    knots = some_knots(problem)

    def loss(knots):
        return cost(problem, over_time(knots, problem.n_intervals))

    def made(knots):
        return jax.flatten_util.ravel_pytree(
            residuals(problem, over_time(knots, problem.n_intervals))
        )[0]

    way = jax.random.normal(jax.random.key(2), knots.shape)
    gradient = float(jnp.sum(jax.jit(jax.grad(loss))(knots) * way))
    loss, made = jax.jit(loss), jax.jit(made)
    step = 1e-5
    further, back = knots + step * way, knots - step * way
    expected = float(loss(further) - loss(back)) / (2 * step)
    assert gradient == pytest.approx(expected, rel=1e-6)
    column = jax.jit(lambda z: jax.jvp(made, (z,), (way,))[1])(knots)
    differences = (made(further) - made(back)) / (2 * step)
    scale = float(jnp.max(jnp.abs(column)))
    np.testing.assert_allclose(column, differences, atol=1e-6 * scale)


@pytest.mark.slow
def test_levenberg_marquardt_reaches_and_says_how():
    problem = short()
    found = control.levenberg_marquardt(problem, n_knots=3, ridge=1e-9)
    apart = np.linalg.norm(found.states.tip[-1] - problem.data.target)
    start = np.linalg.norm(problem.start.tip - problem.data.target)
    assert apart < 0.02 * start
    assert found.readouts["distance [m]"][-1] == pytest.approx(apart, abs=1e-9)
    assert found.cost == pytest.approx(
        float(cost(problem, over_time(found.knots, 4))), rel=1e-9
    )
    assert np.all(np.diff(found.history["cost"]) <= 0)
    assert found.compile_s > 0 and found.run_s > 0
    assert re.search(r"distance \[m\]: .* 3 knots", repr(found), re.S)
    again = control.levenberg_marquardt(
        short(target=(-0.02, 0.99, 0.0)), n_knots=3, ridge=1e-9
    )
    assert again.compile_s == 0, "another target is another number"
    assert np.linalg.norm(again.states.tip[-1] - again.problem.data.target) < 5e-4
    replay = found.replay()
    assert replay.num_frames == 5
    assert np.allclose(replay.spheres[0].positions[-1], problem.data.target)


@pytest.mark.slow
def test_columns_and_rows_lead_to_the_same_trajectory():
    rows, columns = (
        control.levenberg_marquardt(short(), n_knots=3, mode=mode, iterations=8)
        for mode in ("reverse", "forward")
    )
    np.testing.assert_allclose(rows.knots, columns.knots, atol=1e-7)


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_millimetre_at_rest_takes_ten_iterations(record):
    problem = control.reach(actuated_arm(20), TARGET)
    found = control.levenberg_marquardt(problem, iterations=10)
    distance, speed = (found.readouts[k][-1] for k in found.readouts)
    assert found.controls.dtype == jnp.float32
    assert distance < 1e-3 and speed < 0.1
    assert float(jnp.max(jnp.abs(found.controls))) <= 1
    record(
        "Levenberg-Marquardt, reach of 0.6 m in 1 s, 10 iterations",
        "the target [m]",
        float(distance),
        at_most=1e-3,
    )


def arm_of_the_notebook(dtype):
    """The arm of notebooks/02_where_should_it_go.ipynb."""
    rod, state = jaxrod.straight_rod(
        10,
        length=1.0,
        radius=0.05,
        density=1000.0,
        youngs_modulus=1e7,
        direction=(0.0, 1.0, 0.0),
        dtype=dtype,
    )
    damping = jaxrod.exponential_damping(4.0, rotational_rate=4000.0)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), damping)
    spline = jaxrod.actuation.control_spline(6, 1.0, dtype=dtype)
    return control.ActuatedArm(scene, state, spline, jnp.asarray(1500.0, dtype))


def random_targets(count):
    """Points above the base of an arm, 0.5 to 0.9 of its length of 1 m away."""
    random = np.random.default_rng(0)
    ways = random.normal(size=(count, 3))
    ways[:, 1] = np.abs(ways[:, 1])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return ways * random.uniform(0.5, 0.9, size=(count, 1))


@pytest.mark.slow
def test_of_sixty_reaches_twelve_iterations_bring_most_within_5_mm(dtype, record):
    body = arm_of_the_notebook(dtype)
    away = []
    for target in random_targets(60):
        problem = control.reach(body, target)
        found = control.levenberg_marquardt(problem, iterations=12)
        assert found.controls.dtype == dtype
        away.append(found.readouts["distance [m]"][-1])
    record(
        f"Levenberg-Marquardt, of 60 reaches in 12 iterations within 5 mm, {dtype}",
        "60",
        float(np.sum(np.asarray(away) < 5e-3)),
        between=(58, 60),
    )


@pytest.mark.slow
def test_a_target_on_the_axis_does_not_trap_the_straight_arm():
    problem = short(target=(0.0, 0.97, 0.0))
    found = control.levenberg_marquardt(problem, n_knots=3, iterations=40)
    assert found.readouts["distance [m]"][-1] < 0.8 * 0.03


@pytest.mark.slow
def test_the_gradient_of_1000_steps_needs_less_than_5_megabytes():
    problem = control.reach(
        actuated_arm(20), TARGET, 0.3, control_interval=0.006, dt=3.001e-4
    )
    assert problem.n_intervals * problem.data.steps_per_interval == 1000

    def value(problem, knots):
        return cost(problem, over_time(knots, problem.n_intervals))

    gradient = jax.jit(jax.grad(value, argnums=1))
    compiled = gradient.lower(problem, some_knots(problem, 11)).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 5e6


def test_time_is_cut_into_whole_intervals_of_whole_stable_steps():
    body = arm()
    intervals, steps, dt = time_steps(body, 1.0, 0.01, None)
    assert intervals == 100
    assert intervals * steps * dt == pytest.approx(1.0, rel=1e-12)
    assert dt <= float(jaxrod.stable_dt(body.scene).dt) * (1 + 1e-5)


@pytest.mark.slow
def test_a_step_above_the_stability_bound_is_warned_about():
    with pytest.warns(jaxrod.UnstableStepWarning):
        control.reach(actuated_arm(20), TARGET, dt=1e-2)


def test_twist_is_a_third_direction():
    body = arm()
    couples = body.with_controls(jnp.ones((3, 4))).effects[-1].couples
    assert jnp.all(jnp.any(couples != 0, axis=1))
    bent = body.with_controls(jnp.ones((2, 4))).effects[-1].couples
    assert jnp.all(bent[2] == 0) and jnp.array_equal(bent[:2], couples[:2])


def test_a_target_beyond_the_arm_is_warned_about():
    words = r"1\.5 m .* 1 m long"
    with pytest.warns(control.UnreachableTargetWarning, match=words) as warned:
        short(target=(0.0, 1.5, 0.0))
    assert [one.filename for one in warned] == [__file__]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"target": (0.1, 0.2)}, r"target must have shape \(3,\)"),
        ({"duration": 0.0}, "duration must be positive, got 0 s"),
        ({"speed_weight": -1.0}, r"speed_weight must be non-negative, got -1 s\^2"),
        ({"control_interval": -1.0}, "control_interval must be positive"),
        ({"dt": 0.0}, "dt must be positive"),
        ({"lower": 1.0}, "lower must be below upper"),
    ],
)
def test_bad_problems_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        short(**settings)


def test_what_is_no_arm_is_refused():
    with pytest.raises(ValueError, match="got tuple without scene"):
        control.reach((1, 2), TARGET)


def test_bad_settings_of_solvers_are_named():
    problem = short()
    for settings, message in (
        ({"n_knots": 0}, "n_knots must be at least 1"),
        ({"ridge": -1.0}, "ridge must be non-negative"),
        ({"initial_damping": 0.0}, "initial_damping must be positive"),
        ({"initial_knots": np.zeros((2, 2))}, "initial_knots must have shape"),
        ({"mode": "central"}, "mode must be"),
    ):
        with pytest.raises(ValueError, match=message):
            control.levenberg_marquardt(problem, **settings)
    with pytest.raises(TypeError, match="problem must be"):
        control.adam(problem.data)
    with pytest.raises(ValueError, match="learning_rate must be positive"):
        control.adam(problem, learning_rate=0.0)
