"""Improves the plan of one episode by Gauss-Newton steps, gradients or sampling."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int, Key

from jaxrod.structure import pytree, static

SHARES = (1.0, 0.5, 0.2)
"""Fractions of a Gauss-Newton step that are tried; the best is taken [1]."""
DAMPING = 1e-3
"""Weight of the squared norm of the change of a knot in a Gauss-Newton step, averaged
over the knots."""
BOUND_ITERATIONS = 12
"""Number of ADMM iterations that impose the bounds on a Gauss-Newton step."""
TEMPERATURE = 0.1
"""Temperature in the weights exp(-cost / temperature) of samples, as a fraction of the
standard deviation of their costs [1]."""


def check_model(env: Any, needed: tuple[str, ...], planner: str = "") -> None:
    """Raises a ValueError unless an environment has the methods that a planner needs.

    Args:
        env: The environment.
        needed: Names of the needed methods.
        planner: Description of the planner for the error message.
    """
    missing = [name for name in needed if not hasattr(env, name)]
    if missing:
        raise ValueError(
            f"{type(env).__name__} cannot be planned with{planner}: it has no "
            f"{' and no '.join(missing)} (jaxrod.envs.Plannable)"
        )


@pytree
class PlanCost:
    """Cost of a plan, defined in `jaxrod.control.mpc`.

    A plan has an action at the time of planning and one at each of K later times, the
    knots. Methods take the former as `now` `(action,)`, the latter as `knots`
    `(K, action)`, and the environment's `state` at the time of planning.
    """

    params: Any
    """Parameters of the environment that serves as the model."""
    effort: Float[Array, ""]
    """Weight of the squared norm of actions, averaged over the knots."""
    smoothness: Float[Array, ""]
    """Weight of the squared norm of changes from knot to knot, averaged over the
    knots."""
    env: Any = static()
    """Environment that serves as the model."""
    knots: int = static()
    """Number K of knots: the times of the planned actions after the present one."""
    spacing: int = static()
    """Number of control steps from knot to knot."""
    hold: int = static()
    """Number of control steps for which an action is held."""
    shape: str = static(default="lines")
    """Shape of the plan between knots, one of `SHAPES`."""

    def actions(self, now: Array, knots: Array) -> Float[Array, "knots pieces action"]:
        """Returns the actions of a plan, each held for `hold` control steps.

        They are interpolated between `now` and the actions at the knots, and grouped by
        the knot before which they act: `(K, spacing / hold, action)`.
        """
        table = jnp.asarray(
            piece_weights(self.knots, self.spacing, self.hold, self.shape), knots.dtype
        )
        acted = table @ jnp.concatenate([now[None], knots])
        return jnp.reshape(acted, (self.knots, -1, acted.shape[-1]))

    def along(
        self, now: Array, knots: Array, state: Any, of: Any, sloped: bool
    ) -> Array:
        """Simulates a plan from `state`; evaluates `of` at the time of every knot.

        `of` takes the state at that time, and the last action before it. Its results
        are stacked. If they are differentiated (`sloped`), all states on the way are
        stored. A single loop then keeps half as many arrays for the derivative as two
        nested ones. Otherwise only one state is stored at a time.
        """

        def piece(state: Any, action: Array) -> tuple[Any, Any]:
            after = self.env.predict(state, action, self.params, self.hold)
            return after, after if sloped else None

        def interval(state: Any, actions: Array) -> tuple[Any, Array]:
            state, _ = lax.scan(piece, state, actions)
            return state, of(state, actions[-1])

        actions = self.actions(now, knots)
        if not sloped:
            return lax.scan(interval, state, actions)[1]
        pieces = actions.shape[1]
        flat = jnp.reshape(actions, (-1, actions.shape[-1]))
        states = lax.scan(piece, state, flat)[1]
        reached = jax.tree.map(lambda leaf: leaf[pieces - 1 :: pieces], states)
        return jax.vmap(of)(reached, actions[:, -1])

    def residuals(
        self, now: Array, knots: Array, state: Any, *, sloped: bool = False
    ) -> Float[Array, " all"]:
        """Returns the environment's residuals at the times of all K knots of a plan.

        `now` is the action at the time of planning, `knots` are the actions at the
        knots. The residuals are divided by sqrt(K), so that their squares sum to the
        mean over the knots. Set `sloped` where they are differentiated.
        """
        found = self.along(
            now,
            knots,
            state,
            lambda state, action: self.env.residuals(state, action, self.params),
            sloped,
        )
        return jnp.ravel(found) / jnp.sqrt(self.knots).astype(found.dtype)

    def regular(self, now: Array, knots: Array) -> Float[Array, ""]:
        """Returns the cost of effort and smoothness, averaged over the K knots.

        It is (effort sum |u_k|^2 + smoothness sum |u_k - u_(k-1)|^2) / K, where u_k are
        the actions `knots`, and u_0 is `now`, the action at the time of planning.
        """
        changes = jnp.diff(jnp.concatenate([now[None], knots]), axis=0)
        return (
            self.effort * jnp.sum(knots**2) + self.smoothness * jnp.sum(changes**2)
        ) / self.knots

    def total(
        self, now: Array, knots: Array, state: Any, *, sloped: bool = False
    ) -> Float[Array, ""]:
        """Returns the mean of `env.cost` at the times of the knots, plus `regular`.

        `now` is the action at the time of planning, `knots` are the actions at the
        knots. Set `sloped` where the result is differentiated.
        """
        found = self.along(
            now,
            knots,
            state,
            lambda state, action: self.env.cost(state, action, self.params),
            sloped,
        )
        return jnp.mean(found) + self.regular(now, knots)

    def least_squares(self, now: Array, knots: Array, state: Any) -> Float[Array, ""]:
        """Returns the cost of a plan: sum of squared `residuals`, plus `regular`.

        It is infinite if the sum is not finite. `now` is the action at the time of
        planning, `knots` are the actions at the knots.
        """
        found = jnp.sum(self.residuals(now, knots, state) ** 2)
        return _or_infinite(found + self.regular(now, knots))


def by_gauss_newton(
    cost: PlanCost, now: Array, knots: Array, state: Any, iterations: Int[Array, ""]
) -> tuple[Float[Array, "knots action"], Float[Array, ""]]:
    """Improves a plan by `iterations` Gauss-Newton steps within the bounds of actions.

    `now` is the action at the time of planning, `knots` are the planned actions at the
    knots. Returns the improved actions at the knots, and the cost of the plan.
    """
    shares = jnp.asarray(SHARES, knots.dtype)

    def again(_: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        knots, _ = given
        values, back = jax.vjp(
            lambda z: cost.residuals(now, z, state, sloped=True), knots
        )
        rows = jax.vmap(lambda way: back(way)[0])(
            jnp.eye(values.size, dtype=values.dtype)
        )
        before = _or_infinite(jnp.sum(values**2) + cost.regular(now, knots))
        aim = quadratic_step(cost, values, rows, now, knots)
        tried = knots[None] + shares[:, None, None] * (aim - knots)[None]
        costs = jax.vmap(lambda z: cost.least_squares(now, z, state))(tried)
        best = jnp.argmin(costs)
        better = costs[best] < before
        return jnp.where(better, tried[best], knots), jnp.where(
            better, costs[best], before
        )

    nothing = jnp.asarray(jnp.inf, knots.dtype)
    return lax.fori_loop(0, iterations, again, (knots, nothing))


def quadratic_step(
    cost: PlanCost, values: Array, rows: Array, now: Array, knots: Array
) -> Float[Array, "knots action"]:
    """Minimises the cost with linearised residuals, within the bounds of actions.

    `now` is the action at the time of planning, `knots` are the actions at the knots,
    `values` the residuals, and `rows` their Jacobian J with respect to `knots`. The
    Hessian is J^T J plus a small matrix `(K, K)` that is the same for each action
    component. So only matrices of the number of knots and of the number of residuals
    are inverted (Woodbury). Bounds are imposed by the alternating direction method of
    multipliers (ADMM). Returns the new actions at the knots.
    """
    count, dtype = cost.knots, knots.dtype
    changes = jnp.eye(count, dtype=dtype) - jnp.eye(count, k=-1, dtype=dtype)
    first = jnp.zeros((count, 1), dtype).at[0, 0].set(1)
    smooth, effort = cost.smoothness / count, cost.effort / count
    damping = DAMPING / count
    plain = (effort + damping) * jnp.eye(count, dtype=dtype) + smooth * (
        changes.T @ changes
    )
    aimed = values - jnp.sum(rows * knots[None], axis=(1, 2))
    pulled = smooth * first * now[None] + damping * knots
    pulled -= jnp.sum(rows * aimed[:, None, None], axis=0)
    # Penalty of the bounds: a fraction of the mean diagonal of the Gauss-Newton matrix.
    weight = jnp.sum(rows**2) / rows[0].size * 0.3 + effort
    inverse = _inverse(plain + weight * jnp.eye(count, dtype=dtype))
    flat = jnp.reshape(rows, (rows.shape[0], -1))
    spread = jnp.reshape(
        jnp.sum(inverse[None, :, :, None] * rows[:, None], axis=2), flat.shape
    )
    inner = _inverse(flat @ spread.T + jnp.eye(flat.shape[0], dtype=dtype))

    def solved(side: Array) -> Array:
        plainly = inverse @ side
        known = inner @ (flat @ jnp.ravel(plainly))
        return plainly - jnp.reshape(known @ spread, side.shape)

    def alternate(_: int, given: tuple[Array, Array]) -> tuple[Array, Array]:
        bounded, price = given
        free = solved(pulled + weight * (bounded - price))
        bounded = jnp.clip(free + price, -1, 1)
        return bounded, price + free - bounded

    begin = knots, jnp.zeros_like(knots)
    return lax.fori_loop(0, BOUND_ITERATIONS, alternate, begin)[0]


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix."""
    lower = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    root = solve_triangular(lower, jnp.eye(len(matrix), dtype=matrix.dtype), lower=True)
    return root.T @ root


