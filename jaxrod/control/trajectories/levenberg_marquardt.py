"""Optimises controls, alone or with a body's design, by damped Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.control.least_squares import LeastSquares, broadcast_like, least_squares
from jaxrod.control.trajectories.problem import (
    Problem,
    check_problem,
    first_knots,
    over_time,
    residuals,
    trajectory,
)
from jaxrod.control.trajectories.solution import Solution, reason_to_stop, timed
from jaxrod.validation import check_array, check_count

Body = Callable[[Any, Any], Any]
"""`(data, design) -> data`: the problem's data for a body of that design."""


def levenberg_marquardt(
    problem: Problem,
    *,
    n_knots: int = 11,
    iterations: int = 20,
    ridge: float = 1e-5,
    initial_damping: float = 1.0,
    tolerance: float | None = None,
    initial_knots: Any = None,
    seed: int = 0,
    mode: str | None = None,
) -> Solution:
    """Finds controls, linear in time between knots, that minimise the cost.

    Meant for problems with few residuals, such as `reach`. The Jacobian takes a row for
    each residual in reverse mode, or a column for each knot value in forward mode,
    whichever is fewer. The ridge adds no rows or columns.

    Args:
        problem: The problem.
        n_knots: Number of knots, equally spaced in time.
        iterations: Largest number of iterations.
        ridge: Weight of the mean squared knot value; it selects one of the many
            controls with the same result.
        initial_damping: Damping of the first step, relative to the diagonal of
            $J^T J$, where $J$ is the Jacobian of the residuals [1].
        tolerance: Relative change at which the search ends; by default machine epsilon
            to the power of 3/4.
        initial_knots: Initial knots `(n_knots, n_controls)`; small random ones by
            default.
        seed: Seed of the small random knots.
        mode: Mode of differentiation for Jacobians, `"forward"` or `"reverse"`; chosen
            automatically if `None`.

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
        >>> found = control.levenberg_marquardt(problem, n_knots=2)
        >>> print(found.states[-1].round(3))
        [0.5]
    """
    check_problem(problem)
    check_array("ridge", ridge, [()], "", non_negative=True)
    return _found(
        "levenberg_marquardt",
        problem,
        first_knots(problem, n_knots, initial_knots, seed),
        {"ridge": ridge, "initial_damping": initial_damping},
        iterations=iterations,
        tolerance=tolerance,
        mode=mode,
        several=True,
    )


def codesign(
    problem: Problem,
    body: Body,
    design: Any,
    *,
    n_knots: int = 11,
    iterations: int = 30,
    ridge: float = 1e-4,
    lower: Any = None,
    upper: Any = None,
    initial_damping: float = 1.0,
    initial_knots: Any = None,
    seed: int = 0,
) -> Solution:
    """Finds the design of a body, and its controls, that minimise the cost.

    It applies the method of `levenberg_marquardt` to both together. The simulation's
    time step is that of the problem: the bounds of the design must keep the body stable
    with it.

    Args:
        problem: The problem; all bodies start from its initial state.
        body: `(data, design) -> data`, defined at module level; pure and
            differentiable.
        design: Initial design, any pytree of floats.
        n_knots: Number of knots, equally spaced in time.
        iterations: Largest number of iterations.
        ridge: Weight of the mean squared knot value: the effort.
        lower: Lower bounds of the design, a number or a tree like `design`.
        upper: Upper bounds of the design, a number or a tree like `design`.
        initial_damping: Damping of the first step, relative to the diagonal of
            $J^T J$, where $J$ is the Jacobian of the residuals [1].
        initial_knots: Initial knots `(n_knots, n_controls)`; small random ones by
            default.
        seed: Seed of the small random knots.

    Returns:
        The best pair: `design` is the body's design, and `problem` has its data.

    Raises:
        ValueError: An argument is out of range or has the wrong shape.
        TypeError: `problem` is not a `Problem`.

    Example:
        >>> problem = control.make_problem(
        ...     jnp.zeros(1),
        ...     lambda body, place, push, k: place + 0.1 * body["gain"] * push,
        ...     final=lambda body, place: place - body["goal"],
        ...     data={"gain": jnp.array(1.0), "goal": jnp.array([2.0])},
        ...     n_intervals=10, interval=0.1, n_controls=1,
        ... )
        >>> found = control.codesign(  # |push| <= 1: too far for a gain of 1
        ...     problem, lambda body, gain: {**body, "gain": gain}, jnp.array(1.0)
        ... )
        >>> print(found.states[-1].round(1), found.design > 1.9)
        [2.] True
    """
    check_problem(problem)
    knots = first_knots(problem, n_knots, initial_knots, seed)
    check_array("ridge", ridge, [()], "", positive=True)
    floats = partial(jax.tree.map, lambda leaf: jnp.asarray(leaf, knots.dtype))
    begin = floats(design)
    if not jax.tree.leaves(begin):
        raise ValueError("design must have at least one number")
    return _found(
        "codesign",
        problem,
        knots,
        {"ridge": ridge, "initial_damping": initial_damping},
        begin,
        (
            floats(broadcast_like(lower, begin, -1)),
            floats(broadcast_like(upper, begin, 1)),
        ),
        body=body,
        iterations=iterations,
    )


