r"""Newton's method for a system at rest, with inertia where it is needed.

A full correction $K r = g$ is tried, and judged by the correction that would be left.
If that is too large, or if the correction goes against the loads, the members are given
inertia: $(K + s M)\,r = g$ is one implicit step of a motion that stops again at once.
The factor $s$ shrinks to zero as the corrections become better. Such steps follow the
way that loads push, past folds, to an equilibrium that is stable.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxrod.structure import pytree
from jaxrod.systems.statics.loose_motions import are_driven, held, loose_motions
from jaxrod.systems.statics.problem import Linear, StaticProblem, is_displacement
from jaxrod.systems.stepping.stepper import Motions

LARGEST_TURN = 1.0
"""Largest rotation in one correction [rad]."""
LARGEST_DISPLACEMENT = 1.0
"""Largest displacement in one correction, over the length of the longest rod [1]."""
LEFT = 0.75
"""Largest correction that may be left after one that is taken, over this one [1]."""
LITTLE = 0.1
"""The same, below which inertia shrinks fast [1]."""

STALLED = 10
"""Multiple of the tolerance below which a search that no longer gets on is done [1]."""
FASTEST, SLOWEST = 0.1, 0.75
"""Factors by which inertia shrinks [1]."""


@pytree
class Search:
    """State of Newton's method: the configuration, and the correction to try next."""

    here: Linear
    """The problem at the configuration."""
    stiffness: Float[Array, "m m"]
    """Stiffness, regular for rates that are not allowed and for loose motions [J]."""
    loose: Float[Array, "modes m"]
    """Motions that nothing resists; zeros in place of others."""
    driven: Bool[Array, ""]
    """Whether loads drive one of them."""
    factors: tuple[Array, Array]
    """Factors of the matrix of the correction."""
    step: Float[Array, " m"]
    """Full correction, in scaled rates."""
    share: Float[Array, ""]
    """Share of it that is tried [1]."""
    inertia: Float[Array, ""]
    """Factor of the mass [1/s^2]."""
    shrinking: Float[Array, ""]
    """Factor by which it shrinks after a good correction [1]."""
    trials: Int[Array, ""]
    """Number of corrections tried."""
    iterations: Int[Array, ""]
    """Number of corrections taken."""
    converged: Bool[Array, ""]
    """Whether the last correction was below the tolerance."""


def newton(
    problem: StaticProblem, start: Motions, tolerance: Array, max_iterations: Array
) -> Search:
    """Searches for the configuration at which loads balance.

    Args:
        problem: The static problem.
        start: Configuration to start from.
        tolerance: The search ends after a correction of less than this many element
            lengths and radians.
        max_iterations: Largest number of corrections tried, accepted or not.
    """
    displaced = is_displacement(start)
    count, dtype = displaced.size, problem.system.dtype
    fine = jnp.where(displaced, problem.scales.length / problem.scales.element, 1)
    most = jnp.where(displaced, LARGEST_DISPLACEMENT, LARGEST_TURN)

    def size(step: Array) -> Array:
        return jnp.sqrt(jnp.sum(step * step))

    def unfinished(search: Search) -> Array:
        # Written so that a correction that is not finite ends the search.
        going = (search.trials == 0) | (size(search.step) < jnp.inf)
        return going & ~search.converged & (search.trials <= max_iterations)

    def improve(search: Search) -> Search:
        before, step, share = search.here, search.step, search.share
        moved = problem.moved_along_edges(before, share * step, search.loose)
        here = problem.linear(moved)
        pushed = search.inertia * before.mass @ step
        expected = (1 - share) * before.loads + share * pushed
        left = jax.scipy.linalg.lu_solve(search.factors, here.loads - expected)
        ratio = size(left) / (share * size(step))
        work = jnp.dot(step, before.loads)
        first = search.trials == 0
        # Below the tolerance what is left may be round-off. So it is a little above it,
        # where it no longer shrinks.
        largest = jnp.max(jnp.abs(share * step) * fine)
        little = (largest <= tolerance) | (
            (largest <= STALLED * tolerance) & (ratio > LEFT)
        )
        done = ~first & little & (search.inertia == 0) & ~search.driven
        taken = first | done | ((ratio <= LEFT) & (work > 0))
        own = jnp.dot(step, before.mass @ step)
        resisted = jnp.abs(work - search.inertia * own)
        fast = ratio <= LITTLE
        lower = search.inertia * jnp.where(fast, search.shrinking, 0.5)
        lower = jnp.where(lower * own < 1e-4 * resisted, 0, lower)
        # Where less inertia was too little, it shrinks more slowly.
        slower = jnp.minimum(jnp.sqrt(search.shrinking), SLOWEST)
        faster = jnp.maximum(search.shrinking**2, FASTEST)
        shrinking = jnp.where(taken, jnp.where(fast, faster, search.shrinking), slower)
        higher = jnp.maximum(search.inertia / shrinking, resisted / own)
        inertia = jnp.where(taken, lower, higher)
        inertia = jnp.where(first, 0, inertia)
        here = jax.tree.map(lambda a, b: jnp.where(taken, a, b), here, before)
        loose = loose_motions(problem, here)
        stiffness = held(problem, here, loose)
        factors = jax.scipy.linalg.lu_factor(stiffness + inertia * here.mass)
        step = jax.scipy.linalg.lu_solve(factors, here.loads)
        return Search(
            here=here,
            stiffness=stiffness,
            loose=loose,
            driven=are_driven(problem, here, loose),
            factors=factors,
            step=step,
            share=1 / jnp.maximum(1, jnp.max(jnp.abs(step) / most)),
            inertia=inertia,
            shrinking=jnp.where(first, FASTEST, shrinking),
            trials=search.trials + 1,
            iterations=search.iterations + (taken & ~first),
            converged=done,
        )

    none, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    zero, vector = jnp.zeros((), dtype), jnp.zeros(count, dtype)
    one = jnp.eye(count, dtype=dtype)
    here = Linear(start, vector, one, one, one)
    factors = one, jnp.arange(count, dtype=jnp.int32)
    # The first trial is the start itself.
    modes = len(jax.eval_shape(problem.motions_of_the_whole, start))
    loose = jnp.zeros((modes, count), dtype)
    begin = Search(
        here, one, loose, no, factors, vector, zero, zero, zero, none, none, no
    )
    return lax.while_loop(unfinished, improve, begin)
