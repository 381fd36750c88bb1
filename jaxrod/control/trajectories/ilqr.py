r"""Trajectories with feedback gains: iterative linear-quadratic regulation (iLQR).

Each iteration linearises dynamics and residuals along the trajectory (Gauss-Newton).
A backward pass solves the linear-quadratic problem within the bounds of the controls.
The new controls, feedback included, are then tried on the nonlinear dynamics with
several step sizes as one batch (line search). The derivatives of all intervals
in all directions are one batch of rods.

The backward pass is in square-root form. Along a trajectory states change by
$\delta x_{k+1} = A_k \delta x_k + B_k \delta u_k$, and residuals are
$r_k + C_k \delta x_{k+1} + D_k \delta u_k$. The optimal cost-to-go is
$|S_k \delta x_k + s_k|^2$ plus a constant. With damping $\mu$, the QR decomposition of

$$\begin{pmatrix} S_{k+1} B_k & S_{k+1} A_k & s_{k+1} \\
C_k B_k + D_k & C_k A_k & r_k \\ \sqrt\mu & 0 & 0 \end{pmatrix}$$

has the gains in its first rows and $S_k, s_k$ in the next. No squares of matrices are
formed, so that single precision suffices for stiff rods. Controls that are held at a
bound are set to the bound and have no gains.

The few controls of an interval are kept in their box by projected Newton steps, which
minimise $|M z + r|^2$ subject to $l \le z \le u$. An unknown at a bound is held there
if the cost falls towards the bound, or if the Newton step of the free unknowns crosses
the bound. Several candidates are then compared, and the best is taken: the whole Newton
step or a part of it, clipped to the box; the step up to the first bound; or one unknown
moved to its own minimum, which always lowers the cost.

Source: W. Li, E. Todorov, Iterative linear quadratic regulator design for nonlinear
biological movement systems, ICINCO 2004; Y. Tassa, N. Mansard, E. Todorov,
Control-limited differential dynamic programming, ICRA 2014, section IV; D. P.
Bertsekas, Projected Newton methods for optimization problems with simple constraints,
SIAM J. Control Optim. 20 (1982).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from jaxrod.control.trajectories.problem import (
    Problem,
    check_problem,
    first_knots,
    half_widths,
    numbers,
    over_time,
    within_bounds,
)
from jaxrod.control.trajectories.solution import Solution, reason_to_stop, timed
from jaxrod.structure import pytree
from jaxrod.validation import check_array, check_count

SHARES = 10
"""Number of step sizes that the line search tries as one batch: 1, 1/2, 1/4, ..."""
FASTER, SLOWER = 4.0, 8.0
"""Factors of the damping [1]. A full step divides it by FASTER, a step of 1/8 or less
multiplies it by FASTER. If no step lowers the cost it is multiplied by SLOWER."""
LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e9


def ilqr(
    problem: Problem,
    *,
    iterations: int = 50,
    initial_damping: float = 1e-3,
    tolerance: float = 1e-4,
    initial_controls: Any = None,
    spread: float = 0.1,
    seed: int = 0,
) -> Solution:
    """Finds the controls of all intervals that minimise the cost, with feedback gains.

    Meant for long motions in which a rod must be kept from falling: the solution's
    `policy` reacts to disturbances.

    Args:
        problem: The problem.
        iterations: Largest number of steps tried.
        initial_damping: Damping of the first step: cost of changing a control by half
            the range between its bounds in all intervals, as a fraction of the initial
            cost [1].
        tolerance: Relative decrease of the cost at which the search ends.
        initial_controls: Initial controls `(n_intervals, n_controls)`; random ones by
            default. Controls of a motion like the desired one are often much better.
        spread: Standard deviation of the random controls, as a fraction of half the
            range between the bounds [1].
        seed: Seed of the random controls.

    Returns:
        The best controls found, with their motion and the feedback gains about it.

    Raises:
        ValueError: An argument is out of range or has the wrong shape.
        TypeError: `problem` is not a `Problem`.

    Example:
        >>> problem = control.make_problem(
        ...     jnp.zeros(1),
        ...     lambda goal, place, push, k: place + 0.1 * push,
        ...     running=lambda goal, place, push, k: (0.1 * push, place - goal),
        ...     data=jnp.array([0.5]),
        ...     n_intervals=10, interval=0.1, n_controls=1, lower=-9.0, upper=9.0,
        ... )
        >>> found = control.ilqr(problem)
        >>> bool((found.gains < 0).all())  # it pushes back
        True
    """
    check_problem(problem)
    iterations = check_count("iterations", iterations, 1)
    shape = (problem.n_intervals, problem.n_controls)
    if initial_controls is not None:
        start = within_bounds(problem, "initial_controls", initial_controls, shape)
    else:
        width = float(check_array("spread", spread, [()], "", non_negative=True))
        knots = first_knots(problem, min(11, problem.n_intervals), None, seed, width)
        start = over_time(knots, problem.n_intervals)
    settings = {
        name: jnp.asarray(
            check_array(name, number, [()], "", positive=True), start.dtype
        )
        for name, number in (
            ("initial_damping", initial_damping),
            ("tolerance", tolerance),
        )
    }
    found, compile_s, run_s = timed(
        _solved, problem, start, settings, iterations=iterations
    )
    tried = int(found.tried) - 1
    converged = bool(found.converged)
    cost = float(found.cost)
    if not np.isfinite(cost):
        reason = "the motion under the first controls is not finite"
    else:
        gained = "a step gains less than asked"
        reason = reason_to_stop(converged, tried, iterations, gained)
    _, unravel = ravel_pytree(problem.start)
    return Solution(
        problem=problem,
        solver="ilqr",
        controls=found.controls,
        states=jax.vmap(unravel)(found.states),
        cost=cost,
        history={"cost": np.asarray(found.costs)[: tried + 1]},
        converged=converged and bool(np.isfinite(cost)),
        reason=reason,
        iterations=tried,
        compile_s=compile_s,
        run_s=run_s,
        gains=found.gains,
    )


@pytree
class _Search:
    controls: Array
    states: Array
    cost: Array
    gains: Array
    damping: Array
    tried: Array
    converged: Array
    ended: Array
    costs: Array


def _solved(
    problem: Problem, start: Array, settings: dict[str, Array], *, iterations: int
) -> _Search:
    first, unravel = ravel_pytree(problem.start)
    n, (count, m) = first.size, start.shape
    shares = 0.5 ** jnp.arange(SHARES, dtype=start.dtype)

    def end(last: Array) -> Array:
        return _flat(problem.at_the_end(unravel(last)), last.dtype)

    def tried_with(
        search: _Search, changes: Array, gains: Array, share: Array
    ) -> tuple[Array, Array, Array]:
        """Simulates u + share du + K (x - x_planned), clipped to the bounds.

        u and x_planned are controls and states of `search`, du are `changes`, K
        `gains`. Returns the clipped controls, the states and the cost.
        """

        def one(state: Array, given: tuple[Array, ...]) -> Any:
            k, control, change, gain, planned = given
            wanted = control + share * change + gain @ (state - planned)
            used = jnp.clip(wanted, problem.lower, problem.upper)
            moved, made = problem.step(unravel(state), used, k)
            after = ravel_pytree(moved)[0]
            return after, (used, after, jnp.sum(_flat(made, after.dtype) ** 2))

        last, (controls, states, costs) = lax.scan(
            one,
            first,
            (numbers(problem), search.controls, changes, gains, search.states[:-1]),
        )
        total = jnp.sum(costs) + jnp.sum(end(last) ** 2)
        return controls, jnp.concatenate([first[None], states]), total

    def again(search: _Search) -> _Search:
        # The last iteration only computes the gains about the solution.
        last = search.converged | (search.tried >= iterations)
        last = last | (search.damping > MOST_DAMPING)
        share = jnp.where(last, LEAST_DAMPING, search.damping)
        linear = _linearised(problem, unravel, search.states, search.controls)
        scale = search.costs[0] / (count * half_widths(problem) ** 2)
        changes, gains = backward(
            linear, search.controls, problem.lower, problem.upper, share * scale
        )
        controls, states, costs = jax.vmap(
            lambda share: tried_with(search, changes, gains, share)
        )(shares)
        costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
        best = jnp.argmin(costs)
        least = jnp.min(costs)
        better = (least < search.cost) & ~last
        taken = (jnp.arange(SHARES) == best) & better

        def chosen(ways: Array, old: Array) -> Array:
            mask = taken.reshape(SHARES, *(1,) * old.ndim)
            one = jnp.sum(jnp.where(mask, ways, 0), axis=0)
            return jnp.where(better, one, old)

        # If only a short step helps, the linear model is not valid that far.
        change = jnp.where(best == 0, 1 / FASTER, jnp.where(best < 3, 1.0, FASTER))
        mu = search.damping * jnp.where(better, change, SLOWER)
        small = (search.cost - least) <= settings["tolerance"] * search.cost
        small = small & (best == 0)
        gained = jnp.where(better, least, search.cost)
        return _Search(
            controls=chosen(controls, search.controls),
            states=chosen(states, search.states),
            cost=gained,
            gains=gains,
            damping=jnp.maximum(mu, LEAST_DAMPING).astype(start.dtype),
            tried=search.tried + 1,
            converged=search.converged | (better & small),
            ended=last,
            costs=search.costs.at[search.tried + 1].set(gained, mode="drop"),
        )

    none = _Search(
        controls=start,
        states=jnp.broadcast_to(first, (count + 1, n)),
        cost=jnp.asarray(jnp.inf, start.dtype),
        gains=jnp.zeros((count, m, n), start.dtype),
        damping=settings["initial_damping"],
        tried=jnp.zeros((), jnp.int32),
        converged=jnp.zeros((), bool),
        ended=jnp.zeros((), bool),
        costs=jnp.full((iterations + 1,), jnp.nan, start.dtype),
    )
    # The batch has the size of the search's, so that both share a compiled program.
    controls, states, costs = jax.vmap(
        lambda share: tried_with(none, jnp.zeros_like(start), none.gains, share)
    )(shares)
    begun = replace(
        none,
        controls=controls[0],
        states=states[0],
        cost=costs[0],
        costs=none.costs.at[0].set(costs[0]),
    )
    return lax.while_loop(lambda search: ~search.ended, again, begun)


Unravel = Callable[[Array], Any]


def _flat(residuals: Any, dtype: Any) -> Array:
    """Flattens residuals to a vector, empty for `None`."""
    return ravel_pytree(residuals)[0].astype(dtype)


def _linearised(
    problem: Problem,
    unravel: Unravel,
    states: Float[Array, "intervals+1 n"],
    controls: Float[Array, "intervals m"],
) -> Linear:
    """Linearises dynamics and residuals of all intervals, as one batch.

    `unravel` converts a flat state, a row of `states`, to a state of the problem.
    """
    n, m = states.shape[1], controls.shape[1]
    ways = jnp.eye(n + m, dtype=states.dtype)

    def moves(x: Array, u: Array, k: Array) -> tuple[Array, Array]:
        def after(x: Array, u: Array) -> Array:
            return ravel_pytree(problem.move(problem.data, unravel(x), u, k))[0]

        def column(way: Array) -> Array:
            return jax.jvp(after, (x, u), (way[:n], way[n:]))[1]

        both = jax.vmap(column, out_axes=1)(ways)
        return both[:, :n], both[:, n:]

    def costs(x: Array, u: Array, k: Array) -> tuple[Array, Array, Array]:
        def made(x: Array, u: Array) -> Array:
            return _flat(problem.on_the_way(unravel(x), u, k), x.dtype)

        by_state, by_control = jax.jacfwd(made, (0, 1))(x, u)
        return made(x, u), by_state, by_control

    k = numbers(problem)
    a, b = jax.vmap(moves)(states[:-1], controls, k)
    r, by_states, by_controls = jax.vmap(costs)(states[1:], controls, k)
    end = lambda x: _flat(problem.at_the_end(unravel(x)), x.dtype)
    return Linear(
        states=a,
        controls=b,
        residuals=r,
        by_states=by_states,
        by_controls=by_controls,
        final=end(states[-1]),
        final_by_state=jax.jacfwd(end)(states[-1]),
    )


MOST_STEPS = 40
HALVINGS = 8


@pytree
class Linear:
    """Linearised dynamics and residuals of all intervals of a trajectory."""

    states: Float[Array, "intervals n n"]
    """Derivatives $A_k$ of the next state with respect to the state."""
    controls: Float[Array, "intervals n m"]
    """Derivatives $B_k$ of the next state with respect to the control."""
    residuals: Float[Array, "intervals r"]
    """Residuals $r_k$ of every interval."""
    by_states: Float[Array, "intervals r n"]
    """Derivatives $C_k$ of the residuals with respect to the state after the
    interval."""
    by_controls: Float[Array, "intervals r m"]
    """Derivatives $D_k$ of the residuals with respect to the control."""
    final: Float[Array, " f"]
    """Residuals of the last state."""
    final_by_state: Float[Array, "f n"]
    """Derivatives of the final residuals with respect to the last state."""


def backward(
    linear: Linear,
    controls: Float[Array, "intervals m"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    damping: Float[Array, " m"],
) -> tuple[Float[Array, "intervals m"], Float[Array, "intervals m n"]]:
    """Returns the optimal changes of the controls, and their feedback gains.

    The gains are derivatives of the controls with respect to the states.

    Args:
        linear: Linearisation along the trajectory.
        controls: Controls of the trajectory.
        lower: Lower bounds of the controls.
        upper: Upper bounds of the controls.
        damping: Weight of the squared change of each control.
    """
    n, m = linear.controls.shape[1:]
    roots = jnp.sqrt(damping)

    def one(
        to_come: tuple[Array, Array], given: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        square, right = to_come
        a, b, r, c, d, u = given
        by_control = jnp.concatenate([square @ b, c @ b + d, jnp.diag(roots)])
        by_state = jnp.concatenate([square @ a, c @ a, jnp.zeros((m, n), a.dtype)])
        rest = jnp.concatenate([right, r, jnp.zeros((m,), a.dtype)])
        change, held = box_step(by_control, rest, lower - u, upper - u)
        # Held controls are moved first, and are then no longer unknowns. An additional
        # row for each keeps the decomposition regular.
        moved = rest + by_control @ jnp.where(held, change, 0)
        free = jnp.where(held[None], 0, by_control)
        own = jnp.diag(jnp.where(held, 1, 0).astype(a.dtype))
        free = free.at[-m:].add(own)
        rows = jnp.concatenate([free, by_state, moved[:, None]], axis=1)
        upper_rows = jnp.linalg.qr(rows, mode="r")
        corner = upper_rows[:m, :m]
        gains = -solve_triangular(corner, upper_rows[:m, m : m + n])
        gains = jnp.where(held[:, None], 0, gains)
        next_square = upper_rows[m : m + n, m : m + n]
        return (next_square, upper_rows[m : m + n, m + n]), (change, gains)

    _, (changes, gains) = lax.scan(
        one,
        _square(linear.final_by_state, linear.final),
        (
            linear.states,
            linear.controls,
            linear.residuals,
            linear.by_states,
            linear.by_controls,
            controls,
        ),
        reverse=True,
    )
    return changes, gains


def _square(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Reduces or pads a least-squares system |M x + r|^2 to as many rows as columns.

    The sum of squares stays the same up to a constant.
    """
    n = matrix.shape[1]
    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    missing = max(n - rows.shape[0], 0)
    rows = jnp.concatenate([rows, jnp.zeros((missing, n + 1), matrix.dtype)])
    if rows.shape[0] > n:
        rows = jnp.linalg.qr(rows, mode="r")[:n]
    return rows[:, :n], rows[:, n]


