r"""Least squares of trajectories cut into windows, whose gaps close during the search.

The unknowns are the parameters $p$ shared by all trajectories ("shared unknowns"), and
for each trajectory the unknowns $s$ of its first state ("own unknowns"). The initial
states $x_w$ of later windows change during the search, with gaps between windows.
Window $w$ has residuals $r_w(p, x_w)$ and an end state $e_w(p, x_w)$. With
$x_1 = b(p, s)$ and gaps $g_{w+1} = e_w - x_{w+1}$, initial states change, to first
order, by

$$\delta x_{w+1} = \frac{\partial e_w}{\partial x} \delta x_w
+ \frac{\partial e_w}{\partial p} \delta p + g_{w+1}
= A_{w+1} \begin{pmatrix} \delta p \\ \delta s \end{pmatrix} + c_{w+1},$$

which is propagated in forward mode, with a column for each unknown and one for the
gaps. The cost is that of one run with that many tangents, for states of any size.

A step minimises $\sum_w \| r_w + J_w (\delta p, \delta s) + J_w^x c_w \|^2$ and updates
all initial states to first order. The own unknowns $s$ of a trajectory are eliminated
first (variable projection). With $S = \partial r / \partial s$, damping $\mu$ and the
diagonal $D$ of $J^T J$,

$$\begin{pmatrix} S \\ \sqrt{\mu D} \end{pmatrix} = Q R, \qquad
\min_d \sum \Big\| (I - Q Q^T) \begin{pmatrix} r + P d \\ 0 \end{pmatrix}
\Big\|^2 + \mu \| D^{1/2} d \|^2,$$

where $P = \partial r / \partial p$ and the sum is over trajectories. The own unknowns
follow from $R$ by back substitution. The cost is that of one small solve per
trajectory, not of one solve of all unknowns. The projected $P$ (without damping) is the
Jacobian of the shared unknowns if the own unknowns always take their optimum. Its
singular values show how well the data determine $p$.

A step is accepted if $\sum_w \| r_w + J_w^x c_w \|^2 + \| J_w^x g_w \|^2$ falls. The
first term has the residuals after the gaps are closed, to first order. The second
measures each gap by its effect on the observations of its own window. Otherwise the
damping rises and the step is halved. Gaps converge quadratically. At the end the
windows form one continuous run. Errors do not grow along it during the search, as they
would in a single run. There is no guarantee that a small enough step is accepted: if
gaps are so large that closing them changes the derivatives, the search stops with open
gaps. Trajectories of a single window have no gaps.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983; J. Albersmeyer, M. Diehl, The lifted Newton method and its application in
optimization, 2010; G. H. Golub, V. Pereyra, The differentiation of pseudo-inverses and
nonlinear least squares problems whose variables separate, 1973; B. Triggs et al.,
Bundle adjustment, 2000, section 6.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from jaxrod.control.least_squares import (
    Search,
    default_tolerance,
    levenberg_marquardt_loop,
    next_damping,
)
from jaxrod.structure import pytree

LEAST_DAMPING = 1e-6
"""Smallest damping, relative to the diagonal of $J^T J$ [1]. Less gains nothing, and
raising it again costs rejected steps."""


@pytree
class Point:
    """A point of the search: shared and own unknowns, and initial states of windows.

    Shared unknowns are common to all trajectories. Own unknowns belong to the first
    state of one trajectory: `(trajectories, own)`. States are `(trajectories, windows,
    numbers)`.
    """

    shared: Array
    own: Array
    states: Array


@pytree
class Slopes:
    """Residuals of each window, and derivatives of residuals and initial states.

    All are stacked by trajectory and window; changes are to first order.
    """

    residuals: Array
    jacobian: Array
    closing: Array
    """Change of a window's residuals if all gaps up to its start close."""
    jump: Array
    """Change of a window's residuals if only the gap at its start closes."""
    ways: Array
    """Derivatives of each window's initial state with respect to the shared unknowns,
    followed by the own unknowns."""
    shift: Array
    """Change of each window's initial state if all gaps up to it close."""

    @property
    def closed(self) -> Array:
        """Residuals after the gaps are closed, to first order."""
        return self.residuals + self.closing


