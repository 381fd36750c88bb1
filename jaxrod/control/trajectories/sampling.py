r"""Trajectory optimisation by sampling, without derivatives.

Knots are drawn at random about a mean and simulated as one batch. The next mean is a
weighted mean of the samples. In MPPI (Williams and others, 2017) samples $z_i$ of cost
$L_i$ have weights

$$w_i \propto \exp\!\big(-(L_i - \min L) / \lambda\big),$$

with the temperature $\lambda$ a fraction of the standard deviation of the costs. In the
cross-entropy method (Rubinstein, 1999) the best few samples (elites) have equal
weights, and the next samples have the elites' standard deviation.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
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
from jaxrod.validation import check_array, check_count, check_seed


def mppi(
    problem: Problem,
    *,
    n_knots: int = 11,
    samples: int = 64,
    iterations: int = 20,
    spread: float = 0.3,
    temperature: float = 0.1,
    initial_knots: Any = None,
    seed: int = 0,
) -> Solution:
    """Finds knots by model predictive path integrals: weighted means of samples.

    A sample of cost L has the weight exp(-(L - min L) / lambda), where lambda is
    `temperature` times the standard deviation of the costs.

    Args:
        problem: The problem.
        n_knots: Number of knots, equally spaced in time.
        samples: Samples drawn in each iteration, at least 2; they are one batch.
        iterations: Number of iterations.
        spread: Standard deviation of the samples, as a fraction of half the range
            between the bounds; it falls to a tenth at the end [1].
        temperature: Temperature of the weights, as a fraction of the costs' standard
            deviation [1].
        initial_knots: Initial mean of the knots `(n_knots, n_controls)`; by default
            zeros, clipped to the bounds.
        seed: Seed of the samples.

    Returns:
        The best sample of all, with its motion.

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
        >>> found = control.mppi(problem, n_knots=2)
        >>> print(found.states[-1].round(2))
        [0.5]
    """
    check_problem(problem)
    start = first_knots(problem, n_knots, initial_knots, seed, 0.0)
    heat = check_array("temperature", temperature, [()], "", positive=True)
    share = jnp.asarray(heat, start.dtype)
    return _sampled("mppi", problem, start, samples, iterations, spread, seed, share)


def cross_entropy(
    problem: Problem,
    *,
    n_knots: int = 11,
    samples: int = 64,
    elites: int = 8,
    iterations: int = 20,
    spread: float = 0.5,
    initial_knots: Any = None,
    seed: int = 0,
) -> Solution:
    """Finds knots by the cross-entropy method: mean and spread of the best samples.

    Args:
        problem: The problem.
        n_knots: Number of knots, equally spaced in time.
        samples: Samples drawn in each iteration; they are one batch.
        elites: Number of samples that count as the best, at least 2.
        iterations: Number of iterations.
        spread: Initial standard deviation, as a fraction of half the range between the
            bounds [1].
        initial_knots: Initial mean of the knots `(n_knots, n_controls)`; by default
            zeros, clipped to the bounds.
        seed: Seed of the samples.

    Returns:
        The best sample of all, with its motion.

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
        >>> found = control.cross_entropy(problem, n_knots=2)
        >>> print(found.states[-1].round(2))
        [0.5]
    """
    check_problem(problem)
    start = first_knots(problem, n_knots, initial_knots, seed, 0.0)
    best = check_count("elites", elites, 2, check_count("samples", samples, 2))
    return _sampled(
        "cross_entropy", problem, start, samples, iterations, spread, seed, elites=best
    )


def _sampled(
    solver: str,
    problem: Problem,
    start: Array,
    samples: int,
    iterations: int,
    spread: float,
    seed: int,
    temperature: Array | None = None,
    elites: int | None = None,
) -> Solution:
    first = check_array("spread", spread, [()], "", positive=True)
    found, compile_s, run_s = timed(
        _solved,
        problem,
        start,
        jnp.asarray(first, start.dtype),
        jax.random.key(check_seed(seed)),
        temperature,
        elites=elites,
        samples=check_count("samples", samples, 2),
        iterations=check_count("iterations", iterations, 1),
    )
    knots, controls, states, least, costs = found
    finite = bool(np.isfinite(least))
    words = f"{iterations} times {samples} samples were drawn"
    return Solution(
        problem=problem,
        solver=solver,
        controls=controls,
        states=states,
        cost=float(least),
        history={"cost": np.asarray(costs)},
        converged=False,
        reason=words if finite else words + ", none of finite cost",
        iterations=iterations,
        compile_s=compile_s,
        run_s=run_s,
        knots=knots,
    )


def _solved(
    problem: Problem,
    start: Array,
    spread: Array,
    key: Array,
    temperature: Array | None,
    *,
    elites: int | None,
    samples: int,
    iterations: int,
) -> tuple[Array, Array, Any, Array, Array]:
    """Returns the best knots, their controls, states and cost, and the cost history.

    The history has the best cost so far, after each iteration. `start` and `spread` are
    the initial mean and standard deviation of the knots. With `elites` the method is
    cross-entropy; without, it is MPPI at the `temperature`.
    """
    half = half_widths(problem)[None]
    low, high = problem.lower[None], problem.upper[None]

    def valued(knots: Array) -> Array:
        value = cost(problem, over_time(knots, problem.n_intervals))
        return jnp.where(jnp.isfinite(value), value, jnp.inf)

    def again(carry: tuple[Array, ...], given: tuple[Array, Array]) -> Any:
        middle, deviation, best, least = carry
        share, key = given
        noise = jax.random.normal(key, (samples, *start.shape), start.dtype)
        # The best point so far is one of the samples, so that it is not lost.
        drawn = jnp.clip(middle[None] + deviation[None] * noise, low[None], high[None])
        drawn = jnp.concatenate([best[None], drawn[1:]])
        costs = jax.vmap(valued)(drawn)
        lowest = jnp.min(costs)
        first = jnp.argmin(costs)
        fits = (jnp.arange(samples) == first)[:, None, None]
        better = lowest < least
        best = jnp.where(better, jnp.sum(jnp.where(fits, drawn, 0), axis=0), best)
        if elites is None:
            assert temperature is not None
            sound = jnp.isfinite(costs)
            usual = jnp.where(sound, costs, lowest)
            heat = temperature * jnp.std(usual) + jnp.finfo(costs.dtype).tiny
            weights = jnp.where(sound, jnp.exp(-(usual - lowest) / heat), 0)
            deviation = 0.1**share * spread * jnp.broadcast_to(half, start.shape)
        else:
            limit = jnp.sort(costs)[elites - 1]
            weights = jnp.where(costs <= limit, 1, 0).astype(costs.dtype)
        weights = (weights / jnp.sum(weights))[:, None, None]
        made = jnp.sum(weights * drawn, axis=0)
        if elites is not None:
            square = jnp.sum(weights * (drawn - made[None]) ** 2, axis=0)
            deviation = jnp.sqrt(square) + 1e-3 * half
        return (made, deviation, best, jnp.minimum(lowest, least)), lowest

    shares = jnp.arange(1, iterations + 1, dtype=start.dtype) / iterations
    begin = (
        start,
        spread * jnp.broadcast_to(half, start.shape),
        start,
        jnp.asarray(jnp.inf, start.dtype),
    )
    (_, _, best, least), costs = lax.scan(
        again, begin, (shares, jax.random.split(key, iterations))
    )
    controls = over_time(best, problem.n_intervals)
    running = lax.associative_scan(jnp.minimum, costs)
    return best, controls, trajectory(problem, controls), least, running
