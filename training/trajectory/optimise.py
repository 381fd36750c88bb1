"""Trajectory optimisation: muscle activity by gradients through the simulation.

Three lines make an arm reach for a point and show it:

    result = optimise_trajectory(target=(0.4, 0.6, 0.2))
    print(result.tip_distance, result.reason)
    result.replay()
"""

from __future__ import annotations

import time
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from jaxrod.stepping.checks import check_step
from jaxrod.training.progress import ProgressBar
from jaxrod.training.settings import LARGEST_COUNT
from jaxrod.training.trajectory.actuated_arm import ActuatedArm, actuated_arm
from jaxrod.training.trajectory.cost import (
    TrajectoryProblem,
    controls_over_time,
    cost_and_gradient,
    record_trajectory,
    time_steps,
)
from jaxrod.training.trajectory.result import (
    Reason,
    TrajectoryHistory,
    TrajectoryResult,
)
from jaxrod.validation import Numbers, check_array, check_count

# Breaks the symmetry of a straight arm, for which the gradient may vanish exactly.
_INITIAL_SPREAD = 1e-3


class UnreachableTargetWarning(UserWarning):
    """The target lies further from the arm's base than the arm is long."""


def optimise_trajectory(
    target: Numbers,
    arm: ActuatedArm | None = None,
    *,
    duration: float = 1.0,
    n_knots: int = 11,
    directions: int = 2,
    iterations: int = 100,
    tolerance: float = 0.005,
    speed_tolerance: float | None = None,
    learning_rate: float = 0.05,
    max_gradient_norm: float = 1.0,
    optimiser: optax.GradientTransformation | None = None,
    speed_weight: float = 1e-3,
    running_weight: float = 0.0,
    effort_weight: float = 1e-5,
    initial_knots: Any = None,
    seed: int = 0,
    control_interval: float = 0.01,
    dt: float | None = None,
    progress: bool = True,
) -> TrajectoryResult:
    """Finds muscle activity that brings the tip of an arm to a target.

    Follows the gradient of `trajectory_cost.trajectory_cost` with respect to spline
    control values at equally spaced times, kept in [-1, 1] by projection. Ctrl-C
    stops it and returns the best so far.

    Args:
        target: Where the tip should be at the end `(3,)` [m].
        arm: The arm; the benchmark's (`actuated_arm()`) if None.
        duration: Time from start to end [s].
        n_knots: Knots in time, at least 2.
        directions: 2 bends about d1 and d2; 3 also twists about d3.
        iterations: The most gradient steps.
        tolerance: Stop when the tip ends this close to the target [m].
        speed_tolerance: ... and is at most this fast [m/s]; None for any speed.
        learning_rate: Of Adam, per step, decaying along a cosine to a tenth [1].
        max_gradient_norm: Gradients are shortened to this norm [m^2].
        optimiser: Used instead of clipped Adam.
        speed_weight: Cost of the squared speed of the tip at the end [s^2].
        running_weight: Cost of the mean squared distance over time [1].
        effort_weight: Cost of the mean squared control value [m^2].
        initial_knots: Where to start `(n_knots, directions, n_controls)`; small
            random values if None.
        seed: Of the small random values.
        control_interval: For how long control values are held, at most [s].
        dt: Largest step of the simulation [s]; 0.8 of the stable one if None. Both
            are shortened so that whole numbers of them fit.
        progress: Whether to show progress on stderr.

    Returns:
        The best trajectory and how it was found. If nothing within the tolerances
        was found it is the one with the lowest loss, and `success` is False.

    Raises:
        ValueError: If an argument is out of range or does not fit.
        KeyboardInterrupt: If interrupted before the first evaluation was done.

    Warns:
        UnreachableTargetWarning: If the target is further from the base of the arm
            than the arm is long.
        jaxrod.UnstableStepWarning: If `dt` is above the stability bound.
    """
    began = time.monotonic()
    arm = actuated_arm() if arm is None else arm
    if not isinstance(arm, ActuatedArm):
        raise ValueError(
            f"arm must be a jaxrod.training.ActuatedArm, got {type(arm).__name__}"
        )
    iterations = check_count("iterations", iterations, 1)
    limit = _positive("tolerance", tolerance, "m")
    if speed_tolerance is not None:
        _positive("speed_tolerance", speed_tolerance, "m/s")
    problem = _problem(
        arm,
        target,
        duration=_positive("duration", duration, "s"),
        control_interval=_positive("control_interval", control_interval, "s"),
        dt=None if dt is None else _positive("dt", dt, "s"),
        weights=(
            _weight("speed_weight", speed_weight, "s^2"),
            _weight("running_weight", running_weight, ""),
            _weight("effort_weight", effort_weight, "m^2"),
        ),
    )
    knots = _first_knots(arm, n_knots, directions, initial_knots, seed)
    if optimiser is None:
        optimiser = _clipped_adam(
            _positive("learning_rate", learning_rate, ""),
            _positive("max_gradient_norm", max_gradient_norm, "m^2"),
            iterations,
        )
    update = jax.jit(_updater(optimiser))
    memory = optimiser.init(knots)

    bar = ProgressBar(iterations, "steps", done=1, enabled=progress)
    rows: list[tuple[float, ...]] = []
    best, best_loss = knots, np.inf
    reason: Reason = "max iterations"
    compile_s = 0.0
    try:
        for iteration in range(iterations):
            cost, gradient = cost_and_gradient(problem, knots)
            loss, distance, speed, norm = (
                float(number)
                for number in (
                    cost.loss,
                    cost.tip_distance,
                    cost.tip_speed,
                    np.linalg.norm(np.asarray(gradient, float)),
                )
            )
            rows.append((loss, distance, speed, norm, time.monotonic() - began))
            if iteration == 0:
                compile_s = rows[0][-1]
                bar.restart()
                bar.message(f"ready after {compile_s:.1f} s (the first call compiles)")
            reached = f"loss {loss:.2e}  tip {1e3 * distance:.1f} mm from target"
            bar.update(iteration + 1, reached)
            if not np.isfinite([loss, norm]).all():
                reason = "not finite"
                break
            arrived = distance <= limit
            if speed_tolerance is not None:
                arrived = arrived and speed <= speed_tolerance
            if arrived or loss < best_loss:
                best, best_loss = knots, loss
            if arrived:
                reason = "converged"
                break
            if iteration + 1 < iterations:
                knots, memory = update(knots, memory, gradient)
    except KeyboardInterrupt:
        if not rows:
            raise
        reason = "interrupted"

    states = record_trajectory(problem, best)
    offset = np.asarray(states.positions[-1, :, -1] - problem.target, float)
    distance = float(np.linalg.norm(offset))
    speed = float(np.linalg.norm(np.asarray(states.velocities[-1, :, -1], float)))
    success = distance <= limit
    if speed_tolerance is not None:
        success = success and speed <= speed_tolerance
    result = TrajectoryResult(
        knots=best,
        knot_times=np.linspace(0.0, duration, best.shape[0]),
        controls=controls_over_time(best, problem.n_intervals),
        times=np.linspace(0.0, duration, problem.n_intervals + 1),
        states=states,
        tip_distance=distance,
        tip_speed=speed,
        success=success,
        reason=reason,
        iterations=len(rows),
        history=TrajectoryHistory(*np.array(rows, float).T),
        problem=problem,
        compile_s=compile_s,
        wall_s=time.monotonic() - began,
    )
    bar.message(
        f"{reason} after {result.iterations} gradient steps and "
        f"{result.wall_s:.1f} s: tip {1000 * distance:.1f} mm from the target"
    )
    return result


