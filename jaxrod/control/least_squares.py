r"""Least squares within bounds, by damped Gauss-Newton steps (Levenberg-Marquardt).

For residuals $r(z)$ with Jacobian $J$ and a ridge $\rho$ about $z_0$, it minimises
$|r|^2 + \rho |z - z_0|^2$. A step $d$ with damping $\mu$ solves

$$(J^T J + \rho I + \mu D)\, d = -\big(J^T r + \rho (z - z_0)\big), \qquad
D = \mathrm{diag}(J^T J) + \rho I$$

over the unknowns that are not held at a bound, and is clipped to the bounds. It is
accepted if the minimised sum falls; then $\mu$ is divided by 3, and otherwise it is
multiplied by 4. Alternatively six steps, with dampings around the last one (`LADDER`),
are tried as one batch. The best is accepted if the minimised sum falls; otherwise the
next six have more damping.

Jacobians are computed by columns in forward mode if there are no more unknowns than
residuals, and by rows in reverse mode otherwise. The ridge adds no rows, so that six
residuals of 132 unknowns take six reverse passes. Everything is one program: `jax.vmap`
solves many problems together, and nothing is compiled again for other numbers.

Source: K. Madsen, H. B. Nielsen, O. Tingleff, Methods for non-linear least squares
problems, 2nd edition, 2004, section 3.2; bounds by projection.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxrod.structure import pytree

FASTER, SLOWER = 3.0, 4.0
"""Divisor of the damping after an accepted step, factor after a rejected one [1]."""
LADDER = (64.0, 16.0, 4.0, 1.0, 1 / 4, 1 / 16)
"""Dampings tried as one batch, relative to the last damping [1]; the largest first."""
MOST_DAMPING = 1e12
"""Damping at which the search gives up: larger damping gives negligible steps."""


@pytree
class LeastSquares:
    """Best point found by `least_squares`, and the history of the search.

    Example:
        >>> found = control.least_squares(lambda x: x**2 - 4.0, jnp.array(1.0))
        >>> round(float(found.solution), 3), bool(found.converged)
        (2.0, True)
    """

    solution: Any
    """Unknowns at the best point, a tree like the initial guess."""
    residuals: Float[Array, " residuals"]
    """Residuals at the solution."""
    jacobian: Float[Array, "residuals unknowns"]
    """Jacobian of the residuals with respect to the flattened unknowns, at the
    solution."""
    cost: Float[Array, ""]
    """Sum of squared residuals at the solution, plus the ridge term."""
    converged: Bool[Array, ""]
    """Whether the last step changed the cost, or the unknowns, by less than the
    tolerance."""
    iterations: Int[Array, ""]
    """Number of points tried after the initial guess."""
    costs: Float[Array, " iterations"]
    """Cost of the initial guess, then of the best point after each iteration; NaN for
    iterations that were not made."""


@pytree
class Search:
    """State of a search: its best point so far, and the point to try next."""

    point: Any
    """Best point so far; the initial guess until a cost is finite."""
    found: Any
    """Residuals and derivatives at the best point, as `evaluate` returns them."""
    cost: Array
    """Cost of the best point."""
    damping: Array
    """Damping of the step to the candidate, relative to the diagonal of $J^T J$ [1]."""
    share: Array
    """Fraction of the damped step that leads to the candidate [1]."""
    candidate: Any
    """Point to try next."""
    tried: Array
    """Number of points tried, including the initial guess."""
    converged: Array
    """Whether the last step changed too little to continue."""
    costs: Array
    """Cost of the best point after each trial; NaN for trials that were not made."""


def levenberg_marquardt_loop(
    evaluate: Callable[[Any], tuple[Any, Any, Array]],
    propose: Callable[[Search, Array, Array], dict[str, Any]],
    is_still: Callable[[Search, Array, Array], Array],
    start: Any,
    nothing: Any,
    initial_damping: Any,
    iterations: int,
) -> Search:
    """Minimises a cost by damped steps, with the problem given as functions.

    A point is accepted if its cost and its derivatives are finite and the cost falls.

    Args:
        evaluate: Takes a point; returns the point (corrected where necessary), a pytree
            of residuals and derivatives there, and the cost.
        propose: Takes the search with its new best point, whether a step was tried, and
            whether it was accepted; returns a dict of the new `damping`, `candidate`
            and, if it changes, `share`, as in `Search`.
        is_still: Takes the search before the trial, the cost that was tried, and
            whether it was accepted; returns whether the step changed too little to
            continue.
        start: Initial guess.
        nothing: Placeholder for residuals and derivatives before the first evaluation,
            with their shapes.
        initial_damping: Damping of the first step.
        iterations: Largest number of points tried after the initial guess.
    """
    dtype = jax.tree.leaves(start)[0].dtype

    def more(search: Search) -> Array:
        going = (search.tried <= iterations) & ~search.converged
        return going & (search.damping < MOST_DAMPING)

    def again(search: Search) -> Search:
        candidate, found, cost = evaluate(search.candidate)
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(found)]
        sound = jnp.isfinite(cost) & jnp.all(jnp.stack(finite))
        better = sound & (cost < search.cost)
        begun = search.tried > 0
        point, found, least = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (candidate, found, cost),
            (search.point, search.found, search.cost),
        )
        best = replace(search, point=point, found=found, cost=least)
        return replace(
            best,
            **propose(best, begun, better),
            tried=search.tried + 1,
            converged=begun & sound & is_still(search, cost, better),
            costs=search.costs.at[search.tried].set(least),
        )

    return lax.while_loop(
        more,
        again,
        Search(
            point=start,
            found=nothing,
            cost=jnp.asarray(jnp.inf, dtype),
            damping=jnp.asarray(initial_damping, dtype),
            share=jnp.ones((), dtype),
            candidate=start,
            tried=jnp.zeros((), jnp.int32),
            converged=jnp.zeros((), bool),
            costs=jnp.full((iterations + 1,), jnp.nan, dtype),
        ),
    )


def next_damping(
    search: Search, begun: Array, better: Array, least: float = 0.0
) -> Array:
    """Returns less damping after an accepted point, and more after a rejected one [1].

    Args:
        search: The search, with its last damping.
        begun: Whether a step was tried; if not, the damping stays as given.
        better: Whether the step was accepted.
        least: Smallest damping [1].
    """
    change = jnp.where(better, 1 / FASTER, SLOWER)
    damping = jnp.where(begun, search.damping * change, search.damping)
    return jnp.maximum(damping, least).astype(search.damping.dtype)


def default_tolerance(dtype: Any) -> float:
    """Relative change at which a search ends: machine epsilon to the power of 3/4."""
    return float(jnp.finfo(dtype).eps) ** 0.75


def least_squares(
    residuals: Callable[[Any], Any],
    start: Any,
    *,
    lower: Any = None,
    upper: Any = None,
    ridge: Any = 0.0,
    centre: Any = None,
    initial_damping: Any = 1e-3,
    iterations: int = 50,
    tolerance: float | None = None,
    mode: str | None = None,
    several: bool = False,
) -> LeastSquares:
    """Minimises the sum of squares of residuals. Pure; traceable.

    Args:
        residuals: Takes unknowns and returns residuals, any pytree of floats.
        start: Initial guess of the unknowns, any pytree of floats.
        lower: Lower bounds of the unknowns, a number or a tree like `start`; no bounds
            if `None`.
        upper: Upper bounds of the unknowns, given the same way.
        ridge: Weight of the squared distance of the unknowns from `centre`, a number or
            a tree like `start`.
        centre: Centre of the ridge, a number or a tree like `start`; `start` by
            default.
        initial_damping: Damping of the first step, relative to the diagonal of
            $J^T J$, where $J$ is the Jacobian [1].
        iterations: Largest number of iterations.
        tolerance: Relative change of the cost, or of every unknown, at which the search
            ends; by default machine epsilon to the power of 3/4.
        mode: Mode of differentiation for Jacobians, `"forward"` or `"reverse"`; by
            default the one that needs fewer passes.
        several: Whether each iteration tries six dampings as a batch. This pays off
            where a batch of residuals costs hardly more than a single evaluation, as
            for trajectories. It does not where residuals need an iterative solve, as
            for equilibria.

    Returns:
        The best point; a point whose residuals are not all finite is never accepted.

    Raises:
        ValueError: `mode` is unknown, or there are no unknowns.

    Example:
        >>> def rosenbrock(point):
        ...     x, y = point
        ...     return 10.0 * (y - x**2), 1.0 - x
        >>> found = control.least_squares(rosenbrock, jnp.array([-1.0, 1.0]))
        >>> print(found.solution.round(3), found.converged)
        [1. 1.] True
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

    def row(given: Any, sign: int = 1) -> Array:
        full = ravel_pytree(broadcast_like(given, start, sign))[0]
        return jnp.asarray(full, dtype)

    low, high, rho = row(lower, -1), row(upper), row(ridge)
    middle = first if centre is None else row(centre)
    small = default_tolerance(dtype) if tolerance is None else tolerance
    forward = mode == "forward" or (mode is None and first.size <= count)
    ladder = jnp.asarray(LADDER, dtype)
    evaluated = _by_columns(flat) if forward else _by_rows(flat)

    def total(values: Array, point: Array) -> Array:
        return jnp.sum(values**2) + jnp.sum(rho * (point - middle) ** 2)

    def evaluate(point: Array) -> tuple[Array, tuple[Array, Array], Array]:
        values, slopes = evaluated(point)
        return point, (values, slopes), total(values, point)

    def is_still(search: Search, cost: Array, better: Array) -> Array:
        # The unknowns are compared one by one, because their units differ.
        moved = jnp.abs(search.candidate - search.point)
        scale = jnp.abs(search.point) + jnp.abs(search.candidate)
        gained = (search.cost - cost) <= small * search.cost
        return jnp.all(moved <= small * scale) | (better & gained)

    def propose(search: Search, begun: Array, better: Array) -> dict[str, Array]:
        values, jacobian = search.found

        def stepped(mu: Array) -> Array:
            pull = rho * (search.point - middle)
            step = _step(jacobian, values, rho, pull, mu, search.point, low, high)
            return jnp.clip(search.point + step, low, high)

        if not several:
            mu = next_damping(search, begun, better)
            return {"damping": mu, "candidate": stepped(mu)}
        # Begin above all dampings that failed. Zero is avoided, because no factor would
        # change it.
        mu = search.damping * jnp.where(begun & ~better, ladder[0], 1)
        dampings = jnp.maximum(mu, jnp.finfo(dtype).eps) * ladder
        candidates = jax.vmap(stepped)(dampings)
        costs = jax.vmap(lambda z: total(flat(z), z))(candidates)
        # If no cost is finite, the shortest step is the best guess.
        best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
        chosen = jnp.arange(ladder.size) == best
        return {
            "damping": jnp.sum(jnp.where(chosen, dampings, 0)),
            "candidate": jnp.sum(jnp.where(chosen[:, None], candidates, 0), axis=0),
        }

    found = levenberg_marquardt_loop(
        evaluate,
        propose,
        is_still,
        jnp.clip(first, low, high),
        (
            jnp.full((count,), jnp.inf, dtype),
            jnp.zeros((count, first.size), dtype),
        ),
        initial_damping,
        iterations,
    )
    values, jacobian = found.found
    return LeastSquares(
        solution=unravel(found.point),
        residuals=values,
        jacobian=jacobian,
        cost=found.cost,
        converged=found.converged,
        iterations=found.tried - 1,
        costs=found.costs,
    )


