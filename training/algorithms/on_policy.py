"""Common parts of PPO and TRPO: all but the policy step.

A train state, its initial value, and the experience of one update: a rollout with the
newest policy, its advantages, and the observations. These are normalised by the moments
that were used while acting.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, DTypeLike, Float, Int, Key

from jaxrod.envs import Environment, EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.envs.wrappers import repeating
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import DEVICE_AXIS
from jaxrod.training.algorithms.advantages import generalised_advantages
from jaxrod.training.algorithms.preparation import canonicalise, strip_weak_types
from jaxrod.training.algorithms.rollout import collect
from jaxrod.training.networks import (
    GaussianPolicy,
    NetworkPolicy,
    check_outputs,
    initial_weights,
    layers,
    make_network,
)
from jaxrod.training.normalisation import (
    RunningMoments,
    batch_moments,
    merge_moments,
    no_moments,
    normalise,
)
from jaxrod.training.policy import MLPPolicy, Policy
from jaxrod.training.settings import (
    LearnerConfig,
    Scalar,
    check_finite,
    check_fractions,
    check_learner,
    check_not_negative,
)
from jaxrod.training.short_episodes import restart_phase

ACTIVATION = "tanh"
"""Activation function of all hidden layers, as in the reference implementation."""


@pytree
class OnPolicyConfig(LearnerConfig):
    """Settings common to PPO and TRPO; more are in `LearnerConfig`."""

    trace_decay: Scalar = 0.95
    """Trace decay lambda of the advantage estimate."""
    entropy_weight: Scalar = 0.0
    """Weight of the entropy bonus."""
    initial_log_std: Scalar = 0.0
    """Logarithm of the initial standard deviation of actions."""


@pytree
class OnPolicyState:
    """Complete state of an on-policy run: restored, it continues bit by bit."""

    env: Environment = static()
    """The environment."""
    config: Any
    """Numbers and sizes of the learner."""
    env_params: Any
    """Parameters of the environment."""
    weights: dict[str, Any]
    """Weights of the networks, under "policy" and "value"."""
    optimiser: Any
    """State of the optimiser."""
    moments: RunningMoments
    """Moments of the observations before the current update."""
    environments: VectorState
    """State of the batch of environments."""
    action_keys: Key[Array, " num_envs"]
    """One key per environment, for the noise of its actions."""
    shuffle_key: Key[Array, ""]
    """Key for the order of the minibatches."""
    updates: Int[Array, ""]
    """Number of updates so far."""
    total_updates: Int[Array, ""]
    """Number of updates after which schedules are constant."""


@pytree
class Experience:
    """Experience of one update; shapes (rollout_steps, num_envs, ...)."""

    observation: Float[Array, "steps num_envs observation"]
    """Normalised observation."""
    action: Float[Array, "steps num_envs action"]
    """Action as drawn, before clipping."""
    log_prob: Float[Array, "steps num_envs"]
    """Logarithm of the density with which it was drawn."""
    advantage: Float[Array, "steps num_envs"]
    """Advantage of the action, not normalised."""
    value_target: Float[Array, "steps num_envs"]
    """Scaled return that the value network should predict."""
    value: Float[Array, "steps num_envs"]
    """Scaled return that the value network predicted."""
    reward: Float[Array, "steps num_envs"]
    """Reward, not scaled, for the report."""


def policy_network(
    env: Environment, config: OnPolicyConfig, dtype: DTypeLike
) -> GaussianPolicy:
    """The policy network, without weights; they are in the train state."""
    size = env.action_size
    mean = make_network(config, "policy", size, activation=ACTIVATION, dtype=dtype)
    return GaussianPolicy(mean, size, config.initial_log_std, dtype=dtype)


def value_network(config: OnPolicyConfig, dtype: DTypeLike) -> nn.Module:
    """The value network, without weights; they are in the train state."""
    return make_network(config, "critic", 1, activation=ACTIVATION, dtype=dtype)


def predicted_value(
    network: nn.Module, weights: Any, observation: Float[Array, "*batch observation"]
) -> Float[Array, "*batch"]:
    """Value of normalised observations."""
    output = network.apply({"params": weights}, observation)
    return output[..., 0].astype(observation.dtype)


def log_density(
    standardised: Float[Array, "*batch action"], log_std: Float[Array, " action"]
) -> Float[Array, "*batch"]:
    """Log of the normal density at mean + std z: -sum(z^2/2 + log std + log(2pi)/2)."""
    log_std = jnp.expand_dims(log_std, tuple(range(standardised.ndim - 1)))
    terms = 0.5 * standardised**2 + log_std + 0.5 * jnp.log(2 * jnp.pi)
    return -jnp.sum(terms.astype(standardised.dtype), axis=-1)


def start(
    key: Key[Array, ""],
    env: Environment,
    config: Any,
    env_params: Any,
    total_updates: int | Int[Array, ""],
    optimiser: Any,
) -> OnPolicyState:
    """The train state before the first update.

    Args:
        key: Typed random key; all randomness of the run comes from it.
        env: The environment.
        config: An `OnPolicyConfig`.
        env_params: Parameters of the environment, None for its defaults.
        total_updates: Length of the schedules, in updates.
        optimiser: Optax transformation that makes the optimiser's state.
    """
    env = repeating(env, config.action_repeat)
    config, env_params, dtype = canonicalise(key, env, config, env_params)
    keys = jax.random.split(key, 5)
    dummy = jnp.zeros(env.observation_size, dtype)
    policy, value = policy_network(env, config, dtype), value_network(config, dtype)
    weights = {
        "policy": initial_weights(policy, keys[0], dummy),
        "value": initial_weights(value, keys[1], dummy),
    }
    mean_weights = weights["policy"].get("mean", {})
    check_outputs(policy.mean, mean_weights, dummy, env.action_size)
    check_outputs(value, weights["value"], dummy, 1)
    environments = VectorEnvironment(env).reset(
        keys[2],
        config.num_envs,
        env_params,
        spread_phases=config.spread_phases,
        phase=restart_phase(env, config, 0),
    )
    return OnPolicyState(
        env=env,
        config=config,
        env_params=env_params,
        weights=weights,
        optimiser=optimiser.init(weights),
        moments=no_moments(env.observation_size, dtype),
        environments=strip_weak_types(environments, dtype),
        action_keys=jax.random.split(keys[3], config.num_envs),
        shuffle_key=keys[4],
        updates=jnp.zeros((), jnp.int32),
        total_updates=jnp.asarray(total_updates, jnp.int32),
    )


def gather_experience(
    state: OnPolicyState, axis_name: str | None = None
) -> tuple[OnPolicyState, Experience, EpisodeRecord]:
    """Acts with the newest policy and estimates the advantages.

    Returns:
        The state with updated environments and moments (the experience is normalised by
        the earlier moments), the experience, and the episodes that ended in it.
    """
    config: OnPolicyConfig = state.config
    dtype = state.environments.observation.dtype
    policy = policy_network(state.env, config, dtype)
    values = value_network(config, dtype)

    def normalised(observation: Array) -> Array:
        return normalise(state.moments, observation, config.observation_limit)

    def act(observation: Array, noise: Array) -> Array:
        mean, log_std = policy.apply(
            {"params": state.weights["policy"]}, normalised(observation)
        )
        return mean + jnp.exp(log_std)[None] * noise

    def value(observation: Array) -> Array:
        # The network expects normalised observations.
        return predicted_value(values, state.weights["value"], observation)

    noise = action_noise(state)
    environments, rollout = collect(
        VectorEnvironment(state.env),
        state.environments,
        state.env_params,
        act,
        lambda observation: value(normalised(observation)),
        noise,
        restart_phase(state.env, config, state.updates),
    )
    observation = normalised(rollout.observation)
    predicted = value(observation)
    advantage = generalised_advantages(
        reward=config.reward_scale * rollout.reward,
        value=predicted,
        last_value=value(normalised(environments.observation)),
        final_value=rollout.final_value,
        terminated=rollout.terminated,
        done=rollout.done,
        discount=config.discount,
        trace_decay=config.trace_decay,
    )
    experience = Experience(
        observation=observation,
        action=rollout.action,
        log_prob=log_density(noise, state.weights["policy"]["log_std"]),
        advantage=advantage,
        value_target=advantage + predicted,
        value=predicted,
        reward=rollout.reward,
    )
    seen = rollout.observation.reshape(-1, rollout.observation.shape[-1])
    state = dataclasses.replace(
        state,
        environments=environments,
        moments=merge_moments(state.moments, batch_moments(seen, axis_name)),
    )
    return state, experience, rollout.episodes


def partition(state: OnPolicyState) -> OnPolicyState:
    """The environments are split over the devices; everything else is replicated."""
    repeated, spread = PartitionSpec(), PartitionSpec(DEVICE_AXIS)
    specs: dict[str, Any] = {
        field.name: repeated
        for field in dataclasses.fields(state)
        if field.name != "env"
    }
    specs |= {"environments": spread, "action_keys": spread}
    return dataclasses.replace(state, **specs)


def deterministic_policy(state: OnPolicyState) -> Policy:
    """The mean of the action distribution, clipped to [-1, 1]."""
    config, moments = state.config, state.moments
    weights = state.weights["policy"].get("mean", {})
    if config.network is None:
        return MLPPolicy(
            moments=moments,
            limit=config.observation_limit,
            layers=layers(weights),
            activation=ACTIVATION,
            output="clip",
            action_repeat=config.action_repeat,
        )
    return NetworkPolicy(
        moments=moments,
        limit=config.observation_limit,
        weights=weights,
        network=config.network,
        output_size=state.env.action_size,
        action_size=state.env.action_size,
        output="clip",
        action_repeat=config.action_repeat,
    )


def check_on_policy(config: OnPolicyConfig, num_devices: int) -> None:
    """Raises ValueError if a size or number is invalid."""
    check_learner(config, num_devices)
    check_fractions(config, "trace_decay")
    check_not_negative(config, "entropy_weight")
    check_finite(config, "initial_log_std")


def action_noise(state: OnPolicyState) -> Float[Array, "steps num_envs action"]:
    """Noise of the actions of one update, drawn from each environment's own key."""
    shape = (state.config.rollout_steps, state.env.action_size)
    dtype = state.environments.observation.dtype
    noise = jax.vmap(
        lambda key: jax.random.normal(
            jax.random.fold_in(key, state.updates), shape, dtype
        )
    )(state.action_keys)
    return jnp.swapaxes(noise, 0, 1)
