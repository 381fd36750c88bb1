r"""Least squares of a few unknowns within a box: projected Newton steps.

The least of $|M z + r|^2$ with $l \le z \le u$. Unknowns at a bound towards which the
cost falls are held, and so are those at a bound across which the Newton step of the
rest leads. Of that step the best of several ways is taken: the whole of it or a part,
cut off at the box, or as far as the first bound; or one unknown goes to its own least,
where the cost falls for sure.

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
    """The least within the box, and which unknowns its bounds hold.

    Args:
        matrix: Of full column rank.
        right: Residuals where the unknowns are zero.
        lower: Smallest values.
        upper: Largest ones.
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
        # Where rounding is all that is left for those which are free, one that should
        # leave its bound may be held because of them: each moves by itself, too.
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
