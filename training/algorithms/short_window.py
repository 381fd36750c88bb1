"""A short window of acting, differentiable with respect to the policy's weights."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod.envs import EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.structure import pytree
from jaxrod.training.algorithms.on_policy import (
    OnPolicyState,
    policy_network,
    predicted_value,
    value_network,
)
from jaxrod.training.normalisation import normalise
from jaxrod.training.settings import Scalar
from jaxrod.training.short_episodes import restart_phase


@pytree
class Window:
    """Experience of a window; shapes (rollout_steps, num_envs, ...)."""

    observation: Float[Array, "steps num_envs observation"]
    """Normalised observation to which the action responds."""
    final_observation: Float[Array, "steps num_envs observation"]
    """Normalised observation after the decision, before any restart."""
    raw: Float[Array, "steps num_envs observation"]
    """Observation to which the action responds, not normalised."""
    earned: Float[Array, "steps num_envs"]
    """Scaled contribution to the objective."""
    reward: Float[Array, "steps num_envs"]
    """Reward of the task, not scaled."""
    terminated: Bool[Array, "steps num_envs"]
    """Whether the task ended in this step."""
    done: Bool[Array, "steps num_envs"]
    """Whether the episode ended in this step, for whatever reason."""
    episodes: EpisodeRecord
    """The complete episodes that ended."""


def acted(
    state: OnPolicyState, weights: Any, noise: Float[Array, "steps num_envs action"]
) -> tuple[VectorState, Window]:
    """Acts for a window with a policy of the given weights."""
    config = state.config
    environment = VectorEnvironment(state.env)
    network = policy_network(state.env, config, noise.dtype)
    phase = restart_phase(state.env, config, state.updates)

    def normalised(observation: Array) -> Array:
        return normalise(state.moments, observation, config.observation_limit)

    def decide(environments: VectorState, noise: Array) -> tuple[VectorState, Window]:
        seen = normalised(environments.observation)
        mean, log_std = network.apply({"params": weights}, seen)
        action = jnp.tanh(mean + jnp.exp(log_std)[None] * noise)
        following, outcome = environment.step(
            environments, action, state.env_params, restart_phase=phase
        )
        earned = outcome.reward
        if config.objective == "cost":
            cost = outcome.info["cost"]
            # The cost of a broken arm is unknown, so it counts as zero; the arm is
            # truncated.
            cost = jnp.where(jnp.isfinite(cost), cost, 0)
            earned = -config.action_repeat * cost
        return following, Window(
            observation=seen,
            final_observation=normalised(outcome.final_observation),
            raw=environments.observation,
            earned=config.reward_scale * earned,
            reward=outcome.reward,
            terminated=outcome.terminated,
            done=outcome.terminated | outcome.truncated,
            episodes=outcome.episodes,
        )

    remembered = jax.checkpoint(decide, prevent_cse=False)
    return jax.lax.scan(remembered, state.environments, noise)


def objective(
    window: Window, following: Float[Array, "steps num_envs"], discount: Scalar
) -> Float[Array, ""]:
    """Discounted sums from all starts of the window and of its episodes, per step."""

    def backwards(later: Array, step: Any) -> tuple[Array, Array]:
        earned, terminated, done, value = step
        after = jnp.where(done, jnp.where(terminated, 0, value), later)
        total = earned + discount * after
        return total, total

    steps = (window.earned, window.terminated, window.done, following)
    totals = jax.lax.scan(backwards, following[-1], steps, reverse=True)[1]
    begins = jnp.concatenate([jnp.ones_like(window.done[:1]), window.done[:-1]])
    return jnp.sum(jnp.where(begins, totals, 0)) / window.done.size


def target_value(
    state: OnPolicyState, observation: Float[Array, "*batch observation"]
) -> Float[Array, "*batch"]:
    """Value of normalised observations from the target critic; 0 without a critic."""
    if not state.config.critic:
        return jnp.zeros_like(observation[..., 0])
    network = value_network(state.config, observation.dtype)
    return predicted_value(network, state.weights["target"], observation)
