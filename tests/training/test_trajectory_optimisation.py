"""Trajectory optimisation: gradients are right, targets reached, failures told."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
import jaxrod.training.trajectory.optimise as module
from jaxrod.control.reach import time_steps
from jaxrod.training import (
    ActuatedArm,
    UnreachableTargetWarning,
    actuated_arm,
    optimise_trajectory,
)
from jaxrod.training.trajectory.cost import (
    controls_over_time,
    cost_and_gradient,
    trajectory_cost,
)

REST_TIP = np.array([0.0, 1.0, 0.0])
TARGET = np.array([0.4, 0.6, 0.2])
# All tests of one precision share one compiled program: same counts everywhere.
N_ELEMENTS = 6


@pytest.fixture(
    scope="module",
    params=["float64", pytest.param("float32", marks=pytest.mark.slow)],
)
def found(request):
    with jax.enable_x64(True):
        arm = actuated_arm(N_ELEMENTS, dtype=request.param)
        return optimise_trajectory(TARGET, arm, progress=False)


@pytest.fixture(scope="module")
def problem(found):
    return found.problem


def optimise(found, target=TARGET, **settings):
    """Runs on the arm whose program is compiled already."""
    return optimise_trajectory(target, found.problem.arm, progress=False, **settings)


def test_the_tip_is_brought_within_a_centimetre_over_60_cm(found):
    assert np.linalg.norm(TARGET - REST_TIP) == pytest.approx(0.6)
    assert found.tip_distance < 0.01
    assert found.iterations <= 100
    assert found.success and found.reason == "converged"


def test_the_recorded_motion_is_the_one_that_was_reported(found):
    tip = np.asarray(found.states.positions[-1, :, -1], float)
    assert np.linalg.norm(tip - TARGET) == pytest.approx(found.tip_distance, abs=1e-7)
    assert found.history.tip_distance[-1] == pytest.approx(found.tip_distance, abs=1e-5)
    assert found.times[0] == 0 and found.times[-1] == 1.0
    assert found.times.shape == (found.states.positions.shape[0],)
    assert np.allclose(found.tip_positions[0], REST_TIP, atol=1e-6)


def test_the_history_has_one_row_per_gradient_step(found):
    for column in vars(found.history).values():
        assert column.shape == (found.iterations,)
        assert np.isfinite(column).all()
    assert np.all(np.diff(found.history.wall_s) >= 0)
    assert found.history.wall_s[0] == found.compile_s <= found.wall_s


def test_the_result_keeps_the_precision_of_the_arm(found):
    dtype = found.problem.arm.state.positions.dtype
    assert found.knots.dtype == found.states.positions.dtype == dtype


@pytest.mark.slow
def test_another_target_and_other_settings_do_not_compile_again(found):
    before = cost_and_gradient._cache_size()
    optimise(
        found,
        (0.0, 0.5, 0.3),
        iterations=2,
        effort_weight=0.1,
        speed_weight=0.2,
        running_weight=0.3,
        learning_rate=0.01,
    )
    assert cost_and_gradient._cache_size() == before


def test_the_gradient_agrees_with_finite_differences_after_one_second(found):
    if found.knots.dtype == jnp.float64:
        assert_gradient_is_right(found.problem, 1e-6)
    else:
        assert_gradient_is_right(found.problem, 0.02, change=0.01)


@pytest.mark.slow
def test_the_gradient_of_the_fine_arm_agrees_with_finite_differences():
    arm = actuated_arm(20)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnreachableTargetWarning)
        found = optimise_trajectory(TARGET, arm, iterations=1, progress=False)
    assert_gradient_is_right(found.problem, 1e-5)


def assert_gradient_is_right(problem, tolerance, change=1e-5):
    """Compares directional derivatives, the arm in full motion."""
    keys = jax.random.split(jax.random.key(1), 4)
    shape = (11, 2, 6)
    dtype = problem.arm.state.positions.dtype
    knots = 0.1 * jax.random.normal(keys[0], shape, dtype)
    _, gradient = cost_and_gradient(problem, knots)
    loss = jax.jit(lambda k: trajectory_cost(problem, k).loss)
    for key in keys[1:]:
        direction = jax.random.normal(key, shape, dtype)
        further, back = (loss(knots + h * direction) for h in (change, -change))
        expected = float(jnp.sum(gradient * direction))
        found = float(further - back) / (2 * change)
        assert found == pytest.approx(expected, rel=tolerance)


@pytest.mark.slow
def test_the_gradient_of_1000_steps_needs_less_than_5_megabytes():
    arm = actuated_arm(20)
    found = optimise_trajectory(
        TARGET,
        arm,
        duration=0.3,
        control_interval=0.006,
        dt=3.001e-4,
        iterations=1,
        progress=False,
    )
    problem = found.problem
    assert problem.n_intervals * problem.steps_per_interval == 1000
    compiled = cost_and_gradient.lower(problem, found.knots).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 5e6


def test_knots_stay_within_what_muscles_can_do(found):
    result = optimise(found, iterations=5, learning_rate=10.0)
    assert float(jnp.max(jnp.abs(result.knots))) <= 1.0


def test_without_convergence_the_best_iterate_is_returned(found):
    result = optimise(found, iterations=8, tolerance=1e-9, learning_rate=0.3)
    assert result.reason == "max iterations" and not result.success
    assert result.iterations == 8
    best = int(np.argmin(result.history.loss))
    assert result.tip_distance == pytest.approx(
        result.history.tip_distance[best], abs=1e-5
    )


def test_a_tip_that_is_too_fast_has_not_arrived(found):
    result = optimise(
        found, initial_knots=found.knots, iterations=1, speed_tolerance=1e-6
    )
    assert result.tip_distance < 0.005 and not result.success
    settled = optimise(
        found, initial_knots=found.knots, iterations=1, speed_tolerance=100.0
    )
    assert settled.success and settled.reason == "converged"


def test_starting_from_a_solution_ends_at_once(found):
    again = optimise(found, initial_knots=found.knots)
    assert again.iterations == 1 and again.reason == "converged"


def test_a_target_on_the_axis_does_not_trap_the_straight_arm(found):
    result = optimise(found, (0.0, 0.4, 0.0), iterations=40)
    distance = result.history.tip_distance
    assert distance.min() < 0.8 * distance[0]


def test_an_optimiser_of_ones_own_is_used(found):
    optax = pytest.importorskip("optax")
    result = optimise(found, iterations=3, optimiser=optax.sgd(0.0))
    assert np.ptp(result.history.loss) == 0


def test_ctrl_c_returns_the_best_so_far(found, monkeypatch):
    calls = []

    def third_time(problem, knots):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return cost_and_gradient(problem, knots)

    monkeypatch.setattr(module, "cost_and_gradient", third_time)
    result = optimise(found)
    assert result.reason == "interrupted" and result.iterations == 2
    assert np.isfinite(result.tip_distance)


def test_ctrl_c_before_there_is_anything_to_return_is_raised(found, monkeypatch):
    def at_once(problem, knots):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "cost_and_gradient", at_once)
    with pytest.raises(KeyboardInterrupt):
        optimise(found)


def test_a_loss_that_is_not_finite_stops_and_keeps_what_was_good(found, monkeypatch):
    calls = []

    def bad_from_the_third(problem, knots):
        calls.append(1)
        cost, gradient = cost_and_gradient(problem, knots)
        return cost, gradient * (jnp.nan if len(calls) == 3 else 1.0)

    monkeypatch.setattr(module, "cost_and_gradient", bad_from_the_third)
    result = optimise(found)
    assert result.reason == "not finite" and result.iterations == 3
    assert jnp.all(jnp.isfinite(result.knots)) and np.isfinite(result.tip_distance)


def test_a_target_beyond_the_arm_is_warned_about(found):
    with pytest.warns(UnreachableTargetWarning, match=r"1\.5 m .* 1 m long"):
        optimise(found, (0.0, 1.5, 0.0), iterations=1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"target": (0.1, 0.2)}, r"target must have shape \(3,\)"),
        ({"target": (0.1, np.nan, 0.2)}, "target must be finite, got nan m"),
        ({"duration": 0.0}, "duration must be positive, got 0 s"),
        ({"dt": -1e-4}, "dt must be positive, got -0.0001 s"),
        ({"control_interval": 0.0}, "control_interval must be positive, got 0 s"),
        ({"tolerance": 0.0}, "tolerance must be positive, got 0 m"),
        ({"speed_tolerance": -1.0}, "speed_tolerance must be positive, got -1 m/s"),
        ({"speed_weight": -1.0}, r"speed_weight must be non-negative, got -1 s\^2"),
        ({"learning_rate": 0.0}, "learning_rate must be positive, got 0"),
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"n_knots": 1}, "n_knots must be at least 2, got 1"),
        ({"directions": 1}, r"directions must be 2 .* got 1"),
        ({"initial_knots": np.zeros((3, 2, 6))}, r"initial_knots must have shape"),
        ({"initial_knots": np.full((11, 2, 6), 2.0)}, r"initial_knots .* got 2"),
        ({"arm": jaxrod}, "arm must be a jaxrod.training.ActuatedArm, got module"),
    ],
)
def test_bad_arguments_are_named_with_value_and_unit(settings, message):
    arm = settings.pop("arm", None) or actuated_arm(N_ELEMENTS)
    with pytest.raises(ValueError, match=message):
        optimise_trajectory(
            settings.pop("target", TARGET), arm, progress=False, **settings
        )


def test_knots_are_joined_by_straight_lines():
    knots = jnp.arange(3.0)[:, None, None] * jnp.ones((3, 2, 2))
    values = controls_over_time(knots, 4)
    assert values.shape == (4, 2, 2)
    assert np.allclose(values[:, 0, 0], [0.25, 0.75, 1.25, 1.75], atol=1e-12)


def test_time_is_cut_into_whole_intervals_of_whole_stable_steps():
    arm = actuated_arm(N_ELEMENTS)
    intervals, steps, dt = time_steps(arm, 1.0, 0.01, None)
    assert intervals == 100
    assert intervals * steps * dt == pytest.approx(1.0, rel=1e-12)
    assert dt <= float(jaxrod.stable_dt(arm.scene).dt) * (1 + 1e-5)


def test_a_step_above_the_stability_bound_is_warned_about():
    arm = actuated_arm(20)
    with (
        pytest.warns(jaxrod.UnstableStepWarning),
        pytest.raises(ValueError, match="n_knots"),
    ):
        optimise_trajectory(TARGET, arm, dt=1e-2, n_knots=0, progress=False)


def test_twist_is_a_third_direction():
    arm = actuated_arm(N_ELEMENTS)
    scene = arm.with_controls(jnp.ones((3, 6)))
    couples = scene.effects[-1].couples
    assert jnp.all(jnp.any(couples != 0, axis=1))
    bent = arm.with_controls(jnp.ones((2, 6))).effects[-1].couples
    assert jnp.all(bent[2] == 0) and jnp.array_equal(bent[:2], couples[:2])


def test_any_scene_can_be_given_muscles():
    rod, state = jaxrod.straight_rod(
        4, length=0.3, radius=0.01, density=900.0, youngs_modulus=1e6
    )
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
    spline = jaxrod.control_spline(2, 0.3)
    arm = ActuatedArm(scene, state, spline, jnp.asarray(1.0))
    moved = jaxrod.advance(arm.with_controls(jnp.ones((2, 2))), state, 1e-5, 10)
    assert jnp.all(jnp.isfinite(moved.positions))


def test_the_replay_shows_the_motion_and_the_target(found):
    replay = found.replay("reach")
    assert replay.num_frames == len(found.times)
    assert np.allclose(replay.spheres[0].positions[-1], TARGET)
    assert replay.readouts["distance [m]"][-1] == pytest.approx(
        found.tip_distance, abs=1e-6
    )


def test_progress_tells_compiling_apart_and_what_is_reached(found, capsys):
    optimise_trajectory(TARGET, found.problem.arm, iterations=3, tolerance=1e-9)
    first, *bars, last = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"ready after [0-9.]+ s \(the first call compiles\)", first)
    assert ["2/3 steps" in bars[0], "3/3 steps" in bars[1], len(bars)] == [
        True,
        True,
        2,
    ]
    assert "0:00 left" in bars[1]
    assert re.search(r"tip [0-9.]+ mm from target$", bars[1])
    assert last.startswith("max iterations after 3 gradient steps")