@pytree
class ShootingResult:
    """Best point found by `windowed_least_squares`."""

    solution: Float[Array, " shared"]
    """Shared unknowns, which all trajectories have in common."""
    own: Any
    """Own unknowns of trajectories (of their first states), stacked by trajectory."""
    states: Any
    """Initial states of windows, stacked by trajectory and window."""
    residuals: Float[Array, " residuals"]
    """Residuals at the solution with gaps closed to first order, flattened by leaf."""
    jacobian: Float[Array, "residuals shared"]
    """Jacobian of the residuals with respect to the shared unknowns, projected
    orthogonally to the columns of the own unknowns."""
    gap: Float[Array, ""]
    """Norm of the change of all residuals when the gaps between windows close."""
    iterations: Int[Array, ""]
    """Number of points tried after the initial guess."""


def windowed_least_squares(
    residuals: Callable[[Array, Any, Any], tuple[Any, Any]],
    initial_state: Callable[[Array, Any, Any], Any],
    start: Float[Array, " shared"],
    own: Any,
    states: Any,
    known: Any,
    *,
    lower: Array,
    upper: Array,
    initial_damping: Any,
    iterations: int = 50,
    tolerance: Any = None,
) -> ShootingResult:
    """Minimises the sum of squared residuals of all windows. Pure; traceable.

    Shared unknowns are the same for all trajectories; each trajectory has own unknowns,
    which determine its first state.

    Args:
        residuals: Takes shared unknowns, a window's initial state and its known data;
            returns the window's residuals, any pytree of floats, and the state at its
            end.
        initial_state: Takes shared unknowns, a trajectory's own unknowns and the known
            data of its first window; returns the initial state of that window.
        start: Initial guess of the shared unknowns.
        own: Initial guess of the own unknowns, floats stacked by trajectory on the
            leading axis.
        states: Initial guess of the initial states of windows, floats stacked by
            trajectory and window on the leading axes; those of first windows are
            ignored.
        known: Known data of each window, stacked the same way.
        lower: Lower bounds of the shared unknowns.
        upper: Upper bounds of the shared unknowns.
        initial_damping: Damping of the first step, relative to the diagonal of
            $J^T J$, where $J$ is the Jacobian [1].
        iterations: Largest number of points tried after the initial guess.
        tolerance: Relative change of the cost at which the search ends; by default
            machine epsilon to the power of 3/4.

    Returns:
        The best point; a point that is not finite is never accepted.
    """
    dtype = start.dtype
    small = default_tolerance(dtype) if tolerance is None else tolerance
    shares = start.size
    _, as_own = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], own))
    _, as_state = ravel_pytree(jax.tree.map(lambda leaf: leaf[0, 0], states))
    first = Point(
        jnp.clip(start, lower, upper),
        jax.vmap(lambda part: ravel_pytree(part)[0])(own).astype(dtype),
        jax.vmap(jax.vmap(lambda part: ravel_pytree(part)[0]))(states).astype(dtype),
    )
    joined = first.states.shape[1] > 1

    def opening(shared: Array, mine: Array, given: Any) -> Array:
        state = initial_state(shared, as_own(mine), given)
        return ravel_pytree(state)[0].astype(dtype)

    def window(shared: Array, state: Array, given: Any) -> tuple[Array, Array]:
        made, end = residuals(shared, as_state(state), given)
        return ravel_pytree(made)[0], ravel_pytree(end)[0].astype(dtype)

    def evaluated(point: Point, known: Any) -> tuple[Array, Slopes]:
        def alone(own: Array, states: Array, known: Any) -> tuple[Array, Slopes]:
            return _followed(opening, window, point.shared, own, states, known)

        return jax.vmap(alone)(point.own, point.states, known)

    def evaluate(point: Point) -> tuple[Point, Slopes, Array]:
        states, slopes = evaluated(point, known)
        cost = jnp.sum(slopes.closed**2) + jnp.sum(slopes.jump**2)
        return replace(point, states=states), slopes, cost

    def is_still(search: Search, cost: Array, better: Array) -> Array:
        del better
        gained = jnp.abs(search.cost - cost) <= small * search.cost
        return gained & (search.share == 1)

    def propose(search: Search, begun: Array, better: Array) -> dict[str, Any]:
        mu = next_damping(search, begun, better, LEAST_DAMPING)
        share = search.share
        if joined:
            change = jnp.where(better, 2.0, 0.5)
            share = jnp.where(begun, jnp.minimum(1, share * change), share)
        return {
            "damping": mu,
            "share": share.astype(dtype),
            "candidate": _stepped(search.point, search.found, mu, share, lower, upper),
        }

    shapes = jax.eval_shape(evaluated, first, known)[1]
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, dtype), shapes)
    infinite = jnp.full(shapes.residuals.shape, jnp.inf, dtype)
    found = levenberg_marquardt_loop(
        evaluate,
        propose,
        is_still,
        first,
        replace(nothing, residuals=infinite),
        initial_damping,
        iterations,
    )
    slopes = found.found
    left = jax.vmap(lambda rows: eliminate(rows, jnp.finfo(dtype).eps, shares)[0])(
        _rows(slopes.jacobian)
    )
    alone = jax.tree.map(lambda leaf: leaf[0, 0], (states, known))
    like = jax.eval_shape(lambda p, x, k: residuals(p, x, k)[0], first.shared, *alone)
    width = slopes.residuals.shape[-1]
    return ShootingResult(
        solution=found.point.shared,
        own=jax.vmap(as_own)(found.point.own),
        states=jax.vmap(jax.vmap(as_state))(found.point.states),
        residuals=_by_leaves(jnp.reshape(slopes.closed, (-1, width)), like),
        jacobian=jax.vmap(lambda rows: _by_leaves(rows, like), in_axes=2, out_axes=1)(
            jnp.reshape(left, (-1, width, shares))
        ),
        gap=jnp.sqrt(jnp.sum(slopes.closing**2)),
        iterations=found.tried - 1,
    )


