"""The replay buffer of off-policy learners: a ring buffer in device memory.

There is one ring per environment. All rings have the same length and are written at the
same time steps. Every environment contributes the same number of samples to a batch, at
slots drawn from the random key of that environment. So each stored transition is
equally likely, and the samples do not depend on the number of devices.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, DTypeLike, Float, Int, Key

from jaxrod.structure import pytree


@pytree
class Transition:
    """One decision and its outcome, or a batch of them with any leading axes."""

    observation: Float[Array, "*batch observation"]
    """Observation from which the action was chosen."""
    action: Float[Array, "*batch action"]
    """Action, in [-1, 1]."""
    reward: Float[Array, "*batch"]
    """Reward of the decision, not scaled in the replay buffer."""
    next_observation: Float[Array, "*batch observation"]
    """Observation after the decision, before any restart of the episode."""
    terminated: Bool[Array, "*batch"]
    """Whether the task ended here; the value of `next_observation` is then 0."""


@pytree
class ReplayBuffer:
    """Ring buffer of the last time steps of every environment, such as transitions."""

    transitions: Any
    """Pytree of arrays of shape (slots, num_envs, ...), such as a `Transition`."""
    written: Int[Array, ""]
    """Number of time steps written so far, including those that were overwritten."""

    @property
    def slots(self) -> int:
        """Capacity in time steps."""
        return jax.tree.leaves(self.transitions)[0].shape[0]

    @property
    def size(self) -> Int[Array, ""]:
        """Number of stored time steps, at most `slots`."""
        return jnp.minimum(self.written, self.slots)


def empty_replay(
    slots: int, num_envs: int, observation_size: int, action_size: int, dtype: DTypeLike
) -> ReplayBuffer:
    """An empty buffer for `slots` time steps of `num_envs` environments."""
    shape = (slots, num_envs)
    return ReplayBuffer(
        Transition(
            observation=jnp.zeros((*shape, observation_size), dtype),
            action=jnp.zeros((*shape, action_size), dtype),
            reward=jnp.zeros(shape, dtype),
            next_observation=jnp.zeros((*shape, observation_size), dtype),
            terminated=jnp.zeros(shape, bool),
        ),
        jnp.zeros((), jnp.int32),
    )


def append(replay: ReplayBuffer, steps: Any) -> ReplayBuffer:
    """Writes a block of time steps over the oldest ones.

    Args:
        replay: The buffer. Its number of slots is a multiple of the block's length, so
            that a block never crosses the end of the ring.
        steps: Block of shape (block, num_envs, ...), of the same length in every call.

    Raises:
        ValueError: The block's length does not divide the number of slots.
    """
    block = jax.tree.leaves(steps)[0].shape[0]
    if replay.slots % block:
        raise ValueError(
            f"steps must be a block whose length divides the ring's {replay.slots} "
            f"slots, got {block}"
        )
    slot = replay.written % replay.slots
    transitions = jax.tree.map(
        lambda ring, new: jax.lax.dynamic_update_slice_in_dim(ring, new, slot, axis=0),
        replay.transitions,
        steps,
    )
    return ReplayBuffer(transitions, replay.written + block)


def sample_indices(
    replay: ReplayBuffer, keys: Key[Array, " num_envs"], batches: int, per_env: int
) -> Int[Array, "batches per_env num_envs"]:
    """Draws slots to sample, uniformly over the filled slots, with replacement.

    Args:
        replay: The buffer.
        keys: One typed random key per environment.
        batches: Number of batches.
        per_env: Number of samples per batch from each environment.
    """
    times = jax.vmap(
        lambda key: jax.random.randint(
            key, (batches, per_env), 0, replay.size, jnp.int32
        )
    )(keys)
    return jnp.moveaxis(times, 0, 2)


def sample(replay: ReplayBuffer, times: Int[Array, "per_env num_envs"]) -> Any:
    """Reads slot `times[i, j]` of environment j, for all i and j.

    The arrays have the shape (per_env * num_envs, ...).
    """
    envs = jnp.broadcast_to(jnp.arange(times.shape[1])[None], times.shape)
    return jax.tree.map(
        lambda ring: ring[times.reshape(-1), envs.reshape(-1)], replay.transitions
    )
