"""Equilibria of systems, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod.lanes.steps import by_kernel
from jaxrod.statics.equilibrium import Equilibrium
from jaxrod.statics.pseudo_transient import (
    LARGEST_DISPLACEMENT,
    LARGEST_TURN,
    find_rest,
)
from jaxrod.structure import pytree
from jaxrod.systems.contact.neighbour_lists import RECORD
from jaxrod.systems.statics.loose_motions import are_driven, held, loose_motions
from jaxrod.systems.statics.problem import (
    Linear,
    StaticProblem,
    displacements,
    static_problem,
)
from jaxrod.systems.stepping.assembly import Assembly, SystemState
from jaxrod.systems.stepping.listing import with_shortage
from jaxrod.systems.stepping.stepper import Motions

_SPARE = 16
"""Largest size of a negative eigenvalue of a stable equilibrium, over the error of the
stiffness matrix [1]."""


@pytree
class _SystemPlace:
    """A configuration of a system, with its loads and its stiffness matrix there."""

    linear: Linear
    """The static problem, linearised about the configuration."""
    stiffness: Float[Array, "m m"]
    """Stiffness matrix, with springs along constrained rates and loose motions that
    make it regular [J]."""
    loose: Float[Array, "modes m"]
    """Loose motions, in scaled rates, which nothing resists; zeros in unused rows."""
    driven: Bool[Array, ""]
    """Whether loads drive a loose motion: then they cannot balance."""

    @property
    def loads(self) -> Float[Array, " m"]:
        """Loads out of balance on the scaled unknowns, forces times length [J]."""
        return self.linear.loads

    def at(self, motions: Motions) -> _SystemPlace:
        """Copy with another configuration, but with the same loads and stiffness."""
        return replace(self, linear=replace(self.linear, motions=motions))

    def momentum(self, step: Float[Array, " m"]) -> Float[Array, " m"]:
        """Mass matrix times a step of the scaled unknowns."""
        return self.linear.mass @ step

    def factors(self, inertia: Array) -> tuple[Array, Array]:
        """LU factors of the stiffness plus `inertia` [1/s^2] times the mass matrix."""
        return jax.scipy.linalg.lu_factor(self.stiffness + inertia * self.linear.mass)

    def solve(
        self, factors: tuple[Array, Array], right: Float[Array, " m"]
    ) -> Float[Array, " m"]:
        """Solution of the linear system with the given LU factors and right side."""
        return jax.scipy.linalg.lu_solve(factors, right)


@pytree
class _SystemAtRest:
    """The static problem of a system, in the form that `find_rest` needs."""

    problem: StaticProblem
    """Loads and stiffness as functions of the configuration."""
    displaced: Bool[Array, " m"]
    """Flags of the unknowns: true for displacements, false for rotations."""

    @property
    def element_lengths(self) -> Float[Array, " m"]:
        """Factors from a scaled step to element lengths (nodes) and radians."""
        scales = self.problem.scales
        return jnp.where(self.displaced, scales.length / scales.element, 1)

    @property
    def largest_step(self) -> Float[Array, " m"]:
        """Largest scaled step allowed in one correction, for each unknown."""
        return jnp.where(self.displaced, LARGEST_DISPLACEMENT, LARGEST_TURN)

    def place(self, motions: Motions) -> _SystemPlace:
        """Loads, stiffness matrix and loose motions at a configuration."""
        here = self.problem.linear(motions)
        loose = loose_motions(self.problem, here)
        return _SystemPlace(
            linear=here,
            stiffness=held(self.problem, here, loose),
            loose=loose,
            driven=are_driven(self.problem, here, loose),
        )

    def moved(self, place: _SystemPlace, step: Float[Array, " m"]) -> Motions:
        """Configuration after a step, to first order; strains change linearly."""
        return self.problem.moved_along_edges(place.linear, step, place.loose)


@jax.jit
def system_equilibrium(
    system: Assembly, state: SystemState, tolerance: Array, max_iterations: Array
) -> Equilibrium:
    """Searches for an equilibrium of a system; the caller has checked the arguments.

    Args:
        system: The system, at one moment.
        state: State to start from.
        tolerance: The search ends at a correction of less than this many element
            lengths and radians.
        max_iterations: Largest number of corrections tried, accepted or not.
    """
    problem, start = static_problem(system, state)
    at_rest = _SystemAtRest(problem, jnp.asarray(displacements(start)))
    end = find_rest(*lax.stop_gradient((at_rest, start, tolerance)), max_iterations)
    here = end.here
    found = by_kernel(problem, "with_held", (here.linear.motions, start))
    # The search has not tested its last correction. It may be large along a motion that
    # hardly anything resists, and is then left out.
    largest = jnp.max(jnp.abs(end.step) * at_rest.element_lengths)
    last = jnp.where(largest <= tolerance, end.step, jnp.zeros_like(end.step))
    correction = _last_correction(problem, found, last)
    rest = by_kernel(problem, "left_after", (found, correction))
    loads = lax.stop_gradient(here.loads)
    converged = end.converged
    together = _with_memory(system, rest, state)
    if RECORD in state:
        # Contacts that did not fit into the lists are not balanced.
        couplings = problem.listed(here.linear.motions).stepper.couplings
        together[RECORD] = lax.stop_gradient(with_shortage(state[RECORD], couplings))
        converged &= ~together[RECORD].overflow
    displaced = displacements(start)
    force = jnp.max(jnp.abs(loads), where=displaced, initial=0)
    return Equilibrium(
        state=together,
        converged=converged,
        stable=converged & _is_positive(here, problem.rounding(start)),
        loose=jnp.max(jnp.abs(here.loose)) > 0,
        iterations=end.iterations,
        force_residual=force / lax.stop_gradient(problem.scales.length),
        couple_residual=jnp.max(jnp.abs(loads), where=~displaced, initial=0),
    )


@jax.custom_jvp
def _last_correction(problem: StaticProblem, found: Motions, step: Array) -> Array:
    """Correction, in scaled rates, that ends the search.

    It is the next step of Newton's method, too small to matter. Its derivative is that
    of the exact equilibrium by the implicit function theorem: one linear solve.
    """
    return step


@_last_correction.defjvp
def _last_correction_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    problem, found, step = primals
    # The correction has derivatives itself, for second derivatives.
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
    """Adds to a state the memories of effects in the state `before`."""
    together = dict(state)
    for name, member in system.interfaces().items():
        memory = member.memory(before[name])
        if any(memory):
            together[name] = replace(state[name], memory=memory)
    return together


def _is_positive(here: _SystemPlace, rounding: Array) -> Array:
    """Whether the symmetric part of the stiffness matrix is positive definite.

    Negative eigenvalues within the effect of round-off and of residual loads are
    tolerated: residual loads alone give a free rotation a stiffness of their size.
    """
    matrix = 0.5 * (here.stiffness + here.stiffness.T)
    spare = rounding * jnp.max(jnp.abs(matrix)) + jnp.max(jnp.abs(here.loads))
    factor = jnp.linalg.cholesky(
        matrix + _SPARE * spare * jnp.eye(len(matrix), dtype=matrix.dtype)
    )
    return jnp.all(jnp.isfinite(jnp.diagonal(factor)))
