"""The two halves of an off-policy update: acting, and learning from memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxrod.envs import EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.structure import pytree
from jaxrod.training.algorithm import (
    Metrics,
    mean_over_devices,
    steps_per_update,
)
from jaxrod.training.algorithms.actor_critic import Learner
from jaxrod.training.algorithms.off_policy import (
    OffPolicyConfig,
    OffPolicyState,
)
from jaxrod.training.algorithms.replay import Transition, append, sample, sample_indices
from jaxrod.training.normalisation import (
    batch_moments,
    merge_moments,
    normalise,
)
from jaxrod.training.short_episodes import restart_phase


@pytree
class Batch:
    """Transitions and noise of one gradient step."""

    transition: Transition
    """Transitions with normalised observations and scaled rewards."""
    noise: tuple[Float[Array, "batch action"], ...]
    """Standard normal noise, in the number of arrays that the gradient step uses."""


def act_and_store(
    state: OffPolicyState,
    act: Callable[[Array, Array], Array],
    axis_name: str | None = None,
) -> tuple[OffPolicyState, Metrics]:
    """Acts with the newest policy; before `learning_starts` uniformly at random.

    In each environment the noise is an autoregressive process, z <- c z + sqrt(1 - c^2)
    white, with c the `noise_correlation`. At every decision it is standard normal, but
    it can be slow enough to move an arm noticeably.

    Args:
        state: The train state.
        act: Function (normalised observation, standard normal noise) -> action, on a
            batch.
        axis_name: Mapped axis over which the environments are spread, if any.

    Returns:
        The state with updated environments, memory and moments, the mean reward of a
        control step (not scaled), and the episodes that ended.
    """
    config: OffPolicyConfig = state.config
    environment = VectorEnvironment(state.env)
    warming_up = ~_may_learn(state)
    phase = restart_phase(state.env, config, state.updates)

    def step(
        carry: tuple[VectorState, Array], white: Float[Array, "num_envs action"]
    ) -> tuple[tuple[VectorState, Array], tuple[Transition, EpisodeRecord]]:
        environments, noise = carry
        kept = config.noise_correlation
        noise = kept * noise + jnp.sqrt(1 - kept**2) * white
        observation = environments.observation
        # The normal distribution function makes the noise uniform.
        blind = jax.scipy.special.erf(noise * 0.5**0.5)
        action = act(
            normalise(state.moments, observation, config.observation_limit), noise
        )
        action = jnp.clip(jnp.where(warming_up, blind, action), -1, 1)
        environments, outcome = environment.step(
            environments, action, state.env_params, restart_phase=phase
        )
        return (environments, noise), (
            Transition(
                observation=observation,
                action=action,
                reward=outcome.reward,
                next_observation=outcome.final_observation,
                terminated=outcome.terminated,
            ),
            outcome.episodes,
        )

    shape = (config.rollout_steps, state.env.action_size)
    white = _normal(_keys_of_update(state.action_keys, state), state, shape)
    (environments, noise), (steps, episodes) = jax.lax.scan(
        step, (state.environments, state.action_noise), jnp.swapaxes(white, 0, 1)
    )
    seen = steps.observation.reshape(-1, steps.observation.shape[-1])
    state = dataclasses.replace(
        state,
        environments=environments,
        action_noise=noise,
        replay=append(state.replay, steps),
        moments=merge_moments(state.moments, batch_moments(seen, axis_name)),
    )
    reward = {"reward_mean": mean_over_devices(jnp.mean(steps.reward), axis_name)}
    return state, Metrics(reward, episodes)


def learn(
    state: OffPolicyState,
    gradient_step: Callable[[Learner, list[Batch]], tuple[Learner, dict[str, Array]]],
    acted: Metrics,
    *,
    batches_per_step: int,
    noises: int,
    axis_name: str | None = None,
) -> tuple[OffPolicyState, Metrics]:
    """Makes the gradient steps of one update; none before `learning_starts`.

    Args:
        state: The train state, with an up-to-date memory.
        gradient_step: Function `(learner, batches) -> (learner, report)`.
        acted: Metrics of acting.
        batches_per_step: Number of batches per call; divides `gradient_steps`.
        noises: Number of noise arrays per batch, each of the shape of the actions.
        axis_name: Mapped axis over which the environments are spread, if any.

    Returns:
        The state, and the metrics of acting together with the means of the calls'
        reports (zeros before learning).
    """
    config: OffPolicyConfig = state.config
    per_env = config.batch_size // config.num_envs
    keys = jax.vmap(jax.random.split)(_keys_of_update(state.replay_keys, state))
    times = sample_indices(state.replay, keys[:, 0], config.gradient_steps, per_env)
    size = state.env.action_size
    shape = (config.gradient_steps, noises, per_env, size)
    noise = jnp.moveaxis(_normal(keys[:, 1], state, shape), 0, 3)
    noise = noise.reshape(config.gradient_steps, noises, -1, size)

    def batch(number: Int[Array, ""]) -> Batch:
        found = sample(state.replay, times[number])
        limit = config.observation_limit
        return Batch(
            transition=dataclasses.replace(
                found,
                observation=normalise(state.moments, found.observation, limit),
                next_observation=normalise(
                    state.moments, found.next_observation, limit
                ),
                reward=config.reward_scale * found.reward,
            ),
            noise=tuple(noise[number]),
        )

    def step(number: Int[Array, ""], learner: Learner) -> Any:
        first = number * batches_per_step
        return gradient_step(
            learner, [batch(first + i) for i in range(batches_per_step)]
        )

    def body(number: Int[Array, ""], carry: tuple[Learner, Any]) -> tuple[Learner, Any]:
        learner, total = carry
        learner, report = step(number, learner)
        return learner, jax.tree.map(jnp.add, total, report)

    rounds = config.gradient_steps // batches_per_step
    count = jnp.where(_may_learn(state), rounds, 0)
    shapes = jax.eval_shape(lambda s: step(jnp.int32(0), s)[1], state.learner)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    learner, total = jax.lax.fori_loop(0, count, body, (state.learner, nothing))
    report = jax.tree.map(lambda leaf: leaf / rounds, total)
    state = dataclasses.replace(state, learner=learner, updates=state.updates + 1)
    scalars = acted.scalars | mean_over_devices(report, axis_name)
    return state, Metrics(scalars, acted.episodes)


def _may_learn(state: OffPolicyState) -> Array:
    # Updates are compared, not control steps, which would overflow their integers.
    config: OffPolicyConfig = state.config
    return state.updates >= config.learning_starts / steps_per_update(config)


def _keys_of_update(
    keys: Key[Array, " num_envs"], state: OffPolicyState
) -> Key[Array, " num_envs"]:
    return jax.vmap(lambda key: jax.random.fold_in(key, state.updates))(keys)


def _normal(
    keys: Key[Array, " num_envs"], state: OffPolicyState, shape: tuple[int, ...]
) -> Float[Array, "num_envs *shape"]:
    dtype = state.environments.observation.dtype
    return jax.vmap(lambda key: jax.random.normal(key, shape, dtype))(keys)
