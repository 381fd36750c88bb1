"""The settings and the state of DAgger, without its updates."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, Int, Key

from jaxrod.envs import Environment, VectorEnvironment, VectorState
from jaxrod.envs.action_repeat import repeating
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import DEVICE_AXIS, steps_per_update
from jaxrod.training.algorithms.held_plan import model_of
from jaxrod.training.algorithms.preparation import canonicalise, strip_weak_types
from jaxrod.training.algorithms.replay import Replay
from jaxrod.training.networks import (
    NetworkPolicy,
    check_outputs,
    initial_weights,
    layers,
    make_network,
)
from jaxrod.training.normalisation import RunningMoments, no_moments
from jaxrod.training.policy import MLPPolicy, Policy
from jaxrod.training.settings import (
    LearnerConfig,
    Scalar,
    check_counts,
    check_learner,
    check_not_negative,
    check_positive,
)
from jaxrod.training.short_episodes import restart_phase

ACTIVATION = "tanh"
"""Activation function of all hidden layers."""


@pytree
class DAggerConfig(LearnerConfig):
    """Settings of DAgger; more are in `LearnerConfig`.

    It does not learn from rewards: `discount` and `reward_scale` must keep their
    defaults.
    """

    num_envs: int = static(default=64)
    rollout_steps: int = static(default=8)
    action_repeat: int = static(default=16)
    hidden_sizes: tuple[int, ...] = static(default=(128, 128))
    lookahead: int = static(default=32)
    """Control steps for which the planner holds an action, and looks ahead."""
    plan_iterations: int = static(default=1)
    """Gauss-Newton steps of the planner, starting from the policy's action."""
    gradient_steps: int = static(default=128)
    """Gradient steps of one update."""
    batch_size: int = static(default=256)
    """Decisions of one gradient step, a multiple of `num_envs`."""
    buffer_size: int = static(default=200_000)
    """Largest number of decisions in memory."""
    effort: Scalar = 1e-2
    """Cost of the mean squared action for the planner."""
    planner_steps: Scalar = 300_000.0
    """Control steps of the run over which the share of decisions in which the planner
    acts falls from 1 to 0, linearly."""
    learning_rate: Scalar = 1e-3
    """Step size of Adam at the start."""
    final_learning_rate: Scalar = 1e-4
    """Step size at the end, reached linearly."""


@pytree
class Advice:
    """Actions of the planner; leading axes depend on the context."""

    observation: Float[Array, "*batch observation"]
    """Observation, not normalised."""
    action: Float[Array, "*batch action"]
    """Action of the planner."""


@pytree
class DAggerState:
    """Complete state of a run: a run restored from it continues bit by bit."""

    env: Environment = static()
    """The environment."""
    config: Any
    """Numbers and sizes of the learner."""
    env_params: Any
    """Parameters of the environment."""
    weights: Any
    """Weights of the policy network."""
    optimiser: Any
    """State of the optimiser."""
    moments: RunningMoments
    """Moments of all observations acted on."""
    environments: VectorState
    """State of the batch of environments."""
    advice: Replay
    """Actions of the planner so far; the oldest are overwritten first."""
    keys: Key[Array, " num_envs"]
    """One key per environment, for the choice of who acts and for the samples."""
    updates: Int[Array, ""]
    """Number of updates so far."""
    total_updates: Int[Array, ""]
    """Number of updates of the whole run."""


def validate(config: DAggerConfig, num_devices: int = 1) -> None:
    """Checks a configuration on the host.

    Raises:
        ValueError: A setting is wrong; the message has its name and value.
    """
    check_learner(config, num_devices)
    check_counts(
        config,
        "lookahead",
        "plan_iterations",
        "gradient_steps",
        "batch_size",
        "buffer_size",
    )
    for name in ("discount", "reward_scale"):
        given, usual = float(getattr(config, name)), getattr(LearnerConfig(), name)
        if given != usual:
            raise ValueError(
                f"{name} has no effect in dagger, which learns from no reward: leave "
                f"it at {usual}, got {given}"
            )
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
    check_positive(config, "effort", "learning_rate", "final_learning_rate")
    check_not_negative(config, "planner_steps")


def init(
    key: Key[Array, ""],
    env: Environment,
    config: DAggerConfig,
    env_params: Any = None,
    total_steps: int | Int[Array, ""] = 1_000_000,
) -> DAggerState:
    """The train state before the first update; pure, so it can be vmapped over keys.

    Args:
        key: Typed random key; all randomness of the run comes from it.
        env: The environment, a `jaxrod.envs.Plannable`.
        config: Settings; their numbers can be vmapped, too.
        env_params: Parameters of the environment, None for its defaults.
        total_steps: Control steps over which the learning rate falls.

    Raises:
        ValueError: The environment is not plannable.
    """
    model_of(env)
    env = repeating(env, config.action_repeat)
    updates = -(-total_steps // steps_per_update(config))
    config, env_params, dtype = canonicalise(key, env, config, env_params)
    keys = jax.random.split(key, 3)
    dummy = jnp.zeros(env.observation_size, dtype)
    network = policy_network(env, config, dtype)
    weights = initial_weights(network, keys[0], dummy)
    check_outputs(network, weights, dummy, env.action_size)
    environments = VectorEnvironment(env).reset(
        keys[1],
        config.num_envs,
        env_params,
        spread_phases=config.spread_phases,
        phase=restart_phase(env, config, 0),
    )
    # Whole rollouts, so that a block never crosses the end of the ring.
    rollouts = config.buffer_size // (config.num_envs * config.rollout_steps)
    shape = (rollouts * config.rollout_steps, config.num_envs)
    advice = Advice(
        jnp.zeros((*shape, env.observation_size), dtype),
        jnp.zeros((*shape, env.action_size), dtype),
    )
    return DAggerState(
        env=env,
        config=config,
        env_params=env_params,
        weights=weights,
        optimiser=optax.scale_by_adam().init(weights),
        moments=no_moments(env.observation_size, dtype),
        environments=strip_weak_types(environments, dtype),
        advice=Replay(advice, jnp.zeros((), jnp.int32)),
        keys=jax.random.split(keys[2], config.num_envs),
        updates=jnp.zeros((), jnp.int32),
        total_updates=jnp.asarray(updates, jnp.int32),
    )


def policy_network(env: Environment, config: DAggerConfig, dtype: Any) -> Any:
    """The policy network, without weights; they are in the train state."""
    size = env.action_size
    return make_network(config, "policy", size, activation=ACTIVATION, dtype=dtype)


def network_policy(state: DAggerState) -> Policy:
    """The network on normalised observations, clipped to [-1, 1]."""
    config, moments = state.config, state.moments
    if config.network is None:
        return MLPPolicy(
            moments=moments,
            limit=config.observation_limit,
            layers=layers(state.weights),
            activation=ACTIVATION,
            output="clip",
            action_repeat=config.action_repeat,
        )
    return NetworkPolicy(
        moments=moments,
        limit=config.observation_limit,
        weights=state.weights,
        network=config.network,
        output_size=state.env.action_size,
        action_size=state.env.action_size,
        output="clip",
        action_repeat=config.action_repeat,
    )


def partition(state: DAggerState) -> DAggerState:
    """Environments and the planner's actions are split over the devices."""
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
        "advice": Replay(memory, repeated),
        "keys": spread,
    }
    return dataclasses.replace(state, **specs)
