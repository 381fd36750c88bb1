r"""Least squares of trajectories cut into windows, whose gaps close during the search.

The unknowns are those shared by all trajectories, $p$, and those of the first state of
each trajectory, $s$. The initial states of windows are iterates with gaps between them,
and their derivatives are propagated from window to window (`follow_windows`). A step
minimises $\sum_w \| r_w + J_w (\delta p, \delta s) + J_w^x c_w \|^2$, with an arrow
structure over trajectories (`arrow_step`), and updates all initial states to first
order. Gaps converge quadratically. At the end the windows are one run, which was found
without the growth of errors along a single run.

A step is accepted if $\sum_w \| r_w + J_w^x c_w \|^2 + \| J_w^x g_w \|^2$ falls. The
first term has the residuals after the gaps are closed, to first order; the second
measures each gap by its effect on the observations of its own window. Otherwise the
damping rises and the step is halved. There is no guarantee that a small enough step is
accepted: if gaps are so large that closing them changes the derivatives, the search
stops with open gaps.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983; J. Albersmeyer, M. Diehl, The lifted Newton method and its application in
optimization, 2010.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jaxrod.control.identification.arrow import (
    arrow_step,
    in_order_of_leaves,
    projected,
)
from jaxrod.control.identification.follow_windows import (
    JoinedPoint,
    JoinedSlopes,
    follow_windows,
)
from jaxrod.control.identification.local_least_squares import next_damping
from jaxrod.control.least_squares import MOST_DAMPING
from jaxrod.structure import pytree


@pytree
class JoinedLeastSquares:
    """The best point that was found."""

    solution: Float[Array, " shared"]
    """Shared unknowns."""
    own: Any
    """Own unknowns as a tree like the start, stacked by trajectory."""
    states: Any
    """Initial states of windows, stacked by trajectory and window."""
    residuals: Float[Array, " residuals"]
    """Residuals of the solution, leaf after leaf, with gaps closed to first order."""
    jacobian: Float[Array, "residuals shared"]
    """Jacobian by the shared unknowns, projected orthogonally to that of the own
    unknowns."""
    gap: Float[Array, ""]
    """Norm of the change of all residuals when the gaps are closed."""
    iterations: Int[Array, ""]
    """Number of points tried after the first."""


@pytree
class _Search:
    best: JoinedPoint
    slopes: JoinedSlopes
    cost: Array
    damping: Array
    share: Array
    candidate: JoinedPoint
    tried: Array
    converged: Bool[Array, ""]


def joined_least_squares(
    residuals: Callable[[Array, Any, Any], tuple[Any, Any]],
    begin: Callable[[Array, Any, Any], Any],
    start: Float[Array, " shared"],
    own: Any,
    states: Any,
    known: Any,
    *,
    lower: Array,
    upper: Array,
    damping: Any = 1e-2,
    iterations: int = 50,
    tolerance: Any = None,
) -> JoinedLeastSquares:
    """Minimises the sum of squares of joined windows. Pure; traceable.

    Args:
        residuals: Takes shared unknowns, a window's initial state and its known data;
            returns the window's residuals, any pytree of floats, and the state at its
            end.
        begin: Takes shared unknowns, a trajectory's own unknowns and the known data of
            its first window; returns the initial state of that window.
        start: First values of the shared unknowns.
        own: First values of the own unknowns, floats stacked by trajectory on the
            leading axis.
        states: First values of the initial states of windows, floats stacked by
            trajectory and window on the leading axes; those of first windows are
            ignored.
        known: Known data of each window, stacked the same way.
        lower: Lower bounds of the shared unknowns.
        upper: Upper bounds of the shared unknowns.
        damping: Damping of the first step, as a fraction of the diagonal [1].
        iterations: Largest number of points tried after the first.
        tolerance: Relative change of the cost at which the search ends; by default
            machine epsilon to the power of 3/4.

    Returns:
        The best point; a point that is not finite is never accepted.
    """
    dtype = start.dtype
    small = float(jnp.finfo(dtype).eps) ** 0.75 if tolerance is None else tolerance
    shares = start.size
    _, as_own = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], own))
    _, as_state = ravel_pytree(jax.tree.map(lambda leaf: leaf[0, 0], states))
    first = JoinedPoint(
        jnp.clip(start, lower, upper),
        jax.vmap(lambda part: ravel_pytree(part)[0])(own).astype(dtype),
        jax.vmap(jax.vmap(lambda part: ravel_pytree(part)[0]))(states).astype(dtype),
    )

    def opening(shared: Array, mine: Array, given: Any) -> Array:
        return ravel_pytree(begin(shared, as_own(mine), given))[0].astype(dtype)

    def window(shared: Array, state: Array, given: Any) -> tuple[Array, Array]:
        made, end = residuals(shared, as_state(state), given)
        return ravel_pytree(made)[0], ravel_pytree(end)[0].astype(dtype)

    one = follow_windows(opening, window)

    def evaluated(point: JoinedPoint, known: Any) -> tuple[Array, JoinedSlopes]:
        def alone(own: Array, states: Array, known: Any) -> tuple[Array, JoinedSlopes]:
            return one(JoinedPoint(point.shared, own, states), known)

        return jax.vmap(alone)(point.own, point.states, known)

    def more(search: _Search) -> Array:
        going = (search.tried <= iterations) & ~search.converged
        return going & (search.damping < MOST_DAMPING)

    def again(search: _Search) -> _Search:
        states, slopes = evaluated(search.candidate, known)
        point = JoinedPoint(search.candidate.shared, search.candidate.own, states)
        cost = jnp.sum(slopes.closed**2) + jnp.sum(slopes.jump**2)
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(slopes)]
        sound = jnp.isfinite(cost) & jnp.all(jnp.stack(finite))
        better = sound & (cost < search.cost)
        begun = search.tried > 0
        gained = jnp.abs(search.cost - cost) <= small * search.cost

        def kept(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)

        best, slopes = kept((point, slopes), (search.best, search.slopes))
        mu = next_damping(search.damping, begun, better)
        change = jnp.where(better, 2.0, 0.5)
        share = jnp.where(begun, jnp.minimum(1, search.share * change), search.share)
        return _Search(
            best=best,
            slopes=slopes,
            cost=jnp.where(better, cost, search.cost),
            damping=jnp.asarray(mu, dtype),
            share=jnp.asarray(share, dtype),
            candidate=_stepped(best, slopes, mu, share, lower, upper),
            tried=search.tried + 1,
            converged=begun & sound & gained & (search.share == 1),
        )

    shapes = jax.eval_shape(evaluated, first, known)[1]
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, dtype), shapes)
    infinite = jnp.full(shapes.residuals.shape, jnp.inf, dtype)
    found = lax.while_loop(
        more,
        again,
        _Search(
            best=first,
            slopes=replace(nothing, residuals=infinite),
            cost=jnp.asarray(jnp.inf, dtype),
            damping=jnp.asarray(damping, dtype),
            share=jnp.ones((), dtype),
            candidate=first,
            tried=jnp.zeros((), jnp.int32),
            converged=jnp.zeros((), bool),
        ),
    )
    slopes = found.slopes
    left = jax.vmap(lambda rows: projected(rows, jnp.finfo(dtype).eps, shares)[0])(
        _rows(slopes.jacobian)
    )
    alone = jax.tree.map(lambda leaf: leaf[0, 0], (states, known))
    like = jax.eval_shape(lambda p, x, k: residuals(p, x, k)[0], first.shared, *alone)
    ordered = in_order_of_leaves(like)
    width = slopes.residuals.shape[-1]
    return JoinedLeastSquares(
        solution=found.best.shared,
        own=jax.vmap(as_own)(found.best.own),
        states=jax.vmap(jax.vmap(as_state))(found.best.states),
        residuals=ordered(jnp.reshape(slopes.closed, (-1, width))),
        jacobian=jax.vmap(ordered, in_axes=2, out_axes=1)(
            jnp.reshape(left, (-1, width, shares))
        ),
        gap=jnp.sqrt(jnp.sum(slopes.closing**2)),
        iterations=found.tried - 1,
    )


def _rows(windows: Array) -> Array:
    """Joins the window and residual axes, so that each trajectory has one row axis."""
    return jnp.reshape(windows, (windows.shape[0], -1, *windows.shape[3:]))


def _stepped(
    point: JoinedPoint,
    slopes: JoinedSlopes,
    mu: Any,
    share: Any,
    low: Array,
    high: Array,
) -> JoinedPoint:
    """Takes a fraction of the damped step from a point, and of closing the gaps."""
    step, own_steps = arrow_step(
        _rows(slopes.jacobian), _rows(slopes.closed), mu, point.shared, low, high
    )
    shared = jnp.clip(point.shared + share * step, low, high)
    moved = jnp.broadcast_to(shared - point.shared, (len(own_steps), shared.size))
    unknowns = jnp.concatenate([moved, share * own_steps], axis=1)
    along = jnp.einsum("twsu,tu->tws", slopes.ways, unknowns)
    return JoinedPoint(
        shared,
        point.own + share * own_steps,
        point.states + along + share * slopes.shift,
    )
