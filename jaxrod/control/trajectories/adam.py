"""Trajectory optimisation by Adam, on control values at knots in time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.control.trajectories.problem import (
    Problem,
    check_problem,
    cost,
    first_knots,
    half_widths,
    over_time,
    trajectory,
)
from jaxrod.control.trajectories.solution import Solution, timed
from jaxrod.validation import check_array, check_count


def adam(
    problem: Problem,
    *,
    n_knots: int = 11,
    iterations: int = 200,
    learning_rate: float = 0.05,
    max_gradient_norm: float = 1.0,
    optimiser: Any = None,
    enough: float = 0.0,
    initial_knots: Any = None,
    seed: int = 0,
    log: Callable[[int, float], None] | None = None,
) -> Solution:
    """Finds controls, linear in time between knots, by following the cost's gradient.

    Meant for problems with many residuals, or with a cost that is not a smooth valley.
    `levenberg_marquardt` needs far fewer iterations if there are few residuals.
    Knots are scaled by the half widths of their bounds, and projected onto the bounds.
    Ctrl-C stops the search and returns the best point so far. Needs optax.

    Args:
        problem: The problem.
        n_knots: Number of knots, equally spaced in time.
        iterations: Largest number of gradient evaluations.
        learning_rate: Step size of Adam; it decays along a cosine to a tenth [1].
        max_gradient_norm: Largest norm of the gradient with respect to the scaled
            knots; longer gradients are scaled down to it.
        optimiser: An `optax.GradientTransformation` to use instead of clipped Adam.
        enough: Cost at or below which the search ends.
        initial_knots: Initial knots `(n_knots, n_controls)`; small random ones by
            default.
        seed: Seed of the small random knots.
        log: Function called with the iteration and the cost after each evaluation.

    Returns:
        The best controls found, with their motion.

    Raises:
        ValueError: An argument is out of range or has the wrong shape.
        TypeError: `problem` is not a `Problem`.

    Example:
        >>> problem = control.make_problem(
        ...     jnp.zeros(1),
        ...     lambda goal, place, push, k: place + 0.1 * push,
        ...     final=lambda goal, place: place - goal,
        ...     data=jnp.array([0.5]),
        ...     n_intervals=10, interval=0.1, n_controls=1,
        ... )
        >>> found = control.adam(problem, n_knots=2)
        >>> print(found.states[-1].round(2))
        [0.5]
    """
    check_problem(problem)
    iterations = check_count("iterations", iterations, 1)
    target = float(check_array("enough", enough, [()], "", non_negative=True))
    widths = half_widths(problem)[None]
    start = first_knots(problem, n_knots, initial_knots, seed) / widths
    if optimiser is None:
        optimiser = _clipped_adam(
            float(check_array("learning_rate", learning_rate, [()], "", positive=True)),
            float(
                check_array(
                    "max_gradient_norm", max_gradient_norm, [()], "", positive=True
                )
            ),
            iterations,
        )

    @jax.jit
    def stepped(point: Array, memory: Any, gradient: Array) -> tuple[Array, Any]:
        change, memory = optimiser.update(gradient, memory, point)
        # Projection keeps every control value within the actuators' range.
        moved = jnp.clip(
            point + change.astype(point.dtype),
            problem.lower[None] / widths,
            problem.upper[None] / widths,
        )
        return moved, memory

    memory = optimiser.init(start)
    point = best = start
    least, took = np.inf, np.zeros(2)
    rows: list[tuple[float, float]] = []
    interrupted, ending = False, f"{iterations} iterations were made"
    try:
        for iteration in range(iterations):
            (made, gradient), *seconds = timed(_valued, problem, point)
            took += seconds
            value, norm = (
                float(made),
                float(np.linalg.norm(np.asarray(gradient, float))),
            )
            rows.append((value, norm))
            if log is not None:
                log(iteration, value)
            if not np.isfinite([value, norm]).all():
                ending = "the cost or its gradient is not finite"
                break
            if value <= target or value < least:
                best, least = point, value
            if value <= target:
                break
            if iteration + 1 < iterations:
                point, memory = stepped(point, memory, gradient)
    except KeyboardInterrupt:
        if not rows:
            raise
        interrupted, ending = True, "it was interrupted"
    (knots, controls, states, final), compile_s, _ = timed(_recorded, problem, best)
    converged = least <= target
    history = np.array(rows, float).T
    return Solution(
        problem=problem,
        solver="adam",
        controls=controls,
        states=states,
        cost=float(final),
        history={"cost": history[0], "gradient_norm": history[1]},
        converged=converged,
        reason=f"the cost is at most {target:g}" if converged else ending,
        iterations=len(rows),
        compile_s=took[0] + compile_s,
        run_s=float(took[1]),
        interrupted=interrupted,
        knots=knots,
    )


def _valued(problem: Problem, scaled: Array) -> tuple[Array, Array]:
    """Returns the cost and its gradient with respect to `scaled`.

    `scaled` are the knots divided by half the range between their bounds.
    """

    def value(scaled: Array) -> Array:
        knots = scaled * half_widths(problem)[None]
        return cost(problem, over_time(knots, problem.n_intervals))

    return jax.value_and_grad(value)(scaled)


def _recorded(problem: Problem, scaled: Array) -> tuple[Array, Array, Any, Array]:
    """Returns the unscaled knots, and their controls, states and cost.

    `scaled` are the knots divided by half the range between their bounds.
    """
    knots = scaled * half_widths(problem)[None]
    controls = over_time(knots, problem.n_intervals)
    return (
        knots,
        controls,
        trajectory(problem, controls),
        jnp.asarray(cost(problem, controls)),
    )


def _clipped_adam(
    learning_rate: float, max_gradient_norm: float, iterations: int
) -> Any:
    """Optax optimiser: Adam on gradients of clipped norm, with cosine decay to 1/10.

    The step size decays from `learning_rate` to a tenth over `iterations`.
    """
    import optax

    schedule = optax.cosine_decay_schedule(learning_rate, iterations, alpha=0.1)
    return optax.chain(
        optax.clip_by_global_norm(max_gradient_norm), optax.adam(schedule)
    )
