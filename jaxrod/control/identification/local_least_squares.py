r"""Least squares with unknowns that all parts share and unknowns of each part.

Part $w$ has residuals $r_w(p, s_w)$ of shared unknowns $p$ and its own unknowns $s_w$.
Damped Gauss-Newton steps are computed part by part (`arrow_step`); the rest is as in
`least_squares`.

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
from jaxtyping import Array, Bool, Float, Int

from jaxrod.control.identification.arrow import (
    arrow_step,
    in_order_of_leaves,
    projected,
)
from jaxrod.control.least_squares import FASTER, MOST_DAMPING, SLOWER
from jaxrod.structure import pytree

LEAST_DAMPING = 1e-6
"""Smallest damping: less gains nothing, and costs rejected steps to raise it again."""


def next_damping(damping: Array, begun: Array, better: Array) -> Array:
    """Returns less damping after an accepted point, and more after a rejected one [1].

    Args:
        damping: Last damping.
        begun: Whether a step was tried; if not, the damping stays as given.
        better: Whether the step was accepted.
    """
    change = jnp.where(better, 1 / FASTER, SLOWER)
    return jnp.maximum(jnp.where(begun, damping * change, damping), LEAST_DAMPING)


@pytree
class LocalLeastSquares:
    """The best point that was found."""

    solution: Float[Array, " shared"]
    """Shared unknowns."""
    own: Any
    """Own unknowns as a tree like the start, stacked by part."""
    residuals: Float[Array, " residuals"]
    """Residuals of the solution, leaf after leaf of the stacked tree."""
    jacobian: Float[Array, "residuals shared"]
    """Jacobian by the shared unknowns, projected orthogonally to that of the own
    unknowns."""
    iterations: Int[Array, ""]
    """Number of points tried after the first."""


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
    """Minimises the sum of squares of all parts. Pure; traceable.

    Args:
        residuals: Takes shared unknowns, a part's own unknowns and its known data;
            returns the part's residuals, any pytree of floats.
        start: First values of the shared unknowns.
        own: First values of the own unknowns, a pytree of floats stacked by part on the
            leading axis.
        known: Known data of each part, stacked the same way.
        lower: Lower bounds of the shared unknowns.
        upper: Upper bounds of the shared unknowns.
        damping: Damping of the first step, as a fraction of the diagonal [1].
        iterations: Largest number of points tried after the first.
        tolerance: Relative change of the cost at which the search ends; by default
            machine epsilon to the power of 3/4.

    Returns:
        The best point; a point whose residuals are not all finite is never accepted.
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
        mu = next_damping(search.damping, begun, better)
        step, own_steps = arrow_step(jacobian, now, mu, shared, lower, upper)
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
    left = jax.vmap(lambda slopes: projected(slopes, jnp.finfo(dtype).eps, shares)[0])(
        found.jacobian
    )
    like = jax.eval_shape(
        residuals,
        begin,
        jax.tree.map(lambda leaf: leaf[0], own),
        jax.tree.map(lambda leaf: leaf[0], known),
    )
    ordered = in_order_of_leaves(like)
    return LocalLeastSquares(
        solution=found.shared,
        own=jax.vmap(as_own)(found.own),
        residuals=ordered(found.residuals),
        jacobian=jax.vmap(ordered, in_axes=2, out_axes=1)(left),
        iterations=found.tried - 1,
    )
