r"""Equilibria of systems, and their derivatives.

A ball on a smooth floor can slide, and a round rod between two pins can turn about its
axis. In statics no load resists such a loose motion $m$. The stiffness $K$ is then
singular: the balance of loads does not determine the position along $m$. Suppose that
the loads $g$ do not drive the motion either. Then a spring against its momentum $u = M
m$, with the mass matrix $M$, only selects this position. For any stiffness $\sigma$ of
the spring, the step $r$ has exactly no momentum along the motion:

$$(K + \sigma\,u u^T)\,r = g, \quad m\cdot g = 0 \quad\Rightarrow\quad
  u\cdot r = 0, \quad K r = g.$$

The candidates are the rigid motions of each rod and body, the rotation of all elements
of a rod about their own axes, and all linear combinations of these.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod.lanes.steps import by_kernel
from jaxrod.statics.block_matrices import LU, lu_factors
from jaxrod.statics.equilibrium import Equilibrium
from jaxrod.statics.pseudo_transient import (
    LARGEST_DISPLACEMENT,
    LARGEST_TURN,
    find_rest,
)
from jaxrod.structure import pytree
from jaxrod.systems.contact.neighbour_lists import RECORD, with_shortage
from jaxrod.systems.health import passages_between
from jaxrod.systems.static_problem import (
    Linear,
    StaticProblem,
    displacements,
    static_problem,
)
from jaxrod.systems.stepping.assembly import Assembly, SystemState
from jaxrod.systems.stepping.stepper import Motions

_SPARE = 16
"""Tolerance of the test for stability: negative eigenvalues of the stiffness matrix
count as zero up to this multiple of the matrix's estimated error [1]."""


@pytree
class _SystemPlace:
    """A configuration of a system, with the loads and the stiffness matrix at it."""

    linear: Linear
    """The static problem, linearised about the configuration."""
    stiffness: Float[Array, "m m"]
    """Stiffness matrix, made nonsingular by springs along constrained rates and loose
    motions [J]."""
    loose: Float[Array, "modes m"]
    """Motions that no load resists, in scaled rates, one per row; zeros in unused
    rows."""
    driven: Bool[Array, ""]
    """Whether the loads drive a loose motion and so cannot balance."""
    balanced: Bool[Array, ""]
    """Whether the loads are no more than round-off, compared with the stiffness."""
    rounding: Float[Array, ""]
    """Relative round-off of positions, `StaticProblem.rounding` [1]."""

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

    def factors(self, inertia: Array) -> LU:
        """LU factors of the stiffness plus `inertia` [1/s^2] times the mass matrix."""
        return lu_factors(self.stiffness + inertia * self.linear.mass)

    def solve(self, factors: LU, right: Float[Array, " m"]) -> Float[Array, " m"]:
        """Solution of the linear system with the given LU factors and right side."""
        return factors.solve(right)


