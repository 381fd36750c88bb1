"""Equilibria of systems, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxrod.lanes.steps import by_kernel
from jaxrod.statics.equilibrium import Equilibrium
from jaxrod.systems.contact.neighbour_lists import RECORD
from jaxrod.systems.statics.loose_motions import held, loose_motions
from jaxrod.systems.statics.newton import Search, newton
from jaxrod.systems.statics.problem import (
    StaticProblem,
    is_displacement,
    static_problem,
)
from jaxrod.systems.stepping.assembly import Assembly, SystemState
from jaxrod.systems.stepping.listing import with_shortage
from jaxrod.systems.stepping.stepper import Motions

_SPARE = 16
"""Multiple of what disturbs the stiffness up to which it may be negative [1]."""


@jax.jit
def system_equilibrium(
    system: Assembly, state: SystemState, tolerance: Array, max_iterations: Array
) -> Equilibrium:
    """An equilibrium of a system; its arguments are checked.

    Args:
        system: The system, at one moment.
        state: State to start from.
        tolerance: The search ends at a correction of less than this many element
            lengths and radians.
        max_iterations: Largest number of corrections tried, accepted or not.
    """
    problem, start = static_problem(system, state)
    end = newton(*lax.stop_gradient((problem, start, tolerance)), max_iterations)
    found = by_kernel(problem, "with_held", (end.here.motions, start))
    correction = _last_correction(problem, found, end.step)
    rest = by_kernel(problem, "left_after", (found, correction))
    loads = lax.stop_gradient(end.here.loads)
    converged = end.converged
    together = _with_memory(system, rest, state)
    if RECORD in state:
        # Contact that lists had no room for is not balanced.
        couplings = problem.listed(end.here.motions).stepper.couplings
        together[RECORD] = lax.stop_gradient(with_shortage(state[RECORD], couplings))
        converged &= ~together[RECORD].overflow
    displaced = is_displacement(start)
    force = jnp.max(jnp.abs(loads), where=displaced, initial=0)
    return Equilibrium(
        state=together,
        converged=converged,
        stable=converged & _is_positive(end, problem.rounding(start)),
        loose=jnp.max(jnp.abs(end.loose)) > 0,
        iterations=end.iterations,
        force_residual=force / lax.stop_gradient(problem.scales.length),
        couple_residual=jnp.max(jnp.abs(loads), where=~displaced, initial=0),
    )


@jax.custom_jvp
def _last_correction(problem: StaticProblem, found: Motions, step: Array) -> Array:
    """Correction, in scaled rates, that ends the search.

    It is what Newton's method would do next, too small to matter. Its derivative is
    that of the exact equilibrium, by the implicit function theorem: one linear solve.
    """
    return step


@_last_correction.defjvp
def _last_correction_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    problem, found, step = primals
    # With derivatives of its own, where derivatives of derivatives are asked for.
    correction = _last_correction(problem, found, step)
    there = by_kernel(problem, "moved_after", (found, correction))
    here = problem.linear(there)
    stiffness = held(problem, here, lax.stop_gradient(loose_motions(problem, here)))

    def accelerations(problem: StaticProblem, found: Motions) -> Array:
        listed = problem.listed(there)
        own: Array = by_kernel(listed, "accelerations_scaled", (found, correction))
        return own

    _, change = jax.jvp(accelerations, (problem, found), tuple(tangents[:2]))
    return correction, jnp.linalg.solve(stiffness, here.mass @ change)


def _with_memory(
    system: Assembly, state: Mapping[str, Any], before: SystemState
) -> dict[str, Any]:
    """State with the memory of effects as it was."""
    together = dict(state)
    for name, member in system.interfaces().items():
        memory = member.memory(before[name])
        if any(memory):
            together[name] = replace(state[name], memory=memory)
    return together


def _is_positive(end: Search, rounding: Array) -> Array:
    """Whether the symmetric part of the stiffness is positive definite.

    What round-off, or loads that are not quite in balance, can do to it is not counted:
    a whole that can turn has a stiffness against that of the size of these loads.
    """
    matrix = 0.5 * (end.stiffness + end.stiffness.T)
    spare = rounding * jnp.max(jnp.abs(matrix)) + jnp.max(jnp.abs(end.here.loads))
    factor = jnp.linalg.cholesky(
        matrix + _SPARE * spare * jnp.eye(len(matrix), dtype=matrix.dtype)
    )
    return jnp.all(jnp.isfinite(jnp.diagonal(factor)))