def _problem(
    arm: ActuatedArm,
    target: Numbers,
    *,
    duration: float,
    control_interval: float,
    dt: float | None,
    weights: tuple[float, float, float],
) -> TrajectoryProblem:
    place = check_array("target", target, [(3,)], "m")
    base = np.asarray(arm.state.positions[:, 0], float)
    away, length = float(np.linalg.norm(place - base)), float(arm.scene.rod.length)
    if away > length * (1 + 1e-6):
        warnings.warn(
            f"target is {away:.3g} m from the arm's base and the arm is {length:.3g} m "
            "long: it will only be approached",
            UnreachableTargetWarning,
            stacklevel=3,
        )
    n_intervals, steps, step = time_steps(arm, duration, control_interval, dt)
    kind = arm.state.positions.dtype
    check_step(arm.scene, jnp.asarray(step, kind))
    speed, running, effort = (jnp.asarray(weight, kind) for weight in weights)
    return TrajectoryProblem(
        arm=arm,
        target=jnp.asarray(place, kind),
        dt=jnp.asarray(step, kind),
        speed_weight=speed,
        running_weight=running,
        effort_weight=effort,
        n_intervals=n_intervals,
        steps_per_interval=steps,
    )


def _first_knots(
    arm: ActuatedArm, n_knots: int, directions: int, given: Any, seed: int
) -> Array:
    n_knots = check_count("n_knots", n_knots, 2)
    if n_knots > LARGEST_COUNT:
        raise ValueError(f"n_knots must be at most {LARGEST_COUNT}, got {n_knots}")
    if directions not in (2, 3):
        raise ValueError(
            f"directions must be 2 (bending) or 3 (with twist), got {directions!r}"
        )
    shape = (n_knots, directions, arm.spline.n_controls)
    kind = arm.state.positions.dtype
    if given is None:
        return _INITIAL_SPREAD * jax.random.normal(jax.random.key(seed), shape, kind)
    knots = check_array("initial_knots", given, [shape], "")
    if np.max(np.abs(knots)) > 1:
        raise ValueError(
            f"initial_knots must be in [-1, 1], got {np.max(np.abs(knots)):g}"
        )
    return jnp.asarray(knots, kind)


def _clipped_adam(
    learning_rate: float, max_gradient_norm: float, iterations: int
) -> optax.GradientTransformation:
    schedule = optax.cosine_decay_schedule(learning_rate, iterations, alpha=0.1)
    return optax.chain(
        optax.clip_by_global_norm(max_gradient_norm), optax.adam(schedule)
    )


def _updater(optimiser: optax.GradientTransformation) -> Any:
    def update(knots: Array, memory: Any, gradient: Array) -> tuple[Array, Any]:
        change, memory = optimiser.update(gradient, memory, knots)
        # Projection keeps every control value one the muscles can follow.
        moved = jnp.clip(knots + change.astype(knots.dtype), -1.0, 1.0)
        return moved, memory

    return update


def _positive(name: str, value: float, unit: str) -> float:
    return float(check_array(name, value, [()], unit, positive=True))


def _weight(name: str, value: float, unit: str) -> float:
    return float(check_array(name, value, [()], unit, non_negative=True))