@pytree
class _Balance:
    """Loads at a configuration, compared with their round-off by a kernel."""

    loads: Float[Array, " m"]
    """Loads out of balance on the scaled unknowns [J]."""
    rounding: Float[Array, ""]
    """Relative round-off of positions, `StaticProblem.rounding` [1]."""

    def flags(
        self, given: tuple[Float[Array, " m"], Array, Array]
    ) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Whether the loads drive a loose motion, and whether they are all round-off.

        `given` are the sum of each row of the stiffness, without signs, and for each
        loose motion the work of the loads and what it would be without cancelling [J].
        """
        sizes, work, most = given
        driven = jnp.any(jnp.abs(work) > _DRIVEN * self.rounding * most)
        least = jnp.minimum(_ROUNDINGS * self.rounding, _BALANCED)
        return driven, jnp.all(jnp.abs(self.loads) <= least * sizes)


@pytree
class _SystemAtRest:
    """The static problem of a system, in the form that `find_rest` needs."""

    problem: StaticProblem
    """Loads and stiffness as functions of the configuration."""
    displaced: Bool[Array, " m"]
    """Flags of the unknowns: true for displacements, false for rotations."""

    @property
    def element_lengths(self) -> Float[Array, " m"]:
        """Factors that convert a scaled step to element lengths and radians [1].

        Displacements become element lengths, rotations stay in radians.
        """
        scales = self.problem.scales
        return jnp.where(self.displaced, scales.length / scales.element, 1)

    @property
    def largest_step(self) -> Float[Array, " m"]:
        """Largest scaled step allowed in one correction, for each unknown."""
        longest = jnp.where(self.displaced, LARGEST_DISPLACEMENT, LARGEST_TURN)
        return longest.astype(self.problem.system.dtype)

    def place(self, motions: Motions) -> _SystemPlace:
        """Loads, stiffness matrix and loose motions at a configuration."""
        here = self.problem.linear(motions)
        loose, rounding = loose_motions(self.problem, here)
        stiffness = held(self.problem, here, loose)
        one = jnp.ones_like(here.loads)
        bare, springs = jnp.abs(here.stiffness) @ one, jnp.abs(stiffness) @ one
        work = loose @ here.loads, jnp.abs(loose) @ bare
        balance = _Balance(here.loads, rounding)
        driven, balanced = by_kernel(balance, "flags", (springs, *work))
        return _SystemPlace(here, stiffness, loose, driven, balanced, rounding)

    def passes(self, before: _SystemPlace, after: _SystemPlace) -> Bool[Array, ""]:
        """Whether rods that contact keeps apart go through each other in between."""
        stepper = self.problem.stepper
        if not any(coupling.kept_apart for coupling in stepper.couplings):
            return jnp.zeros((), bool)
        places = (place.linear.motions for place in (before, after))
        found = passages_between(stepper.couplings, *map(stepper.leave, places))
        return sum(found.values(), jnp.zeros((), self.problem.system.dtype)) > 0

    def moved(self, place: _SystemPlace, step: Float[Array, " m"]) -> Motions:
        """Configuration after a step from `place`; strains change linearly."""
        return self.problem.moved_along_edges(place.linear, step, place.loose)


@jax.jit
def system_equilibrium(
    system: Assembly, state: SystemState, tolerance: Array, max_iterations: Array
) -> Equilibrium:
    """Searches for an equilibrium of a system; the caller has checked the arguments.

    Args:
        system: The system, at one moment.
        state: Initial state of the search.
        tolerance: Size of a correction, in element lengths and radians, below which the
            search ends.
        max_iterations: Largest number of corrections tried, accepted or not.
    """
    problem, start = static_problem(system, state)
    at_rest = _SystemAtRest(problem, jnp.asarray(displacements(start)))
    end = find_rest(*lax.stop_gradient((at_rest, start, tolerance)), max_iterations)
    here = end.here
    found = by_kernel(problem, "with_held", (here.linear.motions, start))
    outcome = _Outcome(at_rest.displaced, at_rest.element_lengths, tolerance)
    parts = lax.stop_gradient((end.step, here.loads))
    last, force, couple = by_kernel(outcome, "parts", parts)
    correction = _last_correction(problem, found, last)
    together = by_kernel(problem, "left_after", (found, correction))
    converged = end.converged
    if RECORD in state:
        # Contacts that did not fit into the lists are not balanced.
        couplings = problem.listed(here.linear.motions).stepper.couplings
        together[RECORD] = lax.stop_gradient(with_shortage(state[RECORD], couplings))
        converged &= ~together[RECORD].overflow
    return Equilibrium(
        state=together,
        converged=converged,
        stable=converged & _is_positive(_as_it_sticks(system, together, here)),
        loose=jnp.any(here.loose != 0),
        iterations=end.iterations,
        force_residual=force / lax.stop_gradient(problem.scales.length),
        couple_residual=couple,
    )


@pytree
class _Outcome:
    """The end of a search, read by a kernel."""

    displaced: Bool[Array, " m"]
    """Flags of the unknowns: true for displacements, false for rotations."""
    element_lengths: Float[Array, " m"]
    """Factors that convert a scaled step to element lengths and radians [1]."""
    tolerance: Float[Array, ""]
    """Size of a correction that is small enough, in element lengths and radians."""

    def parts(
        self, given: tuple[Float[Array, " m"], Float[Array, " m"]]
    ) -> tuple[Array, Array, Array]:
        """Last correction, and the largest force times length and couple [J].

        `given` are the correction that would follow and the loads. The search has not
        tested this correction. It may be large along a motion that hardly anything
        resists, and is then left out.
        """
        step, loads = given
        little = jnp.max(jnp.abs(step) * self.element_lengths) <= self.tolerance
        sizes = jnp.abs(loads)
        force = jnp.max(jnp.where(self.displaced, sizes, 0))
        couple = jnp.max(jnp.where(self.displaced, 0, sizes))
        return jnp.where(little, step, 0), force, couple


@jax.custom_jvp
def _last_correction(problem: StaticProblem, found: Motions, step: Array) -> Array:
    """Returns `step`, the correction that ends the search, in scaled rates.

    It is the next step of Newton's method at the configuration `found`, too small to
    matter. Its derivative is that of the exact equilibrium by the implicit function
    theorem: one linear solve.
    """
    return step


@_last_correction.defjvp
def _last_correction_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    problem, found, step = primals
    # The correction has derivatives itself, for second derivatives.
    correction = _last_correction(problem, found, step)
    there = by_kernel(problem, "moved_after", (found, correction))
    here = problem.linear(there)
    stiffness = held(problem, here, lax.stop_gradient(loose_motions(problem, here)[0]))

    def accelerations(problem: StaticProblem, found: Motions) -> Array:
        listed = problem.listed(there)
        own: Array = by_kernel(listed, "accelerations_scaled", (found, correction))
        return own

    _, change = jax.jvp(accelerations, (problem, found), tuple(tangents[:2]))
    return correction, jnp.linalg.solve(stiffness, here.mass @ change)


def _as_it_sticks(
    system: Assembly, rest: SystemState, here: _SystemPlace
) -> _SystemPlace:
    """The place `here` with the stiffness of static friction that holds at `rest`.

    The search started from the springs of its initial state; they have slipped since.
    """
    known = system.recalling(rest)
    sticking = known.without_slip
    if sticking is known:
        return here
    problem, there = static_problem(*lax.stop_gradient((sticking, rest)))
    displaced = jnp.asarray(displacements(there))
    return _SystemAtRest(problem, displaced).place(there)


def _is_positive(here: _SystemPlace) -> Array:
    """Whether the symmetric part of the stiffness matrix is positive definite.

    Negative eigenvalues within the effect of round-off and of residual loads are
    tolerated: residual loads alone give a free rotation a stiffness of their size.
    So are those that the other part of the matrix may account for. Static friction has
    one. It couples soft motions to stiff ones and takes its square over the stiffness
    from the eigenvalues of the symmetric part, but not from those of the matrix.
    """
    matrix = 0.5 * (here.stiffness + here.stiffness.T)
    stiffest = jnp.max(jnp.abs(matrix))
    turning = jnp.max(jnp.abs(here.stiffness - matrix))
    spare = here.rounding * stiffest + jnp.max(jnp.abs(here.loads))
    spare = spare + turning**2 / stiffest
    factor = jnp.linalg.cholesky(
        matrix + _SPARE * spare * jnp.eye(len(matrix), dtype=matrix.dtype)
    )
    return jnp.all(jnp.isfinite(jnp.diagonal(factor)))


_ROUNDINGS = 64
"""Largest relative resistance to a motion that counts as zero, in units of the relative
round-off of positions, `StaticProblem.rounding` [1]."""

_BALANCED = 5e-7
"""Largest load relative to the stiffness that can count as balanced where a search no
longer reduces it [1]. In single precision `_ROUNDINGS` alone would accept loads that
bend slender rods."""

_SLIGHT = 1e-9
"""Largest relative resistance that can count as zero when the tolerance is raised for
the number of unknowns, over which round-off adds up like a random walk [1]. Slender
rods resist bending by more. In single precision `_ROUNDINGS` alone gives a larger
tolerance."""

_DRIVEN = 1024
"""Largest relative work of loads along a loose motion that counts as zero, in units of
the relative round-off of positions [1]. It exceeds `_ROUNDINGS` because these loads sum
up the round-off of all elements."""

_LEAST = 0.01
"""Largest singular value at which a combination of loose motions of length one counts
as zero: the motions are then dependent [1]."""


def loose_motions(
    problem: StaticProblem, here: Linear
) -> tuple[Float[Array, "modes m"], Float[Array, ""]]:
    """Independent motions that no load resists, in scaled rates, each of length one.

    They are combinations of the rigid motions of rods and bodies at the configuration
    `here`.

    Returns:
        As many rows as there are candidates; rows that are not needed are zero. And the
        relative round-off of positions, `StaticProblem.rounding`.
    """
    whole, rounding = by_kernel(problem, "motions_of_the_whole", here.motions)
    resisted = here.stiffness @ whole.T
    # Size of the rows if nothing cancelled.
    sizes = jnp.max(jnp.abs(here.stiffness) @ jnp.abs(whole.T), axis=1, keepdims=True)
    resisted = resisted / jnp.where(sizes > 0, sizes, 1)
    barred = whole.T - here.projection @ whole.T
    both = jnp.concatenate([resisted, barred])
    _, resistance, mixtures = jnp.linalg.svd(both, full_matrices=False)
    least = _ROUNDINGS * rounding
    walk = len(here.loads) ** 0.5
    none = resistance <= jnp.maximum(least, jnp.minimum(walk * least, _SLIGHT))
    found = jnp.where(none[:, None], mixtures, 0) @ whole
    # Candidates may be dependent: the rotation of a straight rod about its axis minus
    # the rotation of all its elements about theirs is nothing but round-off.
    _, sizes, independent = jnp.linalg.svd(found, full_matrices=False)
    return jnp.where((sizes > _LEAST)[:, None], independent, 0), rounding


def held(
    problem: StaticProblem, here: Linear, motions: Float[Array, "modes m"]
) -> Float[Array, "m m"]:
    """Stiffness matrix plus springs along loose motions and constrained rates [J].

    `motions` are the loose motions. Constrained rates are those that supports, ties and
    attachments do not allow. The springs make the matrix nonsingular.
    """
    momenta = motions @ here.mass
    inertia = jnp.sum(momenta * motions, axis=1)
    free = inertia > 0
    weight = jnp.where(free, jnp.sum(motions**2, axis=1), 0)
    weight = weight / jnp.where(free, inertia, 1) ** 2
    springs = momenta.T @ (weight[:, None] * momenta)
    return here.stiffness + problem.scales.energy * (springs + here.barred)