def _rows(windows: Array) -> Array:
    """Joins the window and residual axes, so that each trajectory has one row axis."""
    return jnp.reshape(windows, (windows.shape[0], -1, *windows.shape[3:]))


def _by_leaves(rows: Array, like: Any) -> Array:
    """Flattens residuals `(windows, residuals)` into the order of a stacked tree.

    `like` is the tree of one window's residuals. In the result each leaf is complete,
    stacked by window, before the next leaf begins.
    """
    made, at = [], 0
    for leaf in jax.tree.leaves(like):
        made.append(jnp.ravel(rows[:, at : at + leaf.size]))
        at += leaf.size
    return jnp.concatenate(made)


def _stepped(
    point: Point, slopes: Slopes, mu: Array, share: Array, low: Array, high: Array
) -> Point:
    """Point after a fraction `share` of the damped step and of closing the gaps.

    `mu` is the damping, relative to the diagonal of $J^T J$; `low` and `high` are the
    bounds of the shared unknowns.
    """
    step, own_steps = schur_step(
        _rows(slopes.jacobian), _rows(slopes.closed), mu, point.shared, low, high
    )
    shared = jnp.clip(point.shared + share * step, low, high)
    moved = jnp.broadcast_to(shared - point.shared, (len(own_steps), shared.size))
    unknowns = jnp.concatenate([moved, share * own_steps], axis=1)
    along = jnp.einsum("twsu,tu->tws", slopes.ways, unknowns)
    return Point(
        shared,
        point.own + share * own_steps,
        point.states + along + share * slopes.shift,
    )


def _followed(
    opening: Callable[[Array, Array, Any], Array],
    window: Callable[[Array, Array, Any], tuple[Array, Array]],
    shared: Array,
    own: Array,
    states: Array,
    known: Any,
) -> tuple[Array, Slopes]:
    """Evaluates one trajectory and its derivatives, window after window.

    Args:
        opening: Takes shared unknowns, own unknowns and the known data of the first
            window; returns its initial state.
        window: Takes shared unknowns, an initial state and the known data of the
            window; returns the residuals and the state at the end.
        shared: Shared unknowns.
        own: Own unknowns of the trajectory.
        states: Initial states, stacked by window on the leading axis.
        known: Known data of each window, stacked the same way.

    Returns:
        The initial states, the first of which follows from the unknowns, and the
        slopes, all stacked by window on the leading axis.
    """
    shares, dtype = shared.size, shared.dtype
    unknowns = jnp.concatenate([shared, own])
    at_first = jax.tree.map(lambda leaf: leaf[0], known)

    def opened(unknowns: Array) -> Array:
        return opening(unknowns[:shares], unknowns[shares:], at_first)

    eye = jnp.eye(unknowns.size, dtype=dtype)
    state, ways = jax.vmap(
        lambda way: jax.jvp(opened, (unknowns,), (way,)), out_axes=(None, 1)
    )(eye)
    states = states.at[0].set(state)
    # Columns: the unknowns and, if there are gaps, all gaps before the window and the
    # last one.
    gaps = 2 if len(states) > 1 else 0
    shared_ways = jnp.concatenate([eye[:shares], jnp.zeros((shares, gaps), dtype)], 1)
    count = unknowns.size

    def next_window(carry: tuple[Array, ...], given: Any) -> Any:
        ways, shift, gap = carry
        state, following, knowing = given

        def run(shared: Array, state: Array) -> tuple[Array, Array]:
            return window(shared, state, knowing)

        def column(by_shared: Array, by_state: Array) -> Any:
            return jax.jvp(run, (shared, state), (by_shared, by_state))

        beside = [way[:, None] for way in (shift, gap)[:gaps]]
        columns = jnp.concatenate([ways, *beside], axis=1)
        (values, end), (rows, ends) = jax.vmap(
            column, in_axes=(1, 1), out_axes=(None, 1)
        )(shared_ways, columns)
        opens = end - following
        if gaps:
            closing, jump = rows[:, -2], rows[:, -1]
            shifted = ends[:, -2] + opens
        else:
            closing = jump = jnp.zeros_like(values)
            shifted = shift
        slopes = Slopes(values, rows[:, :count], closing, jump, ways, shift)
        return (ends[:, :count], shifted, opens), slopes

    nothing = jnp.zeros_like(state)
    following = jnp.roll(states, -1, axis=0)
    _, slopes = lax.scan(
        next_window, (ways, nothing, nothing), (states, following, known)
    )
    return states, slopes


