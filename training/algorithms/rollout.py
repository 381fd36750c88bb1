"""Collection of experience: a policy acts on a batch of environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrod.envs import EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.structure import pytree


@pytree
class Rollout:
    """Experience of `steps` steps of `num_envs` environments."""

    observation: Float[Array, "steps num_envs observation"]
    """Observation to which the action responds."""
    action: Float[Array, "steps num_envs action"]
    """Action drawn by the policy, before clipping to [-1, 1]."""
    reward: Float[Array, "steps num_envs"]
    """Reward, not scaled."""
    terminated: Bool[Array, "steps num_envs"]
    """Whether the task ended in this step."""
    done: Bool[Array, "steps num_envs"]
    """Whether the episode ended in this step, for whatever reason."""
    final_value: Float[Array, "steps num_envs"]
    """Value of the final observation where an episode was cut short, else 0."""
    episodes: EpisodeRecord
    """The complete episodes that ended in each step."""


def collect(
    environment: VectorEnvironment,
    state: VectorState,
    env_params: Any,
    act: Callable[[Array, Array], Array],
    value: Callable[[Array], Array],
    noise: Float[Array, "steps num_envs action"],
    restart_phase: Int[Array, ""] | int = 0,
) -> tuple[VectorState, Rollout]:
    """Acts for `steps` steps.

    Args:
        environment: The batch.
        state: Its state.
        env_params: Parameters of the environment.
        act: Function (observation, noise) -> action, on a batch.
        value: Function observation -> value, on a batch. Called only in steps in which
            an episode is cut short.
        noise: Standard normal noise of the actions.
        restart_phase: Initial step count of new episodes, as in
            `jaxrod.envs.VectorEnvironment.step`.
    """

    def step(
        state: VectorState, noise: Float[Array, "num_envs action"]
    ) -> tuple[VectorState, Rollout]:
        action = act(state.observation, noise)
        following, outcome = environment.step(
            state,
            jnp.clip(action, -1, 1),
            env_params,
            restart_phase=restart_phase,
        )
        cut_short = outcome.truncated & ~outcome.terminated
        final_value = jax.lax.cond(
            jnp.any(cut_short),
            lambda observation: jnp.where(cut_short, value(observation), 0),
            lambda observation: jnp.zeros_like(observation[:, 0]),
            outcome.final_observation,
        )
        return following, Rollout(
            observation=state.observation,
            action=action,
            reward=outcome.reward,
            terminated=outcome.terminated,
            done=outcome.terminated | outcome.truncated,
            final_value=final_value,
            episodes=outcome.episodes,
        )

    return jax.lax.scan(step, state, noise)
