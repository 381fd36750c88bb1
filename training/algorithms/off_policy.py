"""Common parts of SAC, TD3 and DDPG: everything except the gradient steps.

An update makes `rollout_steps` decisions in every environment and stores them. Then it
makes `gradient_steps` gradient steps, each on a batch drawn from the replay buffer. Its
update-to-data ratio is `gradient_steps / (num_envs * rollout_steps)` gradient steps per
decision. A decision is an action held for `action_repeat` control steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxrod.envs import Environment, EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.envs.wrappers import repeating
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import (
    Metrics,
    mean_over_devices,
    steps_per_update,
)
from jaxrod.training.algorithms.actor_critic import ACTIVATION, Learner
from jaxrod.training.algorithms.preparation import (
    SPREAD,
    SPREAD_MEMORY,
    LearnerState,
    canonicalise,
    check_memory,
    network_policy,
    restart_phase,
    slots,
    spread_over_devices,
    started,
)
from jaxrod.training.algorithms.replay import (
    ReplayBuffer,
    Transition,
    append,
    empty_replay,
    sample,
    sample_indices,
)
from jaxrod.training.normalisation import (
    batch_moments,
    merge_moments,
    no_moments,
    normalise,
)
from jaxrod.training.policy import Policy
from jaxrod.training.settings import (
    LearnerConfig,
    Scalar,
    check_counts,
    check_fractions,
    check_learner,
    check_not_negative,
    check_positive,
)


@pytree
class OffPolicyConfig(LearnerConfig):
    """Settings common to SAC, TD3 and DDPG; more are in `LearnerConfig`.

    There are `gradient_steps` gradient steps per `num_envs * rollout_steps` decisions;
    by default one per 16 decisions.

    Example:
        >>> config = training.OffPolicyConfig(gradient_steps=128)
        >>> config.num_envs * config.rollout_steps // config.gradient_steps  # decisions
        8
    """

    rollout_steps: int = static(default=8)
    gradient_steps: int = static(default=64)
    """Gradient steps of the critics in one update."""
    batch_size: int = static(default=256)
    """Transitions of one gradient step, a multiple of `num_envs`."""
    buffer_size: int = static(default=1_000_000)
    """Largest number of transitions in the replay buffer."""
    learning_starts: Scalar = 10_000.0
    """Control steps with random actions before learning starts."""
    noise_correlation: Scalar = 0.0
    """Correlation of the action noise from one decision to the next, at least 0 and
    below 1: 0 is white noise; near 1 the noise is slow and explores further."""
    policy_learning_rate: Scalar = 1e-3
    """Step size of Adam for the policy."""
    critic_learning_rate: Scalar = 1e-3
    """Step size of Adam for the critics."""
    target_rate: Scalar = 0.005
    """Polyak rate rho of target weights: w_target <- w_target + rho (w - w_target)."""


@pytree
class OffPolicyState(LearnerState):
    """Train state of an off-policy run: everything needed to continue it."""

    learner: Learner
    """Weights and optimiser states."""
    replay: ReplayBuffer
    """Replay buffer of transitions, not normalised and not scaled."""
    action_keys: Key[Array, " num_envs"]
    """One key per environment, for the noise of its actions."""
    action_noise: Float[Array, "num_envs action"]
    """Standard normal noise of the last decision, with which that of the next one is
    correlated."""
    replay_keys: Key[Array, " num_envs"]
    """One key per environment, for the samples drawn from its transitions."""


def start(
    key: Key[Array, ""],
    env: Environment,
    config: OffPolicyConfig,
    env_params: Any = None,
    total_steps: int | Int[Array, ""] = 10_000_000,
    *,
    make_learner: Callable[[Key[Array, ""], Environment, Any, Any], Learner],
) -> OffPolicyState:
    """The train state before the first update; pure, so it can be vmapped over keys.

    Args:
        key: Typed random key; all randomness of the run comes from it.
        env: The environment.
        config: Settings, whose numbers can also be vmapped.
        env_params: Parameters of the environment, None for its defaults.
        total_steps: Control steps of the run, over which schedules run from their first
            to their last value.
        make_learner: Function `(key, env, config, dtype) -> Learner` that makes initial
            weights and optimiser states.
    """
    updates = -(-total_steps // steps_per_update(config))
    env = repeating(env, config.action_repeat)
    config, env_params, dtype = canonicalise(key, env, config, env_params)
    keys = jax.random.split(key, 4)
    action_keys = jax.random.split(keys[2], config.num_envs)
    return OffPolicyState(
        env=env,
        config=config,
        env_params=env_params,
        learner=make_learner(keys[0], env, config, dtype),
        moments=no_moments(env.observation_size, dtype),
        environments=started(keys[1], env, config, env_params, dtype),
        replay=empty_replay(
            slots(config),
            config.num_envs,
            env.observation_size,
            env.action_size,
            dtype,
        ),
        action_keys=action_keys,
        action_noise=jax.vmap(
            lambda key: jax.random.normal(key, (env.action_size,), dtype)
        )(action_keys),
        replay_keys=jax.random.split(keys[3], config.num_envs),
        updates=jnp.zeros((), jnp.int32),
        total_updates=jnp.asarray(updates, jnp.int32),
    )


def partition(state: OffPolicyState) -> OffPolicyState:
    """Partition specs: environments, replay and their keys are split over devices."""
    return spread_over_devices(
        state,
        environments=SPREAD,
        replay=SPREAD_MEMORY,
        action_keys=SPREAD,
        action_noise=SPREAD,
        replay_keys=SPREAD,
    )


def deterministic_policy(state: OffPolicyState, outputs_per_action: int = 1) -> Policy:
    """Deterministic policy: tanh of the policy network's first outputs."""
    weights = state.learner.weights["policy"]
    return network_policy(state, weights, ACTIVATION, "tanh", outputs_per_action)


