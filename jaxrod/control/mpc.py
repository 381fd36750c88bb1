r"""Model-predictive control: a policy that plans ahead with a model, repeatedly.

A plan gives the actions of the next `horizon` control steps, interpolated linearly
between `knots` or constant between them. One of three methods improves the plan, and
its beginning is executed. `replan` control steps later the plan is shifted in time and
improved again (receding horizon, warm start). The cost to minimise is

$$\frac1K \sum_k |r(x_k)|^2 + \frac{e}{K} \sum_k |u_k|^2
  + \frac{s}{K} \sum_k |u_k - u_{k-1}|^2,$$

with the actions $u_k$ at $K$ knots, the environment's residuals $r$ at the state $x_k$
of every knot, effort $e$ and smoothness $s$. Methods other than `"gauss-newton"` have
the environment's smooth cost in place of $|r|^2$. Methods:

- `"gauss-newton"`: a Gauss-Newton step within the bounds. The Jacobian of the residuals
  has few rows, which one batched reverse pass through the rods computes. The step size
  that lowers the cost most is chosen from several (real-time iteration; Diehl et al.,
  2005).
- `"gradient"`: Adam, with actions clipped to the bounds.
- `"mppi"`: the mean of noisy plans, weighted by exponentials of their costs (Williams
  et al., 2017); no derivatives.

Only the protocol of an environment is used (`jaxrod.envs.Plannable`). Plans do not
foresee randomness: `predict` takes no key.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Key

from jaxrod.control.plans import (
    SHAPES,
    PlanCost,
    by_gauss_newton,
    by_gradient,
    by_sampling,
    check_model,
    piece_weights,
    shift_weights,
)
from jaxrod.structure import pytree, static
from jaxrod.validation import check_count, check_seed

START_DEVIATION, START_ITERATIONS = 0.6, 8
"""Standard deviation [1] of the noisy plans from which an episode's first plan is made,
and number of batches that are drawn."""
METHODS = ("gauss-newton", "gradient", "mppi")


@pytree
class Plan:
    """Memory of a planner for a batch of episodes."""

    values: Float[Array, "batch knots_and_now action"]
    """Planned actions; on axis 1 first the one at the time of planning, then the
    knots."""
    calls: Int[Array, ""]
    """Number of calls of `act` since the start; the same for all episodes."""
    key: Key[Array, ""]
    """Random key for sampling."""
    cost: Float[Array, " batch"]
    """Cost of each episode's plan; for `"mppi"` the lowest of the last samples."""


