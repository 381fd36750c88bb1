"""Common parts of SAC, TD3 and DDPG: all but the gradient steps.

An update makes `rollout_steps` decisions in every environment and stores them. Then it
makes `gradient_steps` gradient steps, each on a batch drawn from the whole memory. Its
update-to-data ratio is `gradient_steps / (num_envs * rollout_steps)` gradient steps per
decision. A decision is one control step, or `action_repeat` of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, Int, Key

from jaxrod.envs import Environment, VectorEnvironment, VectorState
from jaxrod.envs.action_repeat import repeating
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import DEVICE_AXIS
from jaxrod.training.algorithms.actor_critic import ACTIVATION, Learner
from jaxrod.training.algorithms.preparation import canonicalise, strip_weak_types
from jaxrod.training.algorithms.replay import Replay, empty_replay
from jaxrod.training.networks import NetworkPolicy, layers
from jaxrod.training.normalisation import RunningMoments, no_moments
from jaxrod.training.policy import MLPPolicy, Policy
from jaxrod.training.settings import (
    LearnerConfig,
    Scalar,
    check_counts,
    check_fractions,
    check_learner,
    check_not_negative,
    check_positive,
)
from jaxrod.training.short_episodes import restart_phase


@pytree
class OffPolicyConfig(LearnerConfig):
    """Settings common to SAC, TD3 and DDPG; more are in `LearnerConfig`.

    There are `gradient_steps` gradient steps for `num_envs * rollout_steps` decisions;
    by default one for every 16.
    """

    rollout_steps: int = static(default=8)
    gradient_steps: int = static(default=64)
    """Gradient steps of the critics in one update."""
    batch_size: int = static(default=256)
    """Transitions of one gradient step, a multiple of `num_envs`."""
    buffer_size: int = static(default=1_000_000)
    """Largest number of transitions in memory."""
    learning_starts: Scalar = 10_000.0
    """Control steps with random actions before learning starts."""
    noise_correlation: Scalar = 0.0
    """Correlation of the action noise from one decision to the next: white at 0, slow
    near 1, where it explores further. Below 1."""
    policy_learning_rate: Scalar = 1e-3
    """Step size of Adam for the policy."""
    critic_learning_rate: Scalar = 1e-3
    """Step size of Adam for the critics."""
    target_rate: Scalar = 0.005
    """Polyak rate: share by which target weights move towards the weights that they
    follow."""


@pytree
class OffPolicyState:
    """Complete state of an off-policy run: restored, it continues bit by bit."""

    env: Environment = static()
    """The environment."""
    config: Any
    """Numbers and sizes of the learner."""
    env_params: Any
    """Parameters of the environment."""
    learner: Learner
    """Weights and optimisers."""
    moments: RunningMoments
    """Moments of all observations acted on."""
    environments: VectorState
    """State of the batch of environments."""
    replay: Replay
    """Replay buffer."""
    action_keys: Key[Array, " num_envs"]
    """One key per environment, for the noise of its actions."""
    action_noise: Float[Array, "num_envs action"]
    """Noise of the last decision, standard normal."""
    replay_keys: Key[Array, " num_envs"]
    """One key per environment, for the samples drawn from its ring."""
    updates: Int[Array, ""]
    """Number of updates so far."""
    total_updates: Int[Array, ""]
    """Number of updates of the whole run."""


def start(
    key: Key[Array, ""],
    env: Environment,
    config: OffPolicyConfig,
    env_params: Any,
    total_updates: int | Int[Array, ""],
    make_learner: Callable[[Key[Array, ""], Any, Any], Learner],
) -> OffPolicyState:
    """The train state before the first update.

    Args:
        key: Typed random key; all randomness of the run comes from it.
        env: The environment.
        config: Configuration of the learner.
        env_params: Parameters of the environment, None for its defaults.
        total_updates: Number of updates of the whole run.
        make_learner: `(key, config, dtype) -> Learner`.
    """
    env = repeating(env, config.action_repeat)
    config, env_params, dtype = canonicalise(key, env, config, env_params)
    keys = jax.random.split(key, 4)
    environments = VectorEnvironment(env).reset(
        keys[1],
        config.num_envs,
        env_params,
        spread_phases=config.spread_phases,
        phase=restart_phase(env, config, 0),
    )
    action_keys = jax.random.split(keys[2], config.num_envs)
    return OffPolicyState(
        env=env,
        config=config,
        env_params=env_params,
        learner=make_learner(keys[0], config, dtype),
        moments=no_moments(env.observation_size, dtype),
        environments=strip_weak_types(environments, dtype),
        replay=empty_replay(
            _slots(config),
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
        total_updates=jnp.asarray(total_updates, jnp.int32),
    )


def partition(state: OffPolicyState) -> OffPolicyState:
    """Environments and their memories are split over the devices."""
    # Tree prefixes: each stands for all leaves below, though their types differ.
    repeated: Any = PartitionSpec()
    spread: Any = PartitionSpec(DEVICE_AXIS)
    memory: Any = PartitionSpec(None, DEVICE_AXIS)
    specs: dict[str, Any] = {
        field.name: repeated
        for field in dataclasses.fields(state)
        if field.name != "env"
    }
    specs |= {
        "environments": spread,
        "replay": Replay(memory, repeated),
        "action_keys": spread,
        "action_noise": spread,
        "replay_keys": spread,
    }
    return dataclasses.replace(state, **specs)


def deterministic_policy(state: OffPolicyState, outputs_per_action: int = 1) -> Policy:
    """The tanh of the policy network's first outputs, one for each action."""
    config, moments = state.config, state.moments
    weights = state.learner.weights["policy"]
    size = state.env.action_size
    if config.network is None:
        *hidden, (kernel, bias) = layers(weights)
        return MLPPolicy(
            moments=moments,
            limit=config.observation_limit,
            layers=(*hidden, (kernel[:, :size], bias[:size])),
            activation=ACTIVATION,
            output="tanh",
            action_repeat=config.action_repeat,
        )
    return NetworkPolicy(
        moments=moments,
        limit=config.observation_limit,
        weights=weights,
        network=config.network,
        output_size=outputs_per_action * size,
        action_size=size,
        output="tanh",
        action_repeat=config.action_repeat,
    )


def check_off_policy(config: OffPolicyConfig, num_devices: int) -> None:
    """Raises ValueError if a size or number is invalid."""
    check_learner(config, num_devices)
    check_counts(config, "gradient_steps", "batch_size")
    if config.batch_size % config.num_envs:
        raise ValueError(
            f"batch_size must be a multiple of num_envs, {config.num_envs}, "
            f"got {config.batch_size}"
        )
    decisions = config.num_envs * config.rollout_steps
    if config.buffer_size < decisions:
        raise ValueError(
            f"buffer_size must be at least the decisions of one update, {decisions}, "
            f"got {config.buffer_size}"
        )
    check_fractions(config, "target_rate", "noise_correlation")
    if config.noise_correlation == 1:
        raise ValueError("noise_correlation must be less than 1, got 1.0: frozen noise")
    check_positive(config, "policy_learning_rate", "critic_learning_rate")
    check_not_negative(config, "learning_starts")


def _slots(config: OffPolicyConfig) -> int:
    """Length of the ring: whole rollouts, at most `buffer_size` transitions."""
    rollouts = config.buffer_size // (config.num_envs * config.rollout_steps)
    return rollouts * config.rollout_steps
