r"""Least squares with unknowns that all parts share and unknowns of each part.

Part $w$ has residuals $r_w(p, s_w)$: $p$ is shared, $s_w$ its own. The Jacobian has the
shape of an arrow, and a damped Gauss-Newton step is found part by part: with
$S_w = \partial r_w / \partial s_w$ and the damping below it,

$$\begin{pmatrix} S_w \\ \sqrt{\mu D_w} \end{pmatrix} = Q_w R_w, \qquad
\min_d \sum_w \Big\| (I - Q_w Q_w^T) \begin{pmatrix} r_w + P_w d \\ 0 \end{pmatrix}
\Big\|^2 + \mu \| D^{1/2} d \|^2,$$

$P_w = \partial r_w / \partial p$; own unknowns follow from $R_w$. The cost is that of
one part's unknowns for all parts, not of all unknowns. What is left of $P_w$ after the
projection (without damping) is the Jacobian of the shared unknowns when the own ones
always are at their best: its singular values say how surely $p$ is known.

Source: G. H. Golub, V. Pereyra, The differentiation of pseudo-inverses and nonlinear
least squares problems whose variables separate, 1973; B. Triggs et al., Bundle
adjustment, 2000, section 6.1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxrod.control.least_squares import FASTER, MOST_DAMPING, SLOWER
from jaxrod.structure import pytree

LEAST_DAMPING = 1e-6
"""Below it nothing is won, and too small a one costs rejected steps to raise again."""


@pytree
class LocalLeastSquares:
    """The best point that was found."""

    solution: Float[Array, " shared"]
    """Shared unknowns."""
    own: Any
    """Own unknowns, stacked in front by part, as they were given."""
    residuals: Float[Array, " residuals"]
    """Those of the solution, leaf after leaf of the stacked tree."""
    jacobian: Float[Array, "residuals shared"]
    """By the shared unknowns, less what own ones could make good."""
    iterations: Int[Array, ""]
    """Points tried after the first."""


@pytree
class _Search:
    shared: Array
    own: Array
    residuals: Array
    jacobian: Array
    cost: Array
    damping: Array
    next_shared: Array
    next_own: Array
    tried: Array
    converged: Bool[Array, ""]


def local_least_squares(
    residuals: Callable[[Array, Any, Any], Any],
    start: Float[Array, " shared"],
    own: Any,
    known: Any,
    *,
    lower: Array,
    upper: Array,
    damping: Any = 1e-3,
    iterations: int = 50,
    tolerance: Any = None,
) -> LocalLeastSquares:
    """Unknowns that make the sum of squares of all parts least. Pure; traceable.

    Args:
        residuals: Takes shared unknowns, one part's own ones and what is known of it;
            makes its residuals, any pytree of floats.
        start: Where the shared unknowns begin.
        own: Where the own unknowns begin, a pytree of floats stacked in front by part.
        known: What is known of each part, stacked alike.
        lower: Smallest values of the shared unknowns.
        upper: Largest ones.
        damping: Of the first step, a share of the diagonal [1].
        iterations: Points tried after the first, at most.
        tolerance: Relative change of the cost below which it is done; by default eps to
            the power of 3/4 of the precision.

    Returns:
        The best point; one whose residuals are not all finite is never taken.
    """
    dtype = start.dtype
    small = float(jnp.finfo(dtype).eps) ** 0.75 if tolerance is None else tolerance
    shares = start.size
    _, as_own = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], own))
    first_own = jax.vmap(lambda part: ravel_pytree(part)[0])(own).astype(dtype)

    def one(shared: Array, mine: Array, given: Any) -> tuple[Array, Array]:
        def flat(point: Array) -> Array:
            made = residuals(point[:shares], as_own(point[shares:]), given)
            return ravel_pytree(made)[0]

        point = jnp.concatenate([shared, mine])

        def column(way: Array) -> tuple[Array, Array]:
            return jax.jvp(flat, (point,), (way,))

        return jax.vmap(column, out_axes=(None, 1))(jnp.eye(point.size, dtype=dtype))

    evaluated = jax.vmap(one, in_axes=(None, 0, 0))

    def more(search: _Search) -> Array:
        going = (search.tried <= iterations) & ~search.converged
        return going & (search.damping < MOST_DAMPING)

    def again(search: _Search) -> _Search:
        values, slopes = evaluated(search.next_shared, search.next_own, known)
        cost = jnp.sum(values**2)
        sound = jnp.isfinite(cost) & jnp.all(jnp.isfinite(slopes))
        better = sound & (cost < search.cost)
        begun = search.tried > 0
        gained = jnp.abs(search.cost - cost) <= small * search.cost

        def best(new: Array, old: Array) -> Array:
            return jnp.where(better, new, old)

        shared = best(search.next_shared, search.shared)
        mine = best(search.next_own, search.own)
        now = best(values, search.residuals)
        jacobian = best(slopes, search.jacobian)
        change = jnp.where(better, 1 / FASTER, SLOWER)
        mu = jnp.where(begun, search.damping * change, search.damping)
        mu = jnp.maximum(mu, LEAST_DAMPING)
        step, own_steps = _step(jacobian, now, mu, shared, lower, upper)
        return _Search(
            shared=shared,
            own=mine,
            residuals=now,
            jacobian=jacobian,
            cost=best(cost, search.cost),
            damping=jnp.asarray(mu, dtype),
            next_shared=jnp.clip(shared + step, lower, upper),
            next_own=mine + own_steps,
            tried=search.tried + 1,
            converged=begun & sound & gained,
        )

    begin = jnp.clip(start, lower, upper)
    shapes = jax.eval_shape(evaluated, begin, first_own, known)
    found = lax.while_loop(
        more,
        again,
        _Search(
            shared=begin,
            own=first_own,
            residuals=jnp.full(shapes[0].shape, jnp.inf, dtype),
            jacobian=jnp.zeros(shapes[1].shape, dtype),
            cost=jnp.asarray(jnp.inf, dtype),
            damping=jnp.asarray(damping, dtype),
            next_shared=begin,
            next_own=first_own,
            tried=jnp.zeros((), jnp.int32),
            converged=jnp.zeros((), bool),
        ),
    )
    left = jax.vmap(lambda slopes: _projected(slopes, jnp.finfo(dtype).eps, shares)[0])(
        found.jacobian
    )
    like = jax.eval_shape(
        residuals,
        begin,
        jax.tree.map(lambda leaf: leaf[0], own),
        jax.tree.map(lambda leaf: leaf[0], known),
    )
    ordered = _order(like)
    return LocalLeastSquares(
        solution=found.shared,
        own=jax.vmap(as_own)(found.own),
        residuals=ordered(found.residuals),
        jacobian=jax.vmap(ordered, in_axes=2, out_axes=1)(left),
        iterations=found.tried - 1,
    )


def _order(like: Any) -> Callable[[Array], Array]:
    """Makes rows of parts into one, leaf after leaf of what is stacked."""
    sizes = [leaf.size for leaf in jax.tree.leaves(like)]

    def ordered(rows: Array) -> Array:
        made, at = [], 0
        for size in sizes:
            made.append(jnp.ravel(rows[:, at : at + size]))
            at += size
        return jnp.concatenate(made)

    return ordered


def _projected(slopes: Array, mu: Any, shares: int) -> tuple[Array, Array, Array]:
    """Shared columns less what own ones make good, and Q and R of those, damped."""
    ours, mine = slopes[:, :shares], slopes[:, shares:]
    squares = jnp.sum(mine**2, axis=0)
    none = squares <= jnp.finfo(slopes.dtype).tiny
    roots = jnp.sqrt(mu * jnp.where(none, 1, squares))
    q, r = jnp.linalg.qr(jnp.concatenate([mine, jnp.diag(roots)]))
    top = q[: mine.shape[0]]
    return ours - top @ (top.T @ ours), q, r


def _step(
    jacobian: Array, residuals: Array, mu: Array, point: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """The damped Gauss-Newton step of shared and own unknowns."""
    shares, dtype = point.size, jacobian.dtype

    def eliminated(slopes: Array, values: Array) -> tuple[Array, ...]:
        _, q, r = _projected(slopes, mu, shares)
        none = jnp.zeros((q.shape[0] - values.size, shares + 1), dtype)
        both = jnp.concatenate([slopes[:, :shares], values[:, None]], axis=1)
        both = jnp.concatenate([both, none])
        along = q.T @ both
        return both - q @ along, along, r

    rest, along, r = jax.vmap(eliminated)(jacobian, residuals)
    rows = jnp.reshape(rest, (-1, shares + 1))
    ours, values = rows[:, :shares], rows[:, shares]
    slope = ours.T @ values
    held = ((point <= low) & (slope > 0)) | ((point >= high) & (slope < 0))
    free = jnp.where(held, 0, 1).astype(dtype)
    ours = ours * free[None]
    squares = jnp.sum(jacobian[..., :shares] ** 2, axis=(0, 1)) * free
    none = squares <= jnp.finfo(dtype).tiny
    roots = jnp.sqrt(mu * jnp.where(none, 1, squares))
    triangle = jnp.linalg.qr(
        jnp.concatenate(
            [
                jnp.concatenate([ours, values[:, None]], axis=1),
                jnp.concatenate([jnp.diag(roots), jnp.zeros((shares, 1), dtype)], 1),
            ]
        ),
        mode="r",
    )
    step = -solve_triangular(triangle[:shares, :shares], triangle[:shares, shares])
    step = step * free
    sides = -(along[..., shares] + along[..., :shares] @ step)
    return step, jax.vmap(solve_triangular)(r, sides)