def by_gradient(
    cost: PlanCost,
    now: Array,
    knots: Array,
    state: Any,
    iterations: Int[Array, ""],
    rate: Array,
) -> tuple[Float[Array, "knots action"], Float[Array, ""]]:
    """Improves a plan by `iterations` steps of Adam with step size `rate`.

    `now` is the action at the time of planning, `knots` are the planned actions at the
    knots. Returns the best actions at the knots, and the cost of the plan.
    """
    slow, slower = 0.8, 0.95

    def again(index: Array, given: Any) -> Any:
        knots, mean, square, best, least = given
        value, slope = jax.value_and_grad(
            lambda z: cost.total(now, z, state, sloped=True)
        )(knots)
        value = _or_infinite(value)
        slope = jnp.where(jnp.isfinite(slope), slope, 0)
        best = jnp.where(value < least, knots, best)
        least = jnp.minimum(value, least)
        mean = slow * mean + (1 - slow) * slope
        square = slower * square + (1 - slower) * slope**2
        number = index + 1
        step = (mean / (1 - slow**number)) / (
            jnp.sqrt(square / (1 - slower**number)) + 1e-8
        )
        return jnp.clip(knots - rate * step, -1, 1), mean, square, best, least

    nothing = jnp.zeros_like(knots)
    infinite = jnp.asarray(jnp.inf, knots.dtype)
    knots, _, _, best, least = lax.fori_loop(
        0, iterations, again, (knots, nothing, nothing, knots, infinite)
    )
    last = _or_infinite(cost.total(now, knots, state))
    return jnp.where(last < least, knots, best), jnp.minimum(last, least)


