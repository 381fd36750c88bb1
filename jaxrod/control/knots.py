"""Knots: where a solver begins, and what it may begin with."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.control.problem import Problem
from jaxrod.validation import check_array, check_count, check_kind, check_seed

SPREAD = 1e-3
"""Of the first knots, a share of the bounds. It breaks the symmetry of a straight rod,
for which a gradient may vanish exactly."""
MOST_KNOTS = 100_000


def check_problem(problem: Any) -> None:
    """Raises TypeError unless it is one."""
    check_kind("problem", problem, Problem)


def half_widths(problem: Problem) -> Float[Array, " controls"]:
    """Half of what lies between the bounds of each control; 1 where there are none."""
    half = 0.5 * (problem.upper - problem.lower)
    return jnp.where(jnp.isfinite(half), half, 1)


def first_knots(
    problem: Problem, n_knots: int, given: Any, seed: int, spread: float = SPREAD
) -> Float[Array, "knots controls"]:
    """The knots to begin with: those given, or small random ones about zero.

    Args:
        problem: The problem.
        n_knots: How many.
        given: Those given, if any.
        seed: Of the random ones.
        spread: Of the random ones, a share of half of what lies between the bounds.

    Raises:
        ValueError: those given do not fit or lie beyond the bounds.
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
    """Controls that were given, in the type of the problem.

    Raises:
        ValueError: they are not of that shape, not finite or beyond the bounds.
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
    # Rounded to the type of the problem, bounds included.
    return jnp.clip(
        jnp.asarray(values, dtype), problem.lower[None], problem.upper[None]
    )
