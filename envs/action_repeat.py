"""An environment whose actions are held for several control steps.

Control steps of the benchmark are 1.4 ms, far shorter than the response time of an arm.
An agent that decides at every step explores with noise that the arm averages out, and
has to look hundreds of decisions ahead.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxrod.envs.protocol import Environment


@dataclasses.dataclass(frozen=True)
class ActionRepeat:
    """Holds every action for `times` control steps and adds up their rewards.

    An episode that ends in between ends there: rewards of the remaining control steps
    do not count. `info` is that of the last step that counts. It also holds
    `"control_steps"`, the number of steps that counted, for `VectorEnvironment`'s
    clock.

    Raises:
        ValueError: If `times` is below 1.
    """

    env: Environment
    """The environment."""
    times: int
    """Number of control steps per decision."""

    def __post_init__(self) -> None:
        """Checks the number."""
        if self.times < 1:
            raise ValueError(f"times must be at least 1, got {self.times}")

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.env.name

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        """Length of the action vector."""
        return self.env.action_size

    @property
    def episode_length(self) -> int:
        """Control steps after which an episode is truncated."""
        return self.env.episode_length

    def default_params(self) -> Any:
        """Parameters of the environment."""
        return self.env.default_params()

    def reset(self, key: Key[Array, ""], params: Any) -> tuple[Array, Any]:
        """Starts an episode."""
        return self.env.reset(key, params)

    def step(
        self,
        key: Key[Array, ""],
        state: Any,
        action: Float[Array, " action"],
        params: Any,
    ) -> tuple[
        Float[Array, " observation"],
        Any,
        Float[Array, ""],
        Bool[Array, ""],
        Bool[Array, ""],
        dict[str, Array],
    ]:
        """Advances by `times` control steps; step k draws from `fold_in(key, k)`."""

        def step(state: Any, number: Array | int) -> Any:
            return self.env.step(jax.random.fold_in(key, number), state, action, params)

        def again(number: Array, before: Any) -> Any:
            *_, terminated, truncated, info = before
            done = terminated | truncated
            after = _counted(step(before[1], number), info["control_steps"] + 1)
            kept = jax.tree.map(lambda a, b: jnp.where(done, a, b), before, after)
            reward = before[2] + jnp.where(done, 0, after[2])
            return (*kept[:2], reward, *kept[3:])

        first = _counted(step(state, 0), jnp.int32(1))
        return jax.lax.fori_loop(1, self.times, again, first)


def _counted(outcome: Any, control_steps: Array) -> Any:
    """Outcome of a step, with the number of control steps added to its `info`."""
    *most, info = outcome
    return (*most, info | {"control_steps": control_steps})


def repeating(env: Environment, times: int) -> Environment:
    """The environment itself, or a wrapper that holds actions for `times` steps."""
    return env if times == 1 else ActionRepeat(env, times)
