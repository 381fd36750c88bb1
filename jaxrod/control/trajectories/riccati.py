r"""The backward pass of iLQR in square-root form.

Along a trajectory states change by $\delta x_{k+1} = A_k \delta x_k + B_k \delta u_k$,
and residuals are $r_k + C_k \delta x_{k+1} + D_k \delta u_k$. The optimal cost-to-go is
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

Source: Y. Tassa, N. Mansard, E. Todorov, Control-limited differential dynamic
programming, ICRA 2014, section IV; D. P. Bertsekas, Projected Newton methods for
optimization problems with simple constraints, SIAM J. Control Optim. 20 (1982).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from jaxrod.structure import pytree

MOST_STEPS = 40
HALVINGS = 8


@pytree
class Linear:
    """Linearised dynamics and residuals of all intervals of a trajectory."""

    states: Float[Array, "intervals n n"]
    """Derivatives $A_k$ of the next state by the state."""
    controls: Float[Array, "intervals n m"]
    """Derivatives $B_k$ of the next state by the control."""
    residuals: Float[Array, "intervals r"]
    """Residuals $r_k$ of every interval."""
    by_states: Float[Array, "intervals r n"]
    """Derivatives $C_k$ of the residuals by the state after the interval."""
    by_controls: Float[Array, "intervals r m"]
    """Derivatives $D_k$ of the residuals by the control."""
    final: Float[Array, " f"]
    """Residuals of the last state."""
    final_by_state: Float[Array, "f n"]
    """Derivatives of the final residuals by the last state."""


def backward(
    linear: Linear,
    controls: Float[Array, "intervals m"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    damping: Float[Array, " m"],
) -> tuple[Float[Array, "intervals m"], Float[Array, "intervals m n"]]:
    """Returns the optimal changes of the controls, and their feedback gains.

    The gains are derivatives of the controls by the states.

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
