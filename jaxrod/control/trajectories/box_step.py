r"""Least squares of a few unknowns within a box, by projected Newton steps.

Minimises $|M z + r|^2$ subject to $l \le z \le u$. An unknown at a bound is held there
if the cost falls towards the bound, or if the Newton step of the free unknowns crosses
the bound. Several candidates are then compared, and the best is taken: the whole Newton
step or a part of it, clipped to the box; the step up to the first bound; or one unknown
moved to its own minimum, which is sure to lower the cost.

Source: Y. Tassa, N. Mansard, E. Todorov, Control-limited differential dynamic
programming, ICRA 2014, section IV; D. P. Bertsekas, Projected Newton methods for
optimization problems with simple constraints, SIAM J. Control Optim. 20 (1982).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

MOST_STEPS = 40
HALVINGS = 8


def box_step(
    matrix: Float[Array, "rows unknowns"],
    right: Float[Array, " rows"],
    lower: Float[Array, " unknowns"],
    upper: Float[Array, " unknowns"],
) -> tuple[Float[Array, " unknowns"], Bool[Array, " unknowns"]]:
    """Returns the minimum within the box, and which unknowns are held at a bound.

    Args:
        matrix: Matrix $M$ of full column rank.
        right: Residuals $r$ at zero unknowns.
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
        # Once the free unknowns only move by round-off, they may keep an unknown held
        # that should leave its bound. So each unknown is also moved by itself.
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