def check_off_policy(config: OffPolicyConfig, num_devices: int) -> None:
    """Raises ValueError if a setting is invalid."""
    check_learner(config, num_devices)
    check_counts(config, "gradient_steps", "batch_size")
    check_memory(config)
    check_fractions(config, "target_rate", "noise_correlation")
    if config.noise_correlation == 1:
        raise ValueError(
            "noise_correlation must be less than 1, got 1.0, which freezes the noise"
        )
    check_positive(config, "policy_learning_rate", "critic_learning_rate")
    check_not_negative(config, "learning_starts")


@pytree
class Batch:
    """Transitions and noise for one gradient step."""

    transition: Transition
    """Transitions with normalised observations and scaled rewards."""
    noise: tuple[Float[Array, "batch action"], ...]
    """Standard normal noise, one array for each use in the gradient step."""


def act_and_store(
    state: OffPolicyState,
    act: Callable[[Array, Array], Array],
    axis_name: str | None = None,
) -> tuple[OffPolicyState, Metrics]:
    """Acts for `rollout_steps` decisions and stores the transitions.

    Before `learning_starts` the actions are uniform random numbers in [-1, 1]. In each
    environment the noise is an autoregressive process, z <- c z + sqrt(1 - c^2) w, with
    white noise w and the `noise_correlation` c. At every decision z is standard normal,
    but it can change slowly enough to move an arm noticeably.

    Args:
        state: The train state.
        act: Function (normalised observation, standard normal noise) -> action, on a
            batch.
        axis_name: Mapped axis over which the environments are spread, if any.

    Returns:
        The state with updated environments, replay buffer and moments, and metrics: the
        mean reward of a decision (not scaled), and results of the complete episodes
        that ended.
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
        # erf(z / sqrt(2)) of a standard normal z is uniform in [-1, 1].
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
        state: The train state after `act_and_store`.
        gradient_step: Function `(learner, batches) -> (learner, report)`, with scalars
            by name as report.
        acted: Metrics of `act_and_store`.
        batches_per_step: Number of batches for each call of `gradient_step`; divides
            `gradient_steps`.
        noises: Number of noise arrays per batch, each with the shape of the actions.
        axis_name: Mapped axis over which the environments are spread, if any.

    Returns:
        The state, and the metrics `acted` together with the means of the reports
        (zeros before `learning_starts`).
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
