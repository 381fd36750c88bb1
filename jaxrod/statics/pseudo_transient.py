r"""Search for a configuration at rest: Newton's method, with inertia where needed.

A full correction $K s = f$ of the loads $f$ is tried, and judged by the correction that
would follow it. If the latter is too large, if the correction goes against the loads,
or if rods would go through each other, inertia is added: $(K + \sigma M)\,s = f$ is one
implicit step from rest, after which the velocities are set to zero. The factor
$\sigma$ shrinks to zero as the corrections become better. Such steps move in the
direction of the loads, past folds, to a stable equilibrium.

Source: pseudo-transient continuation (Kelley and Keyes, SIAM J. Numer. Anal. 35, 1998),
with a factor that is controlled by how well the linear model predicts the loads.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxrod.lanes.run_spec import is_in_one_kernel
from jaxrod.lanes.steps import by_kernel
from jaxrod.structure import pytree

LARGEST_TURN = 1.0
"""Largest rotation in one correction [rad]."""
LARGEST_DISPLACEMENT = 1.0
"""Largest displacement in one correction, divided by the length of the longest rod
[1]."""
LEFT = 0.75
"""A correction is accepted if the one that would follow it is at most this fraction of
it [1]."""
LITTLE = 0.1
"""Inertia shrinks fast if the correction that would follow is at most this fraction of
the accepted one [1]."""
STALLED = 10
"""Multiple of the tolerance below which a stalled search counts as converged [1]."""
STIFFER = 5
"""Smallest inertia after a correction that was not accepted, as a multiple of the
stiffness that the loads have along it [1]. With less, several trials follow that are
not accepted either."""
FASTEST, SLOWEST = 0.1, 0.75
"""Smallest and largest factor by which inertia shrinks after a correction [1]."""


class Place(Protocol):
    """A configuration, with its loads and their derivative there (a pytree).

    Steps and loads are scaled: a step has displacements divided by a length, and
    rotations [rad].
    """

    @property
    def loads(self) -> Array:
        """Unbalanced loads, scaled [J]."""

    @property
    def driven(self) -> Bool[Array, ""]:
        """Whether loads act along a motion that nothing resists."""

    @property
    def balanced(self) -> Bool[Array, ""]:
        """Whether the loads are no more than round-off."""

    def at(self, configuration: Any) -> Any:
        """Copy with another configuration; loads and tangent are not updated."""

    def momentum(self, step: Array) -> Array:
        """Product M s of the mass matrix and a scaled step s, scaled [kg m^2]."""

    def factors(self, inertia: Array) -> Any:
        """Factors of the matrix K + `inertia` M of stiffness and mass, for `solve`."""

    def solve(self, factors: Any, right: Array) -> Array:
        """Solution s, a scaled step, of (K + inertia M) s = `right`, from factors."""


class RestProblem(Protocol):
    """A static problem: loads at a configuration, and steps to other ones."""

    @property
    def element_lengths(self) -> Array:
        """Factors that turn a scaled step into shortest element lengths and radians."""

    @property
    def largest_step(self) -> Array:
        """Largest allowed scaled step, component by component."""

    def place(self, configuration: Any) -> Any:
        """Loads, tangent and mass at a configuration (a `Place`)."""

    def moved(self, place: Any, step: Array) -> Any:
        """Configuration after a scaled step from a place, to first order."""

    def passes(self, before: Any, after: Any) -> Bool[Array, ""]:
        """Whether things that contact keeps apart go through each other in between."""


@pytree
class Search:
    """State of the search: a configuration, and the correction to try next."""

    here: Any
    """Last accepted configuration, with its loads and tangent."""
    factors: Any
    """Factors of the matrix K + sigma M of stiffness and mass at `here`; sigma is
    `inertia`."""
    step: Array
    """Full correction from `here`, a scaled step."""
    inertia: Float[Array, ""]
    """Factor sigma of the mass matrix M in K + sigma M, K the stiffness [1/s^2]."""
    shrinking: Float[Array, ""]
    """Factor by which inertia shrinks after a good correction [1]."""
    trials: Int[Array, ""]
    """Number of corrections tried."""
    iterations: Int[Array, ""]
    """Number of corrections that were accepted."""
    converged: Bool[Array, ""]
    """Whether the last correction was below the tolerance."""


@pytree
class Trial:
    """A correction that was tried, and what it has led to."""

    step: Array
    """Full correction, a scaled step."""
    tried: Array
    """Part of it that was tried."""
    left: Array
    """Correction that would follow."""
    loads: Array
    """Unbalanced loads before, scaled [J]."""
    momentum: Array
    """Product of the mass matrix and the full correction [kg m^2]."""
    inertia: Float[Array, ""]
    """Factor sigma of the mass matrix in this correction [1/s^2]."""
    shrinking: Float[Array, ""]
    """Factor by which inertia shrinks after a good correction [1]."""
    first: Bool[Array, ""]
    """Whether it is the start, which is always accepted."""
    driven: Bool[Array, ""]
    """Whether loads act along a motion that nothing resists."""
    balanced: Bool[Array, ""]
    """Whether the loads before are no more than round-off."""
    passes: Bool[Array, ""]
    """Whether things that contact keeps apart have gone through each other."""


@pytree
class _Judge:
    """The rules by which corrections are tried and accepted, each by a kernel."""

    element_lengths: Array
    """Factors that turn a scaled step into shortest element lengths and radians."""
    largest_step: Array
    """Largest allowed scaled step, component by component."""
    tolerance: Array
    """The search ends after a correction of less than this."""

    def trial(self, given: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        """The part of a correction to try, and the loads to expect after it.

        `given` are the full correction, its momentum, the loads and the inertia.
        """
        step, momentum, loads, inertia = given
        share = 1 / jnp.maximum(1, jnp.max(jnp.abs(step) / self.largest_step))
        expected = (1 - share) * loads + share * inertia * momentum
        return share * step, expected

    def verdict(self, trial: Trial) -> tuple[Array, Array, Array, Array]:
        """Whether a trial is accepted and ends the search, and what inertia comes next.

        Returns:
            Whether it is accepted, whether the search has converged, the next factor
            sigma of the mass matrix, and the next factor by which inertia shrinks.
        """
        ratio = _size(trial.left) / _size(trial.tried)
        work = jnp.sum(trial.step * trial.loads)
        # Near the tolerance the rest may be round-off. So a correction slightly above
        # the tolerance that no longer shrinks is accepted.
        largest = jnp.max(jnp.abs(trial.tried) * self.element_lengths)
        little = (largest <= self.tolerance) | (
            (largest <= STALLED * self.tolerance) & (ratio > LEFT)
        )
        # Below the tolerance nothing moves far enough to pass.
        full = ~trial.first & (trial.inertia == 0) & ~trial.driven
        done = full & little
        # A motion that is hardly resisted takes any correction from round-off alone.
        # Where loads balance, one that does not reduce them is left out.
        stuck = full & ~done & trial.balanced & ~(ratio <= LEFT)
        taken = trial.first | done | ((ratio <= LEFT) & (work > 0) & ~trial.passes)
        own = jnp.sum(trial.step * trial.momentum)
        resisted = jnp.abs(work - trial.inertia * own)
        fast = ratio <= LITTLE
        lower = trial.inertia * jnp.where(fast, trial.shrinking, 0.5)
        lower = jnp.where(lower * own < 1e-4 * resisted, 0, lower)
        # If reduced inertia was too small, it shrinks more slowly from now on.
        slower = jnp.minimum(jnp.sqrt(trial.shrinking), SLOWEST)
        faster = jnp.maximum(trial.shrinking**2, FASTEST)
        shrinking = jnp.where(taken, jnp.where(fast, faster, trial.shrinking), slower)
        higher = jnp.maximum(trial.inertia / shrinking, STIFFER * resisted / own)
        # Below the tolerance the ratio may be round-off alone. More inertia would make
        # the correction smaller still, so the full correction is tried next.
        higher = jnp.where(largest <= self.tolerance, 0, higher)
        inertia = jnp.where(trial.first, 0, jnp.where(taken, lower, higher))
        shrinking = jnp.where(trial.first, FASTEST, shrinking)
        return taken, done | stuck, inertia, shrinking


def _size(step: Array) -> Array:
    return jnp.sqrt(jnp.sum(step * step))


def find_rest(
    problem: RestProblem, start: Any, tolerance: Array, max_iterations: int | Array
) -> Search:
    """Searches for the configuration at which loads balance.

    Args:
        problem: The static problem.
        start: Configuration to start from.
        tolerance: The search ends after a correction of less than this many element
            lengths and radians.
        max_iterations: Largest number of corrections tried, accepted or not.
    """
    in_kernel = is_in_one_kernel()
    judge = _Judge(problem.element_lengths, problem.largest_step, tolerance)

    def unfinished(search: Search) -> Array:
        # Written so that a non-finite correction ends the search.
        going = (search.trials == 0) | (_size(search.step) < jnp.inf)
        return going & ~search.converged & (search.trials <= max_iterations)

    def improve(search: Search) -> Search:
        before, step = search.here, search.step
        momentum = before.momentum(step)
        tried, expected = by_kernel(
            judge, "trial", (step, momentum, before.loads, search.inertia)
        )
        here = _place(problem, problem.moved(before, tried), in_kernel)
        left = before.solve(search.factors, here.loads - expected)
        trial = Trial(
            step=step,
            tried=tried,
            left=left,
            loads=before.loads,
            momentum=momentum,
            inertia=search.inertia,
            shrinking=search.shrinking,
            first=search.trials == 0,
            driven=before.driven,
            balanced=before.balanced,
            passes=problem.passes(before, here),
        )
        taken, converged, inertia, shrinking = by_kernel(judge, "verdict", trial)
        here = jax.tree.map(lambda a, b: jnp.where(taken, a, b), here, before)
        factors = here.factors(inertia)
        return Search(
            here=here,
            factors=factors,
            step=here.solve(factors, here.loads),
            inertia=inertia,
            shrinking=shrinking,
            trials=search.trials + 1,
            iterations=search.iterations + (taken & (search.trials > 0)),
            converged=converged,
        )

    def nothing() -> Any:
        here = _place(problem, start, in_kernel)
        return here, here.factors(jnp.zeros_like(tolerance))

    # The first trial is the start.
    here, factors = jax.tree.map(
        lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(nothing)
    )
    here = here.at(start)
    zero, none = jnp.zeros_like(tolerance), jnp.zeros((), jnp.int32)
    step = jnp.zeros_like(here.loads)
    no = jnp.zeros((), bool)
    begin = Search(here, factors, step, zero, zero, none, none, no)
    return lax.while_loop(unfinished, improve, begin)


@partial(jax.jit, static_argnames="in_kernel")
def _place(problem: RestProblem, configuration: Any, in_kernel: bool) -> Any:
    """Result of `problem.place`, compiled so that it is traced once for all calls.

    The trace of a part of a kernel (`in_kernel`) has no kernels of its own.
    """
    del in_kernel
    return problem.place(configuration)
