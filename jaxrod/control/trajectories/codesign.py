"""Codesign: a body and its controls, optimised together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
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

Body = Callable[[Any, Any], Any]
"""`(data, design) -> data`: the problem's data for a body."""


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
    damping: float = 1.0,
    initial_knots: Any = None,
    seed: int = 0,
) -> Solution:
    """Finds the design of a body and its controls that minimise the sum of squares.

    It applies the method of `levenberg_marquardt` to both together. The simulation's
    time step is that of the problem: the bounds of the design must keep the body stable
    with it.

    Args:
        problem: The problem; all bodies start from its initial state.
        body: `(data, design) -> data`, defined at module level; pure and
            differentiable.
        design: First design, any pytree of floats.
        n_knots: Knots in time, equally spaced.
        iterations: Largest number of iterations.
        ridge: Weight of the mean squared knot value: the effort.
        lower: Lower bounds of the design, a number or a tree like `design`.
        upper: Upper bounds of the design, a number or a tree like `design`.
        damping: Damping of the first step, as a fraction of the diagonal [1].
        initial_knots: First knots `(n_knots, n_controls)`; small random ones by
            default.
        seed: Seed of the small random knots.

    Returns:
        The best pair: `design` is the body's design, and `problem` has its data.

    Raises:
        ValueError: An argument is out of range or does not fit.
        TypeError: `problem` is not a `Problem`.
    """
    check_problem(problem)
    knots = first_knots(problem, n_knots, initial_knots, seed)
    kind = knots.dtype
    numbers = {
        "ridge": check_array("ridge", ridge, [()], "", positive=True),
        "damping": check_array("damping", damping, [()], "", positive=True),
    }
    begin = jax.tree.map(lambda leaf: jnp.asarray(leaf, kind), design)
    if not jax.tree.leaves(begin):
        raise ValueError("design must have at least one number")
    bounds = tuple(
        _bounds(bound, begin, sign) for bound, sign in ((lower, -1), (upper, 1))
    )
    found, compile_s, run_s = timed(
        _solved,
        problem,
        {"design": begin, "knots": knots},
        {name: jnp.asarray(n, kind) for name, n in numbers.items()},
        bounds,
        body=body,
        iterations=check_count("iterations", iterations, 1),
    )
    least, controls, states, data = found
    tried = int(least.iterations)
    converged = bool(least.converged)
    return Solution(
        problem=replace(problem, data=data),
        solver="codesign",
        controls=controls,
        states=states,
        cost=float(jnp.sum(least.residuals**2)),
        history={"cost": np.asarray(least.costs)[: tried + 1]},
        converged=converged,
        reason="a step changes the cost, or the unknowns, by less than asked"
        if converged
        else f"{tried} iterations were made",
        iterations=tried,
        compile_s=compile_s,
        run_s=run_s,
        knots=least.solution["knots"],
        design=least.solution["design"],
    )


def _bounds(bound: Any, design: Any, sign: int) -> Any:
    """Broadcasts a bound to the tree and shapes of the design; infinite if `None`."""
    if bound is None:
        bound = sign * jnp.inf
    kinds: list[Any] = [jax.tree.structure(tree) for tree in (bound, design)]
    if kinds[0] != kinds[1]:
        bound = jax.tree.map(lambda _: bound, design)
    return jax.tree.map(
        lambda b, leaf: jnp.broadcast_to(jnp.asarray(b, leaf.dtype), leaf.shape),
        bound,
        design,
    )


def _solved(
    problem: Problem,
    start: dict[str, Any],
    numbers: dict[str, Array],
    bounds: tuple[Any, Any],
    *,
    body: Body,
    iterations: int,
) -> tuple[LeastSquares, Array, Any, Any]:
    """Returns the solution, its controls, its motion, and the data of its body."""
    shape = start["knots"].shape
    low, high = (
        {"design": bound, "knots": jnp.broadcast_to(limit, shape)}
        for bound, limit in zip(bounds, (problem.lower, problem.upper), strict=True)
    )

    def of_body(design: Any) -> Problem:
        return replace(problem, data=body(problem.data, design))

    # The ridge does not act on the design.
    free = jax.tree.map(jnp.zeros_like, start["design"])
    weight = jnp.full(shape, 1 / start["knots"].size, numbers["ridge"].dtype)
    found = least_squares(
        lambda z: residuals(
            of_body(z["design"]), over_time(z["knots"], problem.n_intervals)
        ),
        start,
        lower=low,
        upper=high,
        ridge={"design": free, "knots": numbers["ridge"] * weight},
        centre=0.0,
        damping=numbers["damping"],
        iterations=iterations,
    )
    best = of_body(found.solution["design"])
    controls = over_time(found.solution["knots"], problem.n_intervals)
    return found, controls, trajectory(best, controls), best.data
