"""Common parts of all learners: start, schedules, memory, devices, the policy.

Episodes may be cut short in the first part of a run (`restart_phase`): if the first
moments of an episode decide its outcome, a learner that always waits for the end sees
few of them: half a million control steps are only 140 episodes of Case 3. Episodes that
are cut short are truncated, not terminated, and do not count for the score.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, DTypeLike, Float, Int, Key

from jaxrod.envs import Environment, VectorEnvironment, VectorState
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import DEVICE_AXIS, steps_per_update
from jaxrod.training.algorithms.replay import ReplayBuffer
from jaxrod.training.networks import NetworkPolicy, layers
from jaxrod.training.normalisation import RunningMoments
from jaxrod.training.policy import MLPPolicy, Policy
from jaxrod.training.settings import Scalar


def canonicalise(
    key: Key[Array, ""], env: Environment, config: Any, env_params: Any
) -> tuple[Any, Any, Any]:
    """Converts settings and parameters to the dtype that is used for learning.

    Args:
        key: Any random key; nothing is drawn from it.
        env: The environment.
        config: Settings of a learner, their numbers floats or arrays.
        env_params: Parameters of the environment, None for its defaults.

    Returns:
        `(config, env_params, dtype)`; dtype is that of the observations.
    """
    if env_params is None:
        # Factories check the values of their numbers, which a trace would hide.
        with jax.ensure_compile_time_eval():
            env_params = env.default_params()
    dtype = jax.eval_shape(env.reset, key, env_params)[0].dtype
    env_params = strip_weak_types(env_params, dtype)
    # One dtype for all numbers, whether given as floats or as arrays.
    config = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), config)
    return config, env_params, dtype


def strip_weak_types(tree: Any, dtype: DTypeLike) -> Any:
    """Leaves with definite dtypes: a weak type could change during the run."""

    def one(leaf: Any) -> Array:
        leaf = jnp.asarray(leaf)
        if jax.typeof(leaf).weak_type:
            floating = jnp.issubdtype(leaf.dtype, jnp.floating)
            return jax.lax.convert_element_type(leaf, dtype if floating else leaf.dtype)
        return leaf

    return jax.tree.map(one, tree)


@pytree
class LearnerState:
    """Parts that the train states of all learners have."""

    env: Environment = static()
    """The environment."""
    config: Any
    """Numbers and sizes of the learner."""
    env_params: Any
    """Parameters of the environment."""
    moments: RunningMoments
    """Moments of all observations acted on before the current update."""
    environments: VectorState
    """State of the batch of environments."""
    updates: Int[Array, ""]
    """Number of updates so far."""
    total_updates: Int[Array, ""]
    """Number of updates of the whole run, after which schedules are constant."""


def along_the_run(
    state: LearnerState, first: Scalar, last: Scalar, dtype: DTypeLike
) -> Float[Array, ""]:
    """Linear interpolation from `first` to `last` over the run."""
    remaining = 1 - state.updates / jnp.maximum(state.total_updates, 1)
    return last + (first - last) * jnp.clip(remaining, 0, 1).astype(dtype)


def restart_phase(
    env: Environment, config: Any, updates: Int[Array, ""] | int
) -> Int[Array, ""]:
    """Initial clock of the episodes that start now [control steps].

    Args:
        env: The environment.
        config: Configuration with the numbers `short_length`, the control steps of a
            short episode, and `short_steps`, the control steps until which episodes are
            short.
        updates: Number of updates of the run so far.
    """
    phase = jnp.maximum(env.episode_length - config.short_length, 0)
    # Updates are compared, not control steps, which would overflow their integers.
    short = updates < config.short_steps / steps_per_update(config)
    return jnp.where(short, phase, 0).astype(jnp.int32)


def started(
    key: Key[Array, ""], env: Environment, config: Any, env_params: Any, dtype: Any
) -> VectorState:
    """The batch of environments before the first update.

    Args:
        key: Typed random key.
        env: The environment, with actions held as in training.
        config: Settings of a learner, see `canonicalise`.
        env_params: Parameters of the environment, see `canonicalise`.
        dtype: Dtype of the observations.
    """
    environments = VectorEnvironment(env).reset(
        key,
        config.num_envs,
        env_params,
        spread_phases=config.spread_phases,
        phase=restart_phase(env, config, 0),
    )
    return strip_weak_types(environments, dtype)


def spread_over_devices(state: Any, **specs: Any) -> Any:
    """Partition of a train state: named fields are split, all others are replicated.

    Args:
        state: The train state, a dataclass.
        **specs: Tree prefixes of partition specs by the name of the field. Each stands
            for all leaves below.
    """
    names = [f.name for f in dataclasses.fields(state) if f.name != "env"]
    repeated: dict[str, Any] = dict.fromkeys(names, _REPEATED)
    return dataclasses.replace(state, **(repeated | specs))


_REPEATED: Any = PartitionSpec()
_ALONG_STEPS: Any = PartitionSpec(None, DEVICE_AXIS)
SPREAD: Any = PartitionSpec(DEVICE_AXIS)
"""Partition of arrays whose first axis is that of the environments."""
SPREAD_MEMORY: Any = ReplayBuffer(_ALONG_STEPS, _REPEATED)
"""Partition of a replay buffer."""


def check_memory(config: Any) -> None:
    """Raises ValueError if the sizes of batches or of the memory do not fit."""
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


def slots(config: Any) -> int:
    """Length of the ring: whole rollouts, at most `buffer_size` transitions."""
    rollouts = config.buffer_size // (config.num_envs * config.rollout_steps)
    return rollouts * config.rollout_steps


def network_policy(
    state: LearnerState,
    weights: Any,
    activation: str,
    output: str = "clip",
    outputs_per_action: int = 1,
) -> Policy:
    """The policy network's first outputs, one for each action, bounded to [-1, 1].

    Args:
        state: The train state.
        weights: Weights of the network.
        activation: Activation function of a perceptron.
        output: Bound of the actions, "clip" or "tanh".
        outputs_per_action: Outputs of the network for each action.
    """
    config, size = state.config, state.env.action_size
    common: dict[str, Any] = {
        "moments": state.moments,
        "limit": config.observation_limit,
        "output": output,
        "action_repeat": config.action_repeat,
    }
    if config.network is None:
        *hidden, (kernel, bias) = layers(weights)
        last = kernel[:, :size], bias[:size]
        return MLPPolicy(layers=(*hidden, last), activation=activation, **common)
    return NetworkPolicy(
        weights=weights,
        network=config.network,
        output_size=outputs_per_action * size,
        action_size=size,
        **common,
    )