def box_step(
    matrix: Float[Array, "rows unknowns"],
    right: Float[Array, " rows"],
    lower: Float[Array, " unknowns"],
    upper: Float[Array, " unknowns"],
) -> tuple[Float[Array, " unknowns"], Bool[Array, " unknowns"]]:
    """Minimises |M z + r|^2 for z within bounds.

    Returns the minimiser, and whether each unknown is held at a bound.

    Args:
        matrix: Matrix $M$ of full column rank.
        right: Residuals $r$ at z = 0.
        lower: Lower bounds.
        upper: Upper bounds.
    """
    square = matrix.T @ matrix
    slope_at_zero = matrix.T @ right
    identity = jnp.eye(square.shape[0], dtype=square.dtype)
    halves = 0.5 ** jnp.arange(HALVINGS, dtype=square.dtype)

    def cost(point: Array) -> Array:
        return 0.5 * point @ square @ point + slope_at_zero @ point

    def held_at(point: Array) -> Array:
        slope = square @ point + slope_at_zero
        return ((point <= lower) & (slope > 0)) | ((point >= upper) & (slope < 0))

    def again(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        point, tried, _ = carry
        slope = square @ point + slope_at_zero

        def newton(held: Array) -> Array:
            free = ~held
            kept = jnp.where(free[:, None] & free[None, :], square, identity)
            return -jnp.linalg.solve(kept, jnp.where(free, slope, 0))

        def more(_: int, held: Array) -> Array:
            step = newton(held)
            outward = ((point <= lower) & (step < 0)) | ((point >= upper) & (step > 0))
            return held | outward

        held = held_at(point)
        if point.size > 1:
            held = lax.fori_loop(0, point.size - 1, more, held)
        step = newton(held)
        still = step == 0
        room = jnp.where(step > 0, upper, lower) - point
        first = jnp.min(jnp.where(still, jnp.inf, room / jnp.where(still, 1, step)))
        shares = jnp.concatenate([halves, jnp.minimum(first, 1)[None]])
        ways = jnp.clip(
            point[None] + shares[:, None] * step[None], lower[None], upper[None]
        )
        # Once free unknowns only move by round-off, they may keep an unknown at its
        # bound that should leave it. So each unknown is also moved alone.
        alone = jnp.clip(point - slope / jnp.diagonal(square), lower, upper)
        ways = jnp.concatenate([ways, jnp.where(identity > 0, alone, point)])
        costs = jax.vmap(cost)(ways)
        best = jnp.argmin(costs)
        found = jnp.sum(jnp.where(jnp.arange(len(ways)) == best, ways.T, 0), axis=1)
        better = jnp.min(costs) < cost(point)
        return jnp.where(better, found, point), tried + 1, better

    begin = jnp.clip(jnp.zeros_like(slope_at_zero), lower, upper)
    point, _, _ = lax.while_loop(
        lambda carry: carry[2] & (carry[1] < MOST_STEPS),
        again,
        (begin, jnp.zeros((), jnp.int32), jnp.asarray(True)),
    )
    return point, held_at(point)