@pytree
class PlanningPolicy:
    """Policy made by `mpc`; its memory is the current plan.

    Example:
        >>> policy = control.mpc(envs.make("tracking"), horizon=96, knots=6, hold=4)
        >>> plan = policy.init(jnp.zeros((2, 44)), None)  # of two episodes
        >>> plan.values.shape  # now and at six knots, twelve actions
        (2, 7, 12)
    """

    cost: PlanCost
    """Cost of a plan, with the model and the knots."""
    rate: Float[Array, ""]
    """Step size of Adam (`"gradient"`), or standard deviation of samples (`"mppi"`)."""
    key: Key[Array, ""]
    """First random key for sampling."""
    replan: int = static()
    """Number of control steps from one plan to the next."""
    iterations: int = static()
    """Number of iterations of the method per plan."""
    first: int = static()
    """Number of iterations for an episode's first plan."""
    samples: int = static()
    """Number of noisy plans per iteration of `"mppi"`."""
    starts: int = static()
    """Number of noisy plans from which an episode's first plan is made; with 0 it
    begins with zero actions."""
    method: str = static()
    """Method that improves plans, one of `METHODS`."""

    @property
    def action_repeat(self) -> int:
        """Number of control steps for which an action is held."""
        return self.cost.hold

    def init(self, observation: Float[Array, "batch observation"], state: Any) -> Plan:
        """Returns the memory at the start of a batch of episodes: plans of zeros."""
        del state
        batch, dtype = observation.shape[0], observation.dtype
        shape = (batch, self.cost.knots + 1, self.cost.env.action_size)
        return Plan(
            values=jnp.zeros(shape, dtype),
            calls=jnp.zeros((), jnp.int32),
            key=self.key,
            cost=jnp.full(batch, jnp.inf, dtype),
        )

    def act(
        self, memory: Plan, observation: Float[Array, "batch observation"], state: Any
    ) -> tuple[Float[Array, "batch action"], Plan]:
        """Returns the actions of a batch of episodes, and the new memory.

        It plans once every `replan` control steps, for all episodes at the same time,
        so that a jitted program computes no plans in between.
        """
        del observation
        cost = self.cost
        calls = self.replan // cost.hold
        place = memory.calls % calls
        memory = lax.cond(
            place == 0,
            lambda plan: self.planned(plan, state),
            lambda plan: plan,
            memory,
        )
        table = piece_weights(cost.knots, cost.spacing, cost.hold, cost.shape)
        row = lax.dynamic_index_in_dim(
            jnp.asarray(table[:calls], memory.values.dtype), place, keepdims=False
        )
        action = jnp.sum(row[None, :, None] * memory.values, axis=1)
        return action, Plan(memory.values, memory.calls + 1, memory.key, memory.cost)

    def planned(self, memory: Plan, state: Any) -> Plan:
        """Shifts the plans of a batch to the present time, and improves them."""
        cost, dtype = self.cost, memory.values.dtype
        begun = memory.calls > 0
        shift = jnp.asarray(
            shift_weights(cost.knots, cost.spacing, self.replan, cost.shape), dtype
        )
        moved = jnp.sum(shift[None, :, :, None] * memory.values[:, None], axis=2)
        values = jnp.where(begun, moved, memory.values)
        iterations = jnp.where(begun, self.iterations, self.first)
        cost = replace(
            cost,
            effort=cost.effort.astype(dtype),
            smoothness=cost.smoothness.astype(dtype),
        )
        rate = self.rate.astype(dtype)
        key, keys = memory.key, None
        if self.starts > 0 or self.method == "mppi":
            key, own = jax.random.split(memory.key)
            keys = jax.random.split(own, values.shape[0])

        def begin(values: Array, state: Any, key: Any) -> Array:
            wide = jnp.asarray(START_DEVIATION, dtype)
            knots, _ = by_sampling(
                cost,
                values[0],
                values[1:],
                state,
                jnp.asarray(START_ITERATIONS),
                wide,
                key,
                self.starts,
            )
            return jnp.concatenate([values[:1], knots])

        if self.starts > 0:
            values = lax.cond(
                begun,
                lambda values: values,
                lambda values: jax.vmap(begin)(values, state, keys),
                values,
            )

        def one(values: Array, state: Any, key: Any) -> tuple[Array, Array]:
            now, knots = values[0], values[1:]
            if self.method == "gauss-newton":
                knots, reached = by_gauss_newton(cost, now, knots, state, iterations)
            elif self.method == "gradient":
                knots, reached = by_gradient(cost, now, knots, state, iterations, rate)
            else:
                knots, reached = by_sampling(
                    cost, now, knots, state, iterations, rate, key, self.samples
                )
            return jnp.concatenate([now[None], knots]), reached

        values, reached = jax.vmap(one)(values, state, keys)
        return Plan(values, memory.calls, key, reached)


