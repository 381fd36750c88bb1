"""Trajectory optimisation: muscle activity by gradients through the simulation.

Three lines make an arm reach for a point and show it:

    result = optimise_trajectory(target=(0.4, 0.6, 0.2))
    print(result.tip_distance, result.reason)
    result.replay()
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from jaxrod.control.arm import ActuatedArm
from jaxrod.control.descent import clipped_adam, follow_gradient
from jaxrod.control.reach import on_the_way, reach_problem
from jaxrod.training.progress import ProgressBar
from jaxrod.training.settings import LARGEST_COUNT
from jaxrod.training.trajectory.actuated_arm import actuated_arm
from jaxrod.training.trajectory.cost import (
    TrajectoryCost,
    TrajectoryProblem,
    controls_over_time,
    cost_and_gradient,
    record_trajectory,
)
from jaxrod.training.trajectory.result import (
    TrajectoryHistory,
    TrajectoryResult,
)
from jaxrod.validation import Numbers, check_array, check_count

# Breaks the symmetry of a straight arm, for which the gradient may vanish exactly.
_INITIAL_SPREAD = 1e-3


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
    if directions not in (2, 3):
        raise ValueError(
            f"directions must be 2 (bending) or 3 (with twist), got {directions!r}"
        )
    control = reach_problem(
        arm,
        target,
        duration,
        weights=(speed_weight, running_weight, effort_weight),
        control_interval=control_interval,
        dt=dt,
        control_shape=(directions, arm.spline.n_controls),
        bounds=(-1.0, 1.0),
        depth=1,
    )
    # With residuals on the way also where they weigh nothing: one program for all.
    problem = TrajectoryProblem(dataclasses.replace(control, running=on_the_way))
    knots = _first_knots(arm, n_knots, directions, initial_knots, seed)
    if optimiser is None:
        optimiser = clipped_adam(
            _positive("learning_rate", learning_rate, ""),
            _positive("max_gradient_norm", max_gradient_norm, "m^2"),
            iterations,
        )

    bar = ProgressBar(iterations, "steps", done=1, enabled=progress)
    rows: list[tuple[float, ...]] = []

    def evaluated(knots: Array) -> tuple[Array, TrajectoryCost, Array]:
        cost, gradient = cost_and_gradient(problem, knots)
        return cost.loss, cost, gradient

    def seen(iteration: int, loss: float, norm: float, cost: TrajectoryCost) -> bool:
        distance, speed = float(cost.tip_distance), float(cost.tip_speed)
        rows.append((loss, distance, speed, norm, time.monotonic() - began))
        if iteration == 0:
            bar.restart()
            bar.message(f"ready after {rows[0][-1]:.1f} s (the first call compiles)")
        reached = f"loss {loss:.2e}  tip {1e3 * distance:.1f} mm from target"
        bar.update(iteration + 1, reached)
        arrived = distance <= limit
        return arrived and (speed_tolerance is None or speed <= speed_tolerance)

    best, reason = follow_gradient(evaluated, seen, knots, optimiser, iterations)
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
        compile_s=rows[0][-1],
        wall_s=time.monotonic() - began,
    )
    bar.message(
        f"{reason} after {result.iterations} gradient steps and "
        f"{result.wall_s:.1f} s: tip {1000 * distance:.1f} mm from the target"
    )
    return result


def _first_knots(
    arm: ActuatedArm, n_knots: int, directions: int, given: Any, seed: int
) -> Array:
    n_knots = check_count("n_knots", n_knots, 2)
    if n_knots > LARGEST_COUNT:
        raise ValueError(f"n_knots must be at most {LARGEST_COUNT}, got {n_knots}")
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


def _positive(name: str, value: float, unit: str) -> float:
    return float(check_array(name, value, [()], unit, positive=True))
