"""Knots: initial values for solvers, and their checks."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.control.problem import Problem
from jaxrod.validation import check_array, check_count, check_kind, check_seed

SPREAD = 1e-3
"""Standard deviation of the first knots, as a fraction of half the range between the
bounds. It breaks the symmetry of a straight rod, whose gradient may vanish exactly."""
MOST_KNOTS = 100_000


def check_problem(problem: Any) -> None:
    """Raises a TypeError unless `problem` is a `Problem`."""
    check_kind("problem", problem, Problem)


def half_widths(problem: Problem) -> Float[Array, " controls"]:
    """Half the range between the bounds of each control; 1 if it has no bounds."""
    half = 0.5 * (problem.upper - problem.lower)
    return jnp.where(jnp.isfinite(half), half, 1)


def first_knots(
    problem: Problem, n_knots: int, given: Any, seed: int, spread: float = SPREAD
) -> Float[Array, "knots controls"]:
    """Returns the first knots: the given ones, or small random ones about zero.

    Args:
        problem: The problem.
        n_knots: Number of knots.
        given: Given knots, or `None`.
        seed: Seed of the random knots.
        spread: Standard deviation of the random knots, as a fraction of half the range
            between the bounds.

    Raises:
        ValueError: The given knots have the wrong shape or lie beyond the bounds.
    """
    n_knots = check_count("n_knots", n_knots, 1, MOST_KNOTS)
    shape = (n_knots, problem.n_controls)
    if given is not None:
        return within_bounds(problem, "initial_knots", given, shape)
    noise = jax.random.normal(
        jax.random.key(check_seed(seed)), shape, problem.lower.dtype
    )
    return jnp.clip(
        spread * half_widths(problem)[None] * noise,
        problem.lower[None],
        problem.upper[None],
    )


def within_bounds(
    problem: Problem, name: str, given: Any, shape: tuple[int, ...]
) -> Array:
    """Checks given controls, and converts them to the dtype of the problem.

    Raises:
        ValueError: They do not have that shape, are not finite or exceed the bounds.
    """
    values = np.asarray(check_array(name, given, [shape], ""))
    low, high = np.asarray(problem.lower), np.asarray(problem.upper)
    beyond = (values < low - 1e-6 * np.abs(low)) | (values > high + 1e-6 * np.abs(high))
    if beyond.any():
        raise ValueError(
            f"{name} must be within the bounds of the problem, got "
            f"{values[beyond].flat[0]:g}"
        )
    dtype = problem.lower.dtype
    # Clip again after rounding to the dtype of the problem, in which the bounds are.
    return jnp.clip(
        jnp.asarray(values, dtype), problem.lower[None], problem.upper[None]
    )
