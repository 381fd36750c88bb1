"""Policies that remember: planners, recurrent networks, filters.

A policy without memory is a function of the observation. One with memory has two
methods instead, on whole batches, so that what a batch does together (a plan is due) is
decided once:

- `init(observation, state) -> memory` when episodes begin,
- `act(memory, observation, state) -> (action, memory)` at every decision.

Leaves of observation and state have the batch in front; memory is any pytree. A learned
policy leaves the state alone, a planner starts from it. Both kinds may have an
`action_repeat`: the control steps for which an action is held.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.structure import pytree


@runtime_checkable
class MemoryPolicy(Protocol):
    """A policy with memory; see the module. A pytree, as every policy."""

    def init(self, observation: Float[Array, "batch observation"], state: Any) -> Any:
        """Memory of a batch of episodes that begin.

        Args:
            observation: The first ones, shape (batch, observation_size).
            state: Of the environments, every leaf with the batch in front.
        """

    def act(
        self, memory: Any, observation: Float[Array, "batch observation"], state: Any
    ) -> tuple[Float[Array, "batch action"], Any]:
        """Actions, and what is remembered of now.

        Args:
            memory: From `init` or the decision before.
            observation: Shape (batch, observation_size).
            state: Of the environments, every leaf with the batch in front.
        """


@pytree
class WithoutMemory:
    """A function of the observation, as a policy that remembers nothing."""

    policy: Any
    """Observations (batch, observation_size) -> actions."""

    def init(self, observation: Array, state: Any) -> None:
        """Nothing."""
        del observation, state

    def act(self, memory: None, observation: Array, state: Any) -> tuple[Array, None]:
        """Actions of the observations."""
        del memory, state
        return self.policy(observation), None


def remembering(policy: Callable[[Array], Array] | MemoryPolicy) -> MemoryPolicy:
    """A policy of either kind as one with memory."""
    return policy if isinstance(policy, MemoryPolicy) else WithoutMemory(policy)


@pytree
class OneEpisode:
    """A policy of either kind for one episode: nothing has a batch in front."""

    policy: Any
    """A function of one observation, or a `MemoryPolicy`."""

    def init(self, observation: Float[Array, " observation"], state: Any) -> Any:
        """Memory of an episode that begins."""
        if not isinstance(self.policy, MemoryPolicy):
            return None
        return self.policy.init(*_in_front((observation, state)))

    def act(
        self, memory: Any, observation: Float[Array, " observation"], state: Any
    ) -> tuple[Float[Array, " action"], Any]:
        """The action in [-1, 1], and what is remembered of now."""
        if not isinstance(self.policy, MemoryPolicy):
            return jnp.clip(self.policy(observation), -1, 1), None
        action, memory = self.policy.act(memory, *_in_front((observation, state)))
        return jnp.clip(action[0], -1, 1), memory


def held_for(policy: Any) -> int:
    """Control steps for which an action of a policy is to be held: 1 if not told."""
    return getattr(policy, "action_repeat", 1)


def _in_front(tree: Any) -> Any:
    """A batch of one."""
    return jax.tree.map(lambda leaf: leaf[None], tree)