def _found(
    solver: str,
    problem: Problem,
    knots: Array,
    numbers: dict[str, float],
    design: Any = None,
    bounds: tuple[Any, ...] = (None, None),
    *,
    iterations: int,
    **structure: Any,
) -> Solution:
    """Optimises knots and, if there is one, a design, and makes the `Solution`.

    `numbers` holds the ridge and the initial damping, `bounds` the bounds of the
    design, and `structure` further static arguments of `_solved`.
    """
    check_array("initial_damping", numbers["initial_damping"], [()], "", positive=True)
    (found, controls, states, least, data), compile_s, run_s = timed(
        _solved,
        problem,
        {"design": design, "knots": knots},
        {name: jnp.asarray(n, knots.dtype) for name, n in numbers.items()},
        bounds,
        iterations=check_count("iterations", iterations, 1),
        **structure,
    )
    tried, converged = int(found.iterations), bool(found.converged)
    gained = "a step changes the cost, or the unknowns, by less than asked"
    return Solution(
        problem=replace(problem, data=data),
        solver=solver,
        controls=controls,
        states=states,
        cost=float(least),
        history={"cost": np.asarray(found.costs)[: tried + 1]},
        converged=converged,
        reason=reason_to_stop(converged, tried, iterations, gained),
        iterations=tried,
        compile_s=compile_s,
        run_s=run_s,
        knots=found.solution["knots"],
        design=found.solution["design"],
    )


def _solved(
    problem: Problem,
    start: dict[str, Any],
    numbers: dict[str, Array],
    bounds: tuple[Any, Any],
    *,
    iterations: int,
    body: Body | None = None,
    tolerance: float | None = None,
    mode: str | None = None,
    several: bool = False,
) -> tuple[LeastSquares, Array, Any, Array, Any]:
    """Minimises the cost of a problem; returns the result and values at the best point.

    The values are controls, states, cost without the ridge, and data of the problem.
    `start` has the initial `"knots"` and `"design"`, `bounds` are the bounds of the
    design, and `numbers` are `"ridge"` and `"initial_damping"`. The other arguments
    are those of `least_squares` and `codesign`.
    """
    knots = start["knots"]
    low, high = (
        {"design": bound, "knots": jnp.broadcast_to(limit, knots.shape)}
        for bound, limit in zip(bounds, (problem.lower, problem.upper), strict=True)
    )

    def of_body(design: Any) -> Problem:
        if body is None:
            return problem
        return replace(problem, data=body(problem.data, design))

    # The ridge does not act on the design.
    free = jax.tree.map(jnp.zeros_like, start["design"])
    effort = jnp.full(knots.shape, numbers["ridge"] / knots.size)
    found = least_squares(
        lambda z: residuals(
            of_body(z["design"]), over_time(z["knots"], problem.n_intervals)
        ),
        start,
        lower=low,
        upper=high,
        ridge={"design": free, "knots": effort},
        centre=0.0,
        initial_damping=numbers["initial_damping"],
        iterations=iterations,
        tolerance=tolerance,
        mode=mode,
        several=several,
    )
    best = of_body(found.solution["design"])
    controls = over_time(found.solution["knots"], problem.n_intervals)
    # The sum of squared residuals, without the ridge.
    least = jnp.sum(found.residuals**2)
    return found, controls, trajectory(best, controls), least, best.data