def mpc(
    env: Any,
    params: Any = None,
    *,
    horizon: int = 96,
    knots: int = 6,
    iterations: int | None = None,
    method: str = "gauss-newton",
    shape: str = "lines",
    hold: int = 4,
    replan: int | None = None,
    first: int | None = None,
    effort: float = 1e-3,
    smoothness: float = 1e-2,
    rate: float | None = None,
    samples: int = 32,
    starts: int = 0,
    seed: int = 0,
) -> PlanningPolicy:
    """Makes a policy that replans a finite horizon through a model of the environment.

    It has memory (`jaxrod.envs.MemoryPolicy`) and works with
    `jaxrod.training.evaluate`.

    Args:
        env: The model: an environment with `predict` and `cost`, and `residuals` for
            `"gauss-newton"` (`jaxrod.envs.Plannable`).
        params: Parameters of the model; by default those of the environment.
        horizon: Number of control steps ahead, a multiple of `knots * hold`.
        knots: Number of values planned for each action component.
        iterations: Iterations of the method per plan; by default 1, or 4 for Adam.
        method: `"gauss-newton"`, `"gradient"` or `"mppi"`.
        shape: `"lines"` from knot to knot, or `"steps"`: a knot's value is held from
            the time of the previous knot to its own. A single step is the cheapest
            plan.
        hold: Number of control steps for which an action is held.
        replan: Number of control steps from one plan to the next, a multiple of `hold`,
            at most the horizon; by default the spacing of the knots.
        first: Iterations of the first plan of an episode; by default 8 times
            `iterations`.
        effort: Weight $e$ of the squared norm of actions, averaged over the knots.
        smoothness: Weight $s$ of the squared norm of changes from knot to knot,
            averaged over the knots.
        rate: Step size of Adam, by default 0.15, or standard deviation of the samples,
            by default 0.3.
        samples: Number of noisy plans per iteration of `"mppi"`.
        starts: Number of widely spread noisy plans from which the first plan of an
            episode is made. Use them for tasks in which all plans near zero actions are
            bad. With 0 the first plan begins with zero actions.
        seed: Seed of the samples.

    Raises:
        ValueError: An argument is out of range, or the environment lacks a method that
            planning needs.

    Example:
        >>> policy = control.mpc(envs.make("tracking"), horizon=96, knots=6, hold=4)
        >>> policy.action_repeat, policy.replan, isinstance(policy, envs.MemoryPolicy)
        (4, 16, True)
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}; got {method!r}")
    needed = ("predict", "cost") + (("residuals",) if method == METHODS[0] else ())
    check_model(env, needed, f" by {method!r}")
    if shape not in SHAPES:
        raise ValueError(f"shape must be one of {', '.join(SHAPES)}; got {shape!r}")
    horizon = check_count("horizon", horizon, 1)
    knots = check_count("knots", knots, 1)
    hold = check_count("hold", hold, 1)
    if horizon % (knots * hold):
        raise ValueError(
            f"horizon must be a multiple of knots times hold, {knots * hold} control "
            f"steps; got {horizon}"
        )
    replan = horizon // knots if replan is None else check_count("replan", replan, 1)
    if replan % hold or replan > horizon:
        raise ValueError(
            f"replan must be a multiple of hold, {hold} control steps, and at most the "
            f"horizon, {horizon}; got {replan}"
        )
    usual = 4 if method == "gradient" else 1
    iterations = check_count(
        "iterations", usual if iterations is None else iterations, 1
    )
    first = 8 * iterations if first is None else check_count("first", first, 1)
    samples = check_count("samples", samples, 2)
    starts = check_count("starts", starts, 0)
    if rate is None:
        rate = 0.3 if method == "mppi" else 0.15
    for name, value in (("effort", effort), ("smoothness", smoothness)):
        if not 0 <= value < np.inf:
            raise ValueError(f"{name} must be finite and not negative, got {value!r}")
    if effort == 0 and method == METHODS[0]:
        raise ValueError("effort must be positive for gauss-newton, got 0")
    if not 0 < rate < np.inf:
        raise ValueError(f"rate must be positive and finite, got {rate!r}")
    return PlanningPolicy(
        cost=PlanCost(
            params=env.default_params() if params is None else params,
            effort=jnp.asarray(effort),
            smoothness=jnp.asarray(smoothness),
            env=env,
            knots=knots,
            spacing=horizon // knots,
            hold=hold,
            shape=shape,
        ),
        rate=jnp.asarray(rate),
        key=jax.random.key(check_seed(seed)),
        replan=replan,
        iterations=iterations,
        first=first,
        samples=samples,
        starts=starts,
        method=method,
    )