def eliminate(slopes: Array, mu: Any, shares: int) -> tuple[Array, Array, Array]:
    """Eliminates the own unknowns of one trajectory from its Jacobian by projection.

    `slopes` holds the columns P of the `shares` shared unknowns, followed by the
    columns S of the own unknowns. Q R is the QR decomposition of S stacked on
    sqrt(mu D), where D is the diagonal of S^T S. Returns P - Q_S Q_S^T P, Q and R,
    where Q_S are the rows of Q that belong to S.
    """
    shared_columns, own_columns = slopes[:, :shares], slopes[:, shares:]
    squares = jnp.sum(own_columns**2, axis=0)
    none = squares <= jnp.finfo(slopes.dtype).tiny
    roots = jnp.sqrt(mu * jnp.where(none, 1, squares))
    q, r = jnp.linalg.qr(jnp.concatenate([own_columns, jnp.diag(roots)]))
    top = q[: own_columns.shape[0]]
    return shared_columns - top @ (top.T @ shared_columns), q, r


def schur_step(
    jacobian: Array, residuals: Array, mu: Array, point: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """Returns the damped Gauss-Newton step of shared and own unknowns.

    Shared unknowns are common to all trajectories; each trajectory has own unknowns.

    Args:
        jacobian: Jacobians of the trajectories `(trajectory, residuals, shared + own)`.
        residuals: Residuals of all trajectories, `(trajectory, residuals)`.
        mu: Damping, relative to the diagonal of $J^T J$ [1].
        point: Shared unknowns.
        low: Lower bounds of the shared unknowns.
        high: Upper bounds of the shared unknowns.

    Returns:
        The step of the shared unknowns, zero where a bound holds them, and the steps of
        the own unknowns, stacked by trajectory on the leading axis.
    """
    shares, dtype = point.size, jacobian.dtype

    def eliminated(slopes: Array, values: Array) -> tuple[Array, ...]:
        _, q, r = eliminate(slopes, mu, shares)
        none = jnp.zeros((q.shape[0] - values.size, shares + 1), dtype)
        both = jnp.concatenate([slopes[:, :shares], values[:, None]], axis=1)
        both = jnp.concatenate([both, none])
        along = q.T @ both
        return both - q @ along, along, r

    rest, along, r = jax.vmap(eliminated)(jacobian, residuals)
    rows = jnp.reshape(rest, (-1, shares + 1))
    columns, values = rows[:, :shares], rows[:, shares]
    slope = columns.T @ values
    held = ((point <= low) & (slope > 0)) | ((point >= high) & (slope < 0))
    free = jnp.where(held, 0, 1).astype(dtype)
    columns = columns * free[None]
    squares = jnp.sum(jacobian[..., :shares] ** 2, axis=(0, 1)) * free
    none = squares <= jnp.finfo(dtype).tiny
    roots = jnp.sqrt(mu * jnp.where(none, 1, squares))
    triangle = jnp.linalg.qr(
        jnp.concatenate(
            [
                jnp.concatenate([columns, values[:, None]], axis=1),
                jnp.concatenate([jnp.diag(roots), jnp.zeros((shares, 1), dtype)], 1),
            ]
        ),
        mode="r",
    )
    step = -solve_triangular(triangle[:shares, :shares], triangle[:shares, shares])
    step = step * free
    sides = -(along[..., shares] + along[..., :shares] @ step)
    return step, jax.vmap(solve_triangular)(r, sides)
