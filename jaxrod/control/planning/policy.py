"""A policy that plans: its memory, when it plans, and how plans are shifted in time."""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key

from jaxrod.control.planning.plans import (
    PlanCost,
    by_gauss_newton,
    by_gradient,
    by_sampling,
    piece_weights,
    shift_weights,
)
from jaxrod.structure import pytree, static

START_DEVIATION, START_ITERATIONS = 0.6, 8
"""Standard deviation of the noisy plans from which an episode's first plan is made, and
number of times they are drawn."""
METHODS = ("gauss-newton", "gradient", "mppi")


class Model(Protocol):
    """Protocol of an environment for planning; all tasks of the arm have it."""

    @property
    def action_size(self) -> int:
        """Length of the action vector."""

    def default_params(self) -> Any:
        """Parameters of the task."""

    def predict(
        self, state: Any, action: Array, params: Any, control_steps: int = 1
    ) -> Any:
        """Returns the state some control steps later, without future randomness."""

    def cost(self, state: Any, action: Array, params: Any) -> Float[Array, ""]:
        """Returns the smooth cost of a state and the action that led there."""


def check_model(env: Any, needed: tuple[str, ...], planner: str = "") -> None:
    """Raises a ValueError unless an environment has the methods that a planner needs.

    Args:
        env: The environment.
        needed: Names of the methods.
        planner: Words for the planner in the error message.
    """
    missing = [name for name in needed if not hasattr(env, name)]
    if missing:
        raise ValueError(
            f"{type(env).__name__} cannot be planned with{planner}: it has no "
            f"{' and no '.join(missing)} (jaxrod.envs.Plannable)"
        )


@pytree
class Plan:
    """Memory of a planner for a batch of episodes."""

    values: Float[Array, "batch knots_and_now action"]
    """Actions at the time of the plan, and at its knots."""
    calls: Int[Array, ""]
    """Number of actions so far; the same for all episodes."""
    key: Key[Array, ""]
    """Random key for sampling."""
    cost: Float[Array, " batch"]
    """Cost of the plan, as the method defines it."""


@pytree
class PlanningPolicy:
    """A policy with memory that plans; see the module. Make one with `mpc`."""

    params: Any
    """Parameters of the model."""
    effort: Float[Array, ""]
    """Weight of the mean squared action."""
    smoothness: Float[Array, ""]
    """Weight of the mean squared change from knot to knot."""
    rate: Float[Array, ""]
    """Step size of Adam, or standard deviation of the samples."""
    key: Key[Array, ""]
    """First random key for sampling."""
    env: Any = static()
    """The model."""
    horizon: int = static()
    """Control steps ahead."""
    knots: int = static()
    """Number of knots, the values planned for each action."""
    action_repeat: int = static()
    """Control steps for which an action is held."""
    replan: int = static()
    """Control steps from plan to plan."""
    iterations: int = static()
    """Iterations of each plan."""
    first: int = static()
    """Iterations of an episode's first plan."""
    samples: int = static()
    """Noisy plans in each iteration of `"mppi"`."""
    starts: int = static()
    """Noisy plans from which an episode's first plan is made."""
    method: str = static()
    """One of `METHODS`."""
    shape: str = static(default="lines")
    """Shape of a plan between knots, one of `jaxrod.control.planning.plans.SHAPES`."""

    def init(self, observation: Float[Array, "batch observation"], state: Any) -> Plan:
        """Returns the memory at the start of a batch of episodes."""
        del state
        batch, dtype = observation.shape[0], observation.dtype
        shape = (batch, self.knots + 1, self.env.action_size)
        return Plan(
            values=jnp.zeros(shape, dtype),
            calls=jnp.zeros((), jnp.int32),
            key=self.key,
            cost=jnp.full(batch, jnp.inf, dtype),
        )

    def act(
        self, memory: Plan, observation: Float[Array, "batch observation"], state: Any
    ) -> tuple[Float[Array, "batch action"], Plan]:
        """Returns the actions of a batch and the new memory; plans if it is due.

        All episodes of the batch plan at the same time, so that a jitted program
        computes no plans in between.
        """
        del observation
        spacing = self.horizon // self.knots
        calls = self.replan // self.action_repeat
        place = memory.calls % calls
        memory = lax.cond(
            place == 0,
            lambda plan: self.planned(plan, state),
            lambda plan: plan,
            memory,
        )
        table = piece_weights(self.knots, spacing, self.action_repeat, self.shape)
        row = lax.dynamic_index_in_dim(
            jnp.asarray(table[:calls], memory.values.dtype), place, keepdims=False
        )
        action = jnp.sum(row[None, :, None] * memory.values, axis=1)
        return action, Plan(memory.values, memory.calls + 1, memory.key, memory.cost)

    def planned(self, memory: Plan, state: Any) -> Plan:
        """Shifts the plans of a batch to the present time, and improves them."""
        spacing = self.horizon // self.knots
        begun = memory.calls > 0
        shift = jnp.asarray(
            shift_weights(self.knots, spacing, self.replan, self.shape),
            memory.values.dtype,
        )
        moved = jnp.sum(shift[None, :, :, None] * memory.values[:, None], axis=2)
        values = jnp.where(begun, moved, memory.values)
        iterations = jnp.where(begun, self.iterations, self.first)
        cost = PlanCost(
            params=self.params,
            effort=self.effort.astype(values.dtype),
            smoothness=self.smoothness.astype(values.dtype),
            env=self.env,
            knots=self.knots,
            spacing=spacing,
            hold=self.action_repeat,
            shape=self.shape,
        )
        rate = self.rate.astype(values.dtype)
        key, own = jax.random.split(memory.key)
        keys = jax.random.split(own, values.shape[0])

        def begin(values: Array, state: Any, key: Array) -> Array:
            wide = jnp.asarray(START_DEVIATION, values.dtype)
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

        def one(values: Array, state: Any, key: Array) -> tuple[Array, Array]:
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
