"""Generalised advantage estimation that distinguishes truncation from termination."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod.training.algorithm import mean_over_devices


def generalised_advantages(
    reward: Float[Array, "steps *batch"],
    value: Float[Array, "steps *batch"],
    last_value: Float[Array, "*batch"],
    final_value: Float[Array, "steps *batch"],
    terminated: Bool[Array, "steps *batch"],
    done: Bool[Array, "steps *batch"],
    discount: float | Float[Array, ""],
    trace_decay: float | Float[Array, ""],
) -> Float[Array, "steps *batch"]:
    """Advantages A_t = sum_k (gamma lambda)^k delta_(t+k) within each episode.

    delta_t = r_t + gamma V'_t - V_t. V'_t is the value of the state after step t. It is
    0 if the task ended there (`terminated`), the value of the final observation if the
    episode was only cut short (`done` but not terminated), and V_(t+1) otherwise. The
    sum stops where `done`.

    Args:
        reward: Reward of each step.
        value: Value of the observation that each step acted on.
        last_value: Value of the observation after the last step.
        final_value: Value of the observation at the end of each step, before any
            restart; used only where an episode was cut short.
        terminated: Whether the task ended in this step.
        done: Whether the episode ended in this step, for whatever reason.
        discount: Discount factor gamma in [0, 1].
        trace_decay: Trace decay lambda in [0, 1].

    Source: Schulman et al., "High-dimensional continuous control using
    generalized advantage estimation", 2016; Pardo et al., "Time limits in
    reinforcement learning", 2018.
    """
    following = jnp.concatenate([value[1:], last_value[None]])
    following = jnp.where(done, jnp.where(terminated, 0, final_value), following)
    delta = reward + discount * following - value
    decay = jnp.where(done, 0, discount * trace_decay).astype(delta.dtype)

    def backwards(
        later: Float[Array, "*batch"], step: tuple[Array, Array]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        delta_t, decay_t = step
        advantage = delta_t + decay_t * later
        return advantage, advantage

    start = jnp.zeros_like(last_value)
    return jax.lax.scan(backwards, start, (delta, decay), reverse=True, unroll=8)[1]


def standardised(
    advantage: Float[Array, "*shape"], axes: tuple[int, ...], axis_name: str | None
) -> Float[Array, "*shape"]:
    """Shifts and scales advantages to mean 0 and variance 1.

    Args:
        advantage: Advantages of any shape.
        axes: Axes over which mean and variance are taken.
        axis_name: Mapped axis over which the environments are spread, if any.
    """

    def mean(x: Array) -> Array:
        return mean_over_devices(jnp.mean(x, axis=axes, keepdims=True), axis_name)

    centred = advantage - mean(advantage)
    return centred / (jnp.sqrt(mean(centred**2)) + 1e-8)
