"""Equilibria of systems, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxrod.lanes.steps import by_kernel
from jaxrod.statics.equilibrium import Equilibrium
from jaxrod.systems.contact.neighbour_lists import RECORD
from jaxrod.systems.statics.loose_motions import held, loose_motions
from jaxrod.systems.statics.newton import newton
from jaxrod.systems.statics.problem import (
    StaticProblem,
    is_displacement,
    static_problem,
)
from jaxrod.systems.stepping.assembly import Assembly, SystemState
from jaxrod.systems.stepping.stepper import Motions


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
        max_iterations: Largest number of trials.
    """
    problem, start = static_problem(system, state)
    end = newton(*lax.stop_gradient((problem, start, tolerance)), max_iterations)
    found = by_kernel(problem, "with_held", (end.here.motions, start))
    correction = _last_correction(problem, found, end.step)
    rest = by_kernel(problem, "left", (found, problem.rates(found, correction)))
    loads = lax.stop_gradient(end.here.loads)
    displaced = is_displacement(start)
    force = jnp.max(jnp.abs(loads), where=displaced, initial=0)
    return Equilibrium(
        state=_with_memory(system, rest, state),
        converged=end.converged,
        stable=end.converged & _is_positive(end.stiffness),
        loose=end.loose,
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
    there = by_kernel(problem, "moved", (found, problem.rates(found, correction)))
    here = problem.linear(there)
    stiffness = held(problem, here, lax.stop_gradient(loose_motions(problem, here)))

    def accelerations(problem: StaticProblem, found: Motions) -> Array:
        given = found, problem.rates(found, correction)
        own = by_kernel(problem.listed(there), "accelerations_after", given)
        return ravel_pytree(own)[0]

    _, change = jax.jvp(accelerations, (problem, found), tuple(tangents[:2]))
    change = here.mass @ (change / problem.units(found))
    return correction, jnp.linalg.solve(stiffness, change)


def _with_memory(
    system: Assembly, state: Mapping[str, Any], before: SystemState
) -> dict[str, Any]:
    """State with the memory of effects, and the record of lists, as they were."""
    together = dict(state)
    for name, member in system.interfaces().items():
        memory = member.memory(before[name])
        if any(memory):
            together[name] = replace(state[name], memory=memory)
    if RECORD in before:
        together[RECORD] = before[RECORD]
    return together


def _is_positive(matrix: Array) -> Array:
    """Whether the symmetric part of a matrix is positive definite."""
    factor = jnp.linalg.cholesky(0.5 * (matrix + matrix.T))
    return jnp.all(jnp.isfinite(jnp.diagonal(factor)))
