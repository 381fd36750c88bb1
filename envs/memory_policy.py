"""Policies with memory: planners, recurrent networks, filters.

A policy without memory is a function of the observation. A policy with memory has two
methods instead. They act on whole batches, so that decisions for the whole batch (that
a plan is due, say) are made once:
- `init(observation, state) -> memory` at the start of an episode;
- `act(memory, observation, state) -> (action, memory)` at every decision.

Leaves of observation and state have a leading batch axis; memory is any pytree. A
learned policy ignores the state, a planner starts from it. Both kinds may have an
`action_repeat`: the number of control steps for which an action is held.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeGuard, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.structure import pytree


@runtime_checkable
class MemoryPolicy(Protocol):
    """A policy with memory, which is a pytree; see the module docstring.

    Example:
        >>> @extend.pytree
        ... class Integral:
        ...     gain: jax.Array
        ...
        ...     def init(self, observation, state):
        ...         return jnp.zeros_like(observation)
        ...
        ...     def act(self, memory, observation, state):
        ...         total = memory + observation
        ...         return -self.gain * total, total
        >>> isinstance(Integral(0.5), envs.MemoryPolicy)
        True
    """

    def init(self, observation: Float[Array, "batch observation"], state: Any) -> Any:
        """Initial memory of a batch of episodes.

        Args:
            observation: First observations, shape (batch, observation_size).
            state: States of the environments; every leaf has a leading batch axis.
        """

    def act(
        self, memory: Any, observation: Float[Array, "batch observation"], state: Any
    ) -> tuple[Float[Array, "batch action"], Any]:
        """Chooses the actions; returns them and the updated memory.

        Args:
            memory: Memory from `init` or from the previous decision.
            observation: Shape (batch, observation_size).
            state: States of the environments; every leaf has a leading batch axis.
        """


@pytree
class WithoutMemory:
    """A function of the observation, wrapped as a policy with empty memory."""

    policy: Any
    """Function from observations (batch, observation_size) to actions."""

    def init(self, observation: Array, state: Any) -> None:
        """Returns None, as a function has no memory."""
        del observation, state

    def act(self, memory: None, observation: Array, state: Any) -> tuple[Array, None]:
        """Returns the function's actions, and None as the memory."""
        del memory, state
        return self.policy(observation), None


def has_memory(policy: Any) -> TypeGuard[MemoryPolicy]:
    """Whether a policy is a `MemoryPolicy` with `init` and `act`, not a function."""
    return isinstance(policy, MemoryPolicy)


def remembering(policy: Callable[[Array], Array] | MemoryPolicy) -> MemoryPolicy:
    """Returns a policy of either kind as a policy with memory.

    Args:
        policy: A function from observations `(batch, observation_size)` to actions,
            whose memory is then `None`; or a policy with memory, returned as it is.

    Example:
        >>> policy = envs.remembering(lambda observation: -observation)
        >>> seen = jnp.array([[0.5]])  # a batch of one
        >>> action, memory = policy.act(policy.init(seen, None), seen, None)
        >>> action.tolist(), memory is None
        ([[-0.5]], True)
    """
    return policy if has_memory(policy) else WithoutMemory(policy)


@pytree
class OneEpisode:
    """A policy of either kind for one episode: no leaf has a batch axis.

    Example:
        >>> policy = envs.OneEpisode(lambda observation: -5.0 * observation)
        >>> seen = jnp.array([0.1])  # one observation, not a batch
        >>> action, memory = policy.act(policy.init(seen, None), seen, None)
        >>> action.tolist()
        [-0.5]
    """

    policy: Any
    """Function of one observation, or a `MemoryPolicy`."""

    def init(self, observation: Float[Array, " observation"], state: Any) -> Any:
        """Initial memory of an episode; None for a function."""
        if not has_memory(self.policy):
            return None
        return self.policy.init(*_in_front((observation, state)))

    def act(
        self, memory: Any, observation: Float[Array, " observation"], state: Any
    ) -> tuple[Float[Array, " action"], Any]:
        """Returns the action, clipped to [-1, 1], and the updated memory."""
        if not has_memory(self.policy):
            return jnp.clip(self.policy(observation), -1, 1), None
        action, memory = self.policy.act(memory, *_in_front((observation, state)))
        return jnp.clip(action[0], -1, 1), memory


def held_for(policy: Any) -> int:
    """Number of control steps for which a policy's action is held; 1 by default.

    Args:
        policy: A policy of either kind; the number is its `action_repeat`.

    Example:
        >>> envs.held_for(lambda observation: -observation)
        1
        >>> slow = training.PPOConfig(action_repeat=4)
        >>> envs.held_for(training.untrained_policy(envs.make("trivial"), config=slow))
        4
    """
    return getattr(policy, "action_repeat", 1)


def _in_front(tree: Any) -> Any:
    """Adds a leading batch axis of length 1 to every leaf."""
    return jax.tree.map(lambda leaf: leaf[None], tree)
