"""Common parts of all learners: initial state, schedules, devices, trained policy.

Episodes may be cut short in the first part of a run (`restart_phase`). If the start of
an episode decides its outcome, a learner gains more from more episodes in the same
number of steps: half a million control steps are only 140 full episodes of Case 3.
Episodes that are cut short are truncated, not terminated, and are left out of the mean
return.
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
from jaxrod.training.networks import (
    NetworkPolicy,
    RecurrentPolicy,
    initial_memory,
    layers,
    network_factory,
)
from jaxrod.training.normalisation import RunningMoments
from jaxrod.training.policy import MLPPolicy
from jaxrod.training.settings import Scalar


def canonicalise(
    key: Key[Array, ""], env: Environment, config: Any, env_params: Any
) -> tuple[Any, Any, Any]:
    """Converts settings and parameters to the dtype of the observations.

    Args:
        key: Any typed random key; its value does not matter.
        env: The environment.
        config: Settings of a learner, whose numbers are floats or arrays.
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
    """Converts weakly typed leaves to arrays of a definite dtype.

    A weak type could change during the run, which would recompile the update. Floats
    get `dtype`, integers keep theirs.
    """

    def one(leaf: Any) -> Array:
        leaf = jnp.asarray(leaf)
        if jax.typeof(leaf).weak_type:
            floating = jnp.issubdtype(leaf.dtype, jnp.floating)
            return jax.lax.convert_element_type(leaf, dtype if floating else leaf.dtype)
        return leaf

    return jax.tree.map(one, tree)


@pytree
class LearnerState:
    """Fields that the train states of all learners have."""

    env: Environment = static()
    """The environment, with actions held for `action_repeat` control steps."""
    config: Any
    """Configuration of the learner; its numbers are arrays."""
    env_params: Any
    """Parameters of the environment."""
    moments: RunningMoments
    """Mean and variance of all observations before the current update, which are used
    to normalise observations."""
    environments: VectorState
    """State of the batch of environments."""
    updates: Int[Array, ""]
    """Number of updates so far."""
    total_updates: Int[Array, ""]
    """Number of updates of the whole run; schedules are constant afterwards."""


def along_the_run(
    state: LearnerState, first: Scalar, last: Scalar, dtype: DTypeLike
) -> Float[Array, ""]:
    """Schedule last + (first - last) (1 - updates / total_updates), linear in time.

    It stays at `last` after `total_updates`.
    """
    remaining = 1 - state.updates / jnp.maximum(state.total_updates, 1)
    return last + (first - last) * jnp.clip(remaining, 0, 1).astype(dtype)


def restart_phase(
    env: Environment, config: Any, updates: Int[Array, ""] | int
) -> Int[Array, ""]:
    """Elapsed time at which episodes start at this point of the run [control steps].

    It is episode_length - short_length, at least 0, during the first `short_steps` of
    the run, so that these episodes end after `short_length` steps. Later it is 0.

    Args:
        env: The environment.
        config: Configuration with the settings `short_length` and `short_steps`, see
            `LearnerConfig`.
        updates: Number of updates of the run so far.
    """
    phase = jnp.maximum(env.episode_length - config.short_length, 0)
    # Updates are compared, not control steps, which would overflow their integers.
    short = updates < config.short_steps / steps_per_update(config)
    return jnp.where(short, phase, 0).astype(jnp.int32)


def started(
    key: Key[Array, ""], env: Environment, config: Any, env_params: Any, dtype: Any
) -> VectorState:
    """State of the batch of environments before the first update.

    Args:
        key: Typed random key.
        env: The environment, with actions held as in training.
        config: Settings of a learner, as returned by `canonicalise`.
        env_params: Parameters of the environment, as returned by `canonicalise`.
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
    """Partition specs of a train state; fields that are not named are replicated.

    Args:
        state: The train state, a dataclass.
        **specs: Partition specs of the split fields, by name of the field. Each applies
            to all leaves of the field.
    """
    names = [f.name for f in dataclasses.fields(state) if not f.metadata.get("static")]
    repeated: dict[str, Any] = dict.fromkeys(names, _REPEATED)
    return dataclasses.replace(state, **(repeated | specs))


_REPEATED: Any = PartitionSpec()
_ALONG_STEPS: Any = PartitionSpec(None, DEVICE_AXIS)
SPREAD: Any = PartitionSpec(DEVICE_AXIS)
"""Partition spec of arrays whose first axis, the environments, is split."""
SPREAD_MEMORY: Any = ReplayBuffer(_ALONG_STEPS, _REPEATED)
"""Partition specs of a `ReplayBuffer` whose second axis, the environments, is split."""


def check_memory(config: Any) -> None:
    """Raises ValueError unless batches split evenly and the buffer holds a rollout."""
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
    """Length of each environment's replay ring [decisions]: a number of whole rollouts.

    The rings of all environments together hold at most `buffer_size` decisions.
    """
    rollouts = config.buffer_size // (config.num_envs * config.rollout_steps)
    return rollouts * config.rollout_steps


def network_policy(
    state: LearnerState,
    weights: Any,
    activation: str,
    output: str = "clip",
    outputs_per_action: int = 1,
    action_std: Float[Array, " action"] | None = None,
    quiet_action: str = "median",
) -> Any:
    """Deterministic policy: the network's first outputs, bounded to [-1, 1].

    Args:
        state: The train state.
        weights: Weights of the network.
        activation: Activation function of the perceptron, if it is one.
        output: Function that bounds the actions, "clip" or "tanh".
        outputs_per_action: Number of outputs of the network for each action.
        action_std: Standard deviation of the noise in training, if it is a constant.
        quiet_action: Action without noise, see `OnPolicyConfig.quiet_action`.
    """
    config, size = state.config, state.env.action_size
    common: dict[str, Any] = {
        "moments": state.moments,
        "limit": config.observation_limit,
        "output": output,
        "action_repeat": config.action_repeat,
        "action_std": action_std,
        "quiet_action": quiet_action,
    }
    network = network_factory(config, "policy", activation)
    outputs = outputs_per_action * size
    if initial_memory(network("policy", outputs), (), float) is not None:
        return RecurrentPolicy(
            weights=weights, network=network, action_size=size, **common
        )
    if config.network is None:
        *hidden, (kernel, bias) = layers(weights)
        last = kernel[:, :size], bias[:size]
        return MLPPolicy(layers=(*hidden, last), activation=activation, **common)
    return NetworkPolicy(
        weights=weights,
        network=config.network,
        output_size=outputs,
        action_size=size,
        **common,
    )