def broadcast_like(bound: Any, start: Any, sign: int) -> Any:
    """Broadcasts `bound`, a number or a tree, to the shapes of the leaves of `start`.

    `None` becomes `sign` times infinity.
    """
    if bound is None:
        bound = sign * jnp.inf
    kinds: list[Any] = [jax.tree.structure(tree) for tree in (bound, start)]
    if kinds[0] != kinds[1]:
        bound = jax.tree.map(lambda _: bound, start)
    return jax.tree.map(lambda b, s: jnp.broadcast_to(b, jnp.shape(s)), bound, start)


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
    """Returns the damped Gauss-Newton step d; zero for unknowns held at a bound.

    With J restricted to the free unknowns, it solves
    (J^T J + rho + mu diag(J^T J + rho)) d = -(J^T r + pull).
    Here `rho` is the ridge of each unknown, `pull` is its gradient rho (z - z_0) at the
    `point` z, and `low` and `high` are the bounds of z.
    """
    slope = jacobian.T @ residuals + pull
    held = ((point <= low) & (slope > 0)) | ((point >= high) & (slope < 0))
    free = jnp.where(held, 0, 1).astype(point.dtype)
    columns = jacobian * free[None]
    squares = jnp.sum(columns**2, axis=0) + rho
    # A column of zeros leaves its unknown unchanged.
    none = squares <= jnp.finfo(point.dtype).tiny
    weights = rho + mu * jnp.where(none, 1, squares)
    roots = jnp.sqrt(weights)
    # Scaled so that the damping is the identity. QR avoids squaring the condition
    # number.
    scaled, pulled = columns / roots[None], pull * free / roots
    wide = scaled.shape[0] < scaled.shape[1]
    tall = scaled.T if wide else scaled
    corner = jnp.eye(tall.shape[1], dtype=point.dtype)
    upper = jnp.linalg.qr(jnp.concatenate([tall, corner]), mode="r")

    def solved(side: Array) -> Array:
        return solve_triangular(upper, solve_triangular(upper, side, trans="T"))

    if wide:
        # (I + A'A)^-1 (A'r + p) = p + A'(I + AA')^-1 (r - A p), without cancellation.
        step = pulled + scaled.T @ solved(residuals - scaled @ pulled)
    else:
        step = solved(scaled.T @ residuals + pulled)
    return -step / roots * free
