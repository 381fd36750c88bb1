r"""Least squares of trajectories in windows that are joined while it is sought.

Unknowns are what all trajectories share, $p$, and what the first state of each is made
of, $s$; states at the starts of windows are iterates with gaps between them, and
directions of theirs are carried from window to window (`follow_windows`). A step makes
$\sum_w \| r_w + J_w (\delta p, \delta s) + J_w^x c_w \|^2$ least, with the shape of an
arrow over trajectories (`arrow_step`), and moves all states along. Gaps close as the
square of their size: at the end the windows are one run, found without the growth of
errors along one.

A step is taken if $\sum_w \| r_w + J_w^x c_w \|^2 + \| J_w^x g_w \|^2$ falls: the
residuals as they are when gaps are closed, to first order, and the gaps by what they do
to the observations of their own windows. Otherwise the damping rises and the step is
cut in half. Nothing says that a small enough step is taken: where gaps are so large
that closing them changes slopes, the search stops with gaps open.

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

from jaxrod.control.arrow import arrow_step, in_order_of_leaves, projected
from jaxrod.control.follow_windows import (
    JoinedPoint,
    JoinedSlopes,
    follow_windows,
)
from jaxrod.control.least_squares import MOST_DAMPING
from jaxrod.control.local_least_squares import next_damping
from jaxrod.structure import pytree


@pytree
class JoinedLeastSquares:
    """The best point that was found."""

    solution: Float[Array, " shared"]
    """Shared unknowns."""
    own: Any
    """Own unknowns, stacked in front by trajectory, as they were given."""
    states: Any
    """Initial states of windows, stacked in front by trajectory and window."""
    residuals: Float[Array, " residuals"]
    """Those of the solution with gaps closed to first order, leaf after leaf."""
    jacobian: Float[Array, "residuals shared"]
    """By the shared unknowns, less what own ones could make good."""
    gap: Float[Array, ""]
    """What closing the gaps changes in all residuals, their norm."""
    iterations: Int[Array, ""]
    """Points tried after the first."""


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
    """Unknowns that make the sum of squares of joined windows least. Pure; traceable.

    Args:
        residuals: Takes shared unknowns, a window's initial state and what is known of
            the window; makes its residuals, any pytree of floats, and the state at its
            end.
        begin: Takes shared unknowns, a trajectory's own ones and what is known of its
            first window; makes the state there.
        start: Where the shared unknowns begin.
        own: Where the own unknowns begin, floats stacked in front by trajectory.
        states: Where states at the starts of windows begin, floats stacked in front by
            trajectory and window; those of first windows are not looked at.
        known: What is known of each window, stacked alike.
        lower: Smallest values of the shared unknowns.
        upper: Largest ones.
        damping: Of the first step, a share of the diagonal [1].
        iterations: Points tried after the first, at most.
        tolerance: Relative change of the cost below which it is done; by default eps to
            the power of 3/4 of the precision.

    Returns:
        The best point; one that is not finite is never taken.
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
    """Rows of trajectories, window after window."""
    return jnp.reshape(windows, (windows.shape[0], -1, *windows.shape[3:]))


def _stepped(
    point: JoinedPoint,
    slopes: JoinedSlopes,
    mu: Any,
    share: Any,
    low: Array,
    high: Array,
) -> JoinedPoint:
    """A share of the damped step from a point, and of the closing of gaps."""
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