def by_sampling(
    cost: PlanCost,
    now: Array,
    knots: Array,
    state: Any,
    iterations: Int[Array, ""],
    deviation: Array,
    key: Key[Array, ""],
    samples: int,
) -> tuple[Float[Array, "knots action"], Float[Array, ""]]:
    """Replaces a plan by the weighted mean of noisy plans, `iterations` times (MPPI).

    `now` is the action at the time of planning, `knots` are the planned actions at the
    knots. `samples` plans are drawn with the standard `deviation` about them. Returns
    the actions at the knots, and the lowest cost of the last samples.
    """

    def again(index: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        knots, _ = given
        noise = jax.random.normal(
            jax.random.fold_in(key, index), (samples, *knots.shape), knots.dtype
        )
        # The first sample is the plan itself, so that bad samples cannot replace it.
        noise = jnp.concatenate([jnp.zeros_like(noise[:1]), noise[1:]])
        tried = jnp.clip(knots[None] + deviation * noise, -1, 1)
        costs = jax.vmap(lambda z: _or_infinite(cost.total(now, z, state)))(tried)
        finite = jnp.isfinite(costs)
        least = jnp.min(costs)
        mean = jnp.sum(jnp.where(finite, costs, 0)) / jnp.maximum(jnp.sum(finite), 1)
        spread = jnp.sqrt(
            jnp.sum(jnp.where(finite, (costs - mean) ** 2, 0))
            / jnp.maximum(jnp.sum(finite), 1)
        )
        sharp = TEMPERATURE * spread + jnp.finfo(costs.dtype).tiny
        weights = jnp.where(finite, jnp.exp(-(costs - least) / sharp), 0)
        total = jnp.sum(weights)
        mixed = jnp.sum(weights[:, None, None] * tried, axis=0) / jnp.where(
            total > 0, total, 1
        )
        return jnp.where(total > 0, mixed, knots), least

    nothing = jnp.asarray(jnp.inf, knots.dtype)
    return lax.fori_loop(0, iterations, again, (knots, nothing))


def _or_infinite(cost: Array) -> Array:
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


SHAPES = ("lines", "steps")
"""Interpolation of a plan between its value now and its equally spaced knots: linear,
or in steps, where each knot's value is held from the time of the previous knot to its
own. After the last knot a plan is constant."""


def weights_at(
    times: Float[np.ndarray, " times"], knots: int, spacing: int, shape: str = "lines"
) -> Float[np.ndarray, "times knots_and_now"]:
    """Returns interpolation weights of the value now and of the knots, a row per time.

    Args:
        times: Times from now in the unit of `spacing`, not negative. At the time where
            a step changes its value, the plan still has the earlier value.
        knots: Number of knots; they lie at `spacing`, `2 spacing` and so on.
        spacing: Time between two knots.
        shape: One of `SHAPES`.
    """
    place = np.minimum(np.asarray(times, float) / spacing, knots)
    if shape == "steps":
        place = np.ceil(place)
    corners = np.arange(knots + 1)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - corners[None, :]))


def piece_weights(
    knots: int, spacing: int, hold: int, shape: str = "lines"
) -> Float[np.ndarray, "pieces knots_and_now"]:
    """Returns interpolation weights for the actions of a plan, a row per action.

    Each action is held for `hold` control steps, and is the plan's value in the middle
    of this time. The `knots` are `spacing` control steps apart; `shape` is one of
    `SHAPES`.
    """
    pieces = knots * spacing // hold
    return weights_at((np.arange(pieces) + 0.5) * hold, knots, spacing, shape)


def shift_weights(
    knots: int, spacing: int, by: int, shape: str = "lines"
) -> Float[np.ndarray, "knots_and_now knots_and_now"]:
    """Returns the matrix that shifts a plan, values now and at knots, by `by` steps.

    The new values are those of the old plan `by` control steps later. If the knots of a
    plan in steps are shifted by a part of the spacing, the later step is taken. `shape`
    is one of `SHAPES`.
    """
    return weights_at(by + spacing * np.arange(knots + 1), knots, spacing, shape)
