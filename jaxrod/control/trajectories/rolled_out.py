"""Simulation of a problem under a policy, with or without feedback and disturbances."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod.control.trajectories.problem import Problem, check_problem, numbers, squares
from jaxrod.structure import pytree

Policy = Callable[[Any, Array], Array]
"""`(state, interval) -> control`, called at the beginning of the interval."""
Disturbance = Callable[[Any, Array], Any]
"""`(state, interval) -> state`, applied before the policy is called."""


@pytree
class RolledOut:
    """A motion under a policy."""

    states: Any
    """States at the start and after each interval, stacked in front."""
    controls: Float[Array, "intervals controls"]
    """Controls of the policy, clipped to the bounds."""
    cost: Float[Array, ""]
    """Sum of the squares of all residuals."""


def rolled_out(
    problem: Problem, policy: Policy, disturbance: Disturbance | None = None
) -> RolledOut:
    """Simulates the motion under a policy, such as a solution's. Pure; traceable.

    Args:
        problem: The problem.
        policy: `(state, interval) -> control`: `solution.policy` with feedback,
            `solution.open_loop` without, or any other.
        disturbance: `(state, interval) -> state`, a change of the state before an
            interval; none by default.

    Raises:
        TypeError: `problem` is not a `Problem`.
    """
    check_problem(problem)

    def one(state: Any, k: Array) -> tuple[Any, Any]:
        met = state if disturbance is None else disturbance(state, k)
        control = jnp.clip(policy(met, k), problem.lower, problem.upper)
        after = problem.move(problem.data, met, control, k)
        made = None
        if problem.running is not None:
            made = problem.running(problem.data, after, control, k)
        return after, (after, control, made)

    last, (states, controls, made) = lax.scan(one, problem.start, numbers(problem))
    end = None if problem.final is None else problem.final(problem.data, last)
    return RolledOut(
        states=jax.tree.map(
            lambda first, rest: jnp.concatenate([first[None], rest]),
            problem.start,
            states,
        ),
        controls=controls,
        cost=squares((made, end)),
    )
