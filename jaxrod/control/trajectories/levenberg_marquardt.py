"""Trajectories by damped Gauss-Newton steps on knots in time."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.control.least_squares import LeastSquares, least_squares
from jaxrod.control.trajectories.problem import (
    Problem,
    check_problem,
    first_knots,
    over_time,
    residuals,
    trajectory,
)
from jaxrod.control.trajectories.programs import timed
from jaxrod.control.trajectories.solution import Solution
from jaxrod.validation import check_array, check_count


def levenberg_marquardt(
    problem: Problem,
    *,
    n_knots: int = 11,
    iterations: int = 20,
    ridge: float = 1e-5,
    damping: float = 1.0,
    tolerance: float | None = None,
    initial_knots: Any = None,
    seed: int = 0,
    mode: str | None = None,
) -> Solution:
    """Finds controls, linear in time between knots, that minimise the sum of squares.

    Meant for problems with few residuals, such as `reach`. The Jacobian takes a row for
    each residual in reverse mode, or a column for each knot value in forward mode,
    whichever is fewer. The ridge adds to neither.

    Args:
        problem: The problem.
        n_knots: Knots in time, equally spaced.
        iterations: Largest number of iterations.
        ridge: Weight of the mean squared knot value; it selects one of the many
            controls with the same result.
        damping: Damping of the first step, as a fraction of the diagonal [1].
        tolerance: Relative change at which the search ends; by default machine epsilon
            to the power of 3/4.
        initial_knots: First knots `(n_knots, n_controls)`; small random ones by
            default.
        seed: Seed of the small random knots.
        mode: Mode of differentiation for Jacobians, `"forward"` or `"reverse"`; chosen
            automatically if `None`.

    Returns:
        The best controls found, with their motion.

    Raises:
        ValueError: An argument is out of range or does not fit.
        TypeError: `problem` is not a `Problem`.
    """
    check_problem(problem)
    knots = first_knots(problem, n_knots, initial_knots, seed)
    numbers = {
        "ridge": check_array("ridge", ridge, [()], "", non_negative=True),
        "damping": check_array("damping", damping, [()], "", positive=True),
    }
    (found, controls, states, least), compile_s, run_s = timed(
        _solved,
        problem,
        knots,
        {name: jnp.asarray(n, knots.dtype) for name, n in numbers.items()},
        iterations=check_count("iterations", iterations, 1),
        tolerance=tolerance,
        mode=mode,
    )
    tried = int(found.iterations)
    if bool(found.converged):
        reason = "a step changes the cost, or the knots, by less than asked"
    elif tried >= iterations:
        reason = f"{iterations} iterations were made"
    else:
        reason = "no step makes the cost smaller"
    return Solution(
        problem=problem,
        solver="levenberg_marquardt",
        controls=controls,
        states=states,
        cost=float(least),
        history={"cost": np.asarray(found.costs)[: tried + 1]},
        converged=bool(found.converged),
        reason=reason,
        iterations=tried,
        compile_s=compile_s,
        run_s=run_s,
        knots=found.solution,
    )


def _solved(
    problem: Problem,
    knots: Array,
    numbers: dict[str, Array],
    *,
    iterations: int,
    tolerance: float | None,
    mode: str | None,
) -> tuple[LeastSquares, Array, Any, Array]:
    """Returns the solution, its controls, its motion and its cost."""
    found = least_squares(
        lambda z: residuals(problem, over_time(z, problem.n_intervals)),
        knots,
        lower=jnp.broadcast_to(problem.lower, knots.shape),
        upper=jnp.broadcast_to(problem.upper, knots.shape),
        ridge=numbers["ridge"] / knots.size,
        centre=0.0,
        damping=numbers["damping"],
        iterations=iterations,
        tolerance=tolerance,
        mode=mode,
        several=True,
    )
    controls = over_time(found.solution, problem.n_intervals)
    # The sum of squared residuals, without the ridge.
    least = jnp.sum(found.residuals**2)
    return found, controls, trajectory(problem, controls), least
