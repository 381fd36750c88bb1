r"""Least squares within bounds, by damped Gauss-Newton steps (Levenberg, Marquardt).

With residuals $r(z)$, their Jacobian $J$ and a ridge $\rho$ about $z_0$, a step solves

$$(J^T J + \rho I + \mu D)\, d = -\big(J^T r + \rho (z - z_0)\big), \qquad
D = \mathrm{diag}(J^T J) + \rho I$$

over the unknowns that are not held at a bound, and is cut off at the bounds. It is
taken if the sum of squares falls; then $\mu$ is divided by 3, and multiplied by 4
otherwise. Or six steps, for dampings around that of the last one (`LADDER`), are tried
as one batch: the best is taken if the sum of squares falls, and otherwise the next six
have more damping.

Jacobians are columns by forward mode where there are fewer unknowns than residuals, and
rows by reverse mode otherwise; the ridge costs neither, so that six residuals of 132
unknowns are six rows. Everything is one program: `jax.vmap` solves many problems at
once, and nothing is compiled again for other numbers.

Source: K. Madsen, H. B. Nielsen, O. Tingleff, Methods for non-linear least squares
problems, 2nd edition, 2004, section 3.2; bounds by projection.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxrod.structure import pytree

FASTER, SLOWER = 3.0, 4.0
"""Divisor of the damping after a step that is taken, and factor otherwise."""
LADDER = (64.0, 16.0, 4.0, 1.0, 1 / 4, 1 / 16)
"""Dampings that are tried at once, in those of the last step [1]; the most is first."""
MOST_DAMPING = 1e12
"""With more of it no step is worth trying."""


@pytree
class LeastSquares:
    """The best point that was found, and the way there."""

    solution: Any
    """The unknowns, as they were given."""
    residuals: Float[Array, " residuals"]
    """Those of the solution."""
    jacobian: Float[Array, "residuals unknowns"]
    """Their derivatives there, by the unknowns one after the other."""
    cost: Float[Array, ""]
    """Sum of squares there, the ridge included."""
    converged: Bool[Array, ""]
    """Whether a step would change the cost, or the solution, by less than asked."""
    iterations: Int[Array, ""]
    """Iterations that were made; the first looks at the start."""
    costs: Float[Array, " iterations"]
    """Cost of the best point after each of them; NaN where there was none."""


@pytree
class _Search:
    point: Array
    residuals: Array
    jacobian: Array
    cost: Array
    damping: Array
    candidate: Array
    tried: Array
    converged: Array
    costs: Array


def least_squares(
    residuals: Callable[[Any], Any],
    start: Any,
    *,
    lower: Any = None,
    upper: Any = None,
    ridge: Any = 0.0,
    centre: Any = None,
    damping: Any = 1e-3,
    iterations: int = 50,
    tolerance: float | None = None,
    mode: str | None = None,
    several: bool = False,
) -> LeastSquares:
    """Unknowns that make the sum of squares of residuals least. Pure; traceable.

    Args:
        residuals: Takes unknowns, makes residuals: any pytree of floats.
        start: Where to begin, any pytree of floats.
        lower: Smallest values of the unknowns, a number or as `start`; none if `None`.
        upper: Largest ones.
        ridge: Cost of the squared distance of the unknowns from `centre`, a number or
            as `start`.
        centre: What the ridge pulls to, a number or as `start`; `start` by default.
        damping: Of the first step, a share of the diagonal [1].
        iterations: Iterations, at most.
        tolerance: Relative change of the cost, or of every unknown, below which it is
            done; by default eps to the power of 3/4 of the precision.
        mode: `"forward"` or `"reverse"`, how Jacobians are made; by default whichever
            needs fewer passes.
        several: Whether each iteration tries six dampings as a batch. This pays where
            a batch of residuals costs hardly more than one set of them, as in
            trajectories; not where residuals are solved for, as in equilibria.

    Returns:
        The best point; one whose residuals are not all finite is never taken.

    Raises:
        ValueError: `mode` is neither, or there is nothing to find.
    """
    if mode not in (None, "forward", "reverse"):
        raise ValueError(f'mode must be "forward" or "reverse", got {mode!r}')
    first, unravel = ravel_pytree(start)
    if first.size == 0:
        raise ValueError("start must have at least one number")

    def flat(point: Array) -> Array:
        return ravel_pytree(residuals(unravel(point)))[0]

    count = math.prod(jax.eval_shape(flat, first).shape)
    dtype = first.dtype
    low, high = (_like(bound, start, sign) for bound, sign in ((lower, -1), (upper, 1)))
    rho = jnp.broadcast_to(_like(ridge, start, 0), first.shape)
    middle = first if centre is None else _like(centre, start, 0)
    small = float(jnp.finfo(dtype).eps) ** 0.75 if tolerance is None else tolerance
    forward = mode == "forward" or (mode is None and first.size <= count)
    ladder = jnp.asarray(LADDER, dtype)
    evaluated = _by_columns(flat) if forward else _by_rows(flat)

    def total(values: Array, point: Array) -> Array:
        return jnp.sum(values**2) + jnp.sum(rho * (point - middle) ** 2)

    def more(search: _Search) -> Array:
        going = (search.tried <= iterations) & ~search.converged
        return going & (search.damping < MOST_DAMPING)

    def again(search: _Search) -> _Search:
        values, slopes = evaluated(search.candidate)
        cost = total(values, search.candidate)
        sound = jnp.isfinite(cost) & jnp.all(jnp.isfinite(slopes))
        better = sound & (cost < search.cost)
        begun = search.tried > 0
        # Each by itself: unknowns have units of their own.
        moved = jnp.abs(search.candidate - search.point)
        scale = jnp.abs(search.point) + jnp.abs(search.candidate)
        still = jnp.all(moved <= small * scale) & sound
        gained = (search.cost - cost) <= small * search.cost
        done = begun & (still | (better & gained))
        point = jnp.where(better, search.candidate, search.point)
        now = jnp.where(better, values, search.residuals)
        jacobian = jnp.where(better, slopes, search.jacobian)
        least = jnp.where(better, cost, search.cost)

        def stepped(mu: Array) -> Array:
            pull = rho * (point - middle)
            step = _step(jacobian, now, rho, pull, mu, point, low, high)
            return jnp.clip(point + step, low, high)

        def best_of_six() -> tuple[Array, Array]:
            # Beyond all that failed; not zero, from which no factor leads back.
            mu = search.damping * jnp.where(begun & ~better, ladder[0], 1)
            dampings = jnp.maximum(mu, jnp.finfo(dtype).eps) * ladder
            candidates = jax.vmap(stepped)(dampings)
            costs = jax.vmap(lambda z: total(flat(z), z))(candidates)
            # Where none is finite the shortest step is the best guess.
            best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
            chosen = jnp.arange(ladder.size) == best
            candidate = jnp.sum(jnp.where(chosen[:, None], candidates, 0), axis=0)
            return jnp.sum(jnp.where(chosen, dampings, 0)), candidate

        def next_one() -> tuple[Array, Array]:
            change = jnp.where(better, 1 / FASTER, SLOWER)
            mu = jnp.where(begun, search.damping * change, search.damping)
            mu = jnp.asarray(mu, dtype)
            return mu, stepped(mu)

        mu, candidate = best_of_six() if several else next_one()
        return _Search(
            point=point,
            residuals=now,
            jacobian=jacobian,
            cost=least,
            damping=mu,
            candidate=candidate,
            tried=search.tried + 1,
            converged=done,
            costs=search.costs.at[search.tried].set(least),
        )

    begin = jnp.clip(first, low, high)
    found = lax.while_loop(
        more,
        again,
        _Search(
            point=begin,
            residuals=jnp.full((count,), jnp.inf, dtype),
            jacobian=jnp.zeros((count, first.size), dtype),
            cost=jnp.asarray(jnp.inf, dtype),
            damping=jnp.asarray(damping, dtype),
            candidate=begin,
            tried=jnp.zeros((), jnp.int32),
            converged=jnp.zeros((), bool),
            costs=jnp.full((iterations + 1,), jnp.nan, dtype),
        ),
    )
    return LeastSquares(
        solution=unravel(found.point),
        residuals=found.residuals,
        jacobian=found.jacobian,
        cost=found.cost,
        converged=found.converged,
        iterations=found.tried - 1,
        costs=found.costs,
    )


def _like(bound: Any, start: Any, sign: int) -> Array:
    """A number, or a tree as the unknowns are, as one row; infinite without one."""
    first, _ = ravel_pytree(start)
    if bound is None:
        return jnp.full(first.shape, sign * jnp.inf, first.dtype)
    kinds: list[Any] = [jax.tree.structure(tree) for tree in (bound, start)]
    if kinds[0] != kinds[1]:
        bound = jax.tree.map(lambda _: bound, start)
    full = jax.tree.map(lambda b, s: jnp.broadcast_to(b, jnp.shape(s)), bound, start)
    return jnp.asarray(ravel_pytree(full)[0], first.dtype)


def _by_columns(flat: Callable[[Array], Array]) -> Callable[[Array], Any]:
    def evaluated(point: Array) -> tuple[Array, Array]:
        def column(way: Array) -> tuple[Array, Array]:
            return jax.jvp(flat, (point,), (way,))

        values, columns = jax.vmap(column, out_axes=(None, 1))(
            jnp.eye(point.size, dtype=point.dtype)
        )
        return values, columns

    return evaluated


def _by_rows(flat: Callable[[Array], Array]) -> Callable[[Array], Any]:
    def evaluated(point: Array) -> tuple[Array, Array]:
        values, back = jax.vjp(flat, point)
        rows = jax.vmap(lambda way: back(way)[0])(
            jnp.eye(values.size, dtype=values.dtype)
        )
        return values, rows

    return evaluated


def _step(
    jacobian: Array,
    residuals: Array,
    rho: Array,
    pull: Array,
    mu: Array,
    point: Array,
    low: Array,
    high: Array,
) -> Array:
    """The damped Gauss-Newton step of the unknowns that no bound holds."""
    slope = jacobian.T @ residuals + pull
    held = ((point <= low) & (slope > 0)) | ((point >= high) & (slope < 0))
    free = jnp.where(held, 0, 1).astype(point.dtype)
    columns = jacobian * free[None]
    squares = jnp.sum(columns**2, axis=0) + rho
    # A column of zeros leaves its unknown where it is.
    none = squares <= jnp.finfo(point.dtype).tiny
    weights = rho + mu * jnp.where(none, 1, squares)
    roots = jnp.sqrt(weights)
    # In units in which the damping is the identity; by QR, which does not square what
    # is ill-conditioned.
    scaled, pulled = columns / roots[None], pull * free / roots
    wide = scaled.shape[0] < scaled.shape[1]
    tall = scaled.T if wide else scaled
    corner = jnp.eye(tall.shape[1], dtype=point.dtype)
    upper = jnp.linalg.qr(jnp.concatenate([tall, corner]), mode="r")

    def solved(side: Array) -> Array:
        return solve_triangular(upper, solve_triangular(upper, side, trans="T"))

    if wide:
        # (I + A'A)^-1 (A'r + p) = p + A'(I + AA')^-1 (r - A p), which cancels nothing.
        step = pulled + scaled.T @ solved(residuals - scaled @ pulled)
    else:
        step = solved(scaled.T @ residuals + pulled)
    return -step / roots * free
