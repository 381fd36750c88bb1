"""Gymnasium environments with a goal, for hindsight experience replay.

Source: M. Andrychowicz et al., Hindsight Experience Replay, NeurIPS 2017.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

try:
    import gymnasium
    from gymnasium.spaces import Box, Dict
except ModuleNotFoundError as missing:
    if missing.name != "gymnasium":
        raise
    raise ModuleNotFoundError(
        "jaxrod.envs.goal_env needs gymnasium; install it with: "
        'pip install "jaxrod[gym]"',
        name="gymnasium",
    ) from missing

from jaxrod.envs.gymnasium_batch import Batch
from jaxrod.envs.protocol import GoalConditioned
from jaxrod.validation import check_count

__all__ = ["GoalEnv"]

Observation = dict[str, np.ndarray]
"""Arrays under "observation", "achieved_goal" and "desired_goal"."""


class GoalEnv(
    gymnasium.Wrapper[Any, np.ndarray, Any, np.ndarray],
    gymnasium.utils.RecordConstructorArgs,
):
    """A Gymnasium environment of a task whose observations name the goal.

    They have the shape that Gymnasium's goal environments and learners with hindsight
    expect:

    - `"observation"`: the body. Nothing of the goal is in it, neither its position nor
      its velocity, so that a goal can be exchanged afterwards.
    - `"achieved_goal"` and `"desired_goal"`: in `tracking` the positions of tip and
      target; in `reaching` each with its quaternion.

    The reward of a step is `compute_reward` of its goals. That is the reward of the
    task, except where an arm of the variant "paper" breaks or an action is held.

    Example:
        >>> from jaxrod.envs.goal_env import GoalEnv
        >>> from jaxrod.envs.gym import GymnasiumEnv
        >>> env = GoalEnv(GymnasiumEnv("tracking", n_elements=10))
        >>> observation, info = env.reset(seed=0)
        >>> {name: part.shape for name, part in observation.items()}
        {'observation': (37,), 'achieved_goal': (3,), 'desired_goal': (3,)}
        >>> goal = observation["desired_goal"]
        >>> float(env.compute_reward(goal, goal))  # a reached goal
        2.0
    """

    def __init__(
        self, env: gymnasium.Env[np.ndarray, np.ndarray], hold: int = 1
    ) -> None:
        """Wraps an environment.

        Args:
            env: A `jaxrod.envs.gym.GymnasiumEnv`, for example from
                `gymnasium.make("jaxrod/tracking-clean-v0")`.
            hold: Control steps for which every action is held. The reward is that of
                the last of them.

        Raises:
            ValueError: The environment is not of jaxrod, its task has no goals, or
                `hold` is below 1.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(self, hold=hold)
        super().__init__(env)
        batch = getattr(env.unwrapped, "_batch", None)
        if batch is None:
            raise ValueError(f"env must be an environment of jaxrod, got {env}")
        task = batch.env
        if not hasattr(task, "goal_entries"):
            raise ValueError(f"{task.name} has no goals: it has no goal_entries")
        self._hold = check_count("hold", hold, 1)
        self._batch: Batch = batch
        self._task: GoalConditioned = task
        entries = {
            "observation": task.goal_entries.body,
            "achieved_goal": task.goal_entries.achieved,
            "desired_goal": task.goal_entries.desired,
        }
        self._entries = {name: np.array(which) for name, which in entries.items()}
        largest = float(np.finfo(np.float32).max)
        parts: Any = Dict(
            {
                name: Box(-largest, largest, which.shape, np.float32)
                for name, which in self._entries.items()
            }
        )
        self.observation_space = parts

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode, as `jaxrod.envs.gym.GymnasiumEnv.reset` does."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._parts(observation), info

    def step(
        self, action: np.ndarray
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances by the control steps of one action, or to the end of the episode.

        Args:
            action: In [-1, 1], shape (action_size,).

        Returns:
            Observation, reward, terminated, truncated, and the environment's scalars.
        """
        for _ in range(self._hold):
            observation, _, terminated, truncated, info = self.env.step(action)
            if terminated or truncated:
                break
        parts = self._parts(observation)
        goals = parts["achieved_goal"], parts["desired_goal"]
        reward = float(self.compute_reward(*goals))
        return parts, reward, terminated, truncated, info

    def _parts(self, observation: np.ndarray) -> Observation:
        """Observation by parts, copied out of the whole one."""
        return {name: observation[which] for name, which in self._entries.items()}

    def compute_reward(
        self,
        achieved_goal: Float[np.ndarray, "*batch goal"],
        desired_goal: Float[np.ndarray, "*batch goal"],
        info: Any = None,
    ) -> Float[np.ndarray, "*batch"]:
        """Computes the reward of steps that lead to `achieved_goal`.

        Args:
            achieved_goal: Goals that the steps achieved.
            desired_goal: Goals that were to be achieved; not necessarily those of the
                episode.
            info: Ignored: nothing but the goals matters.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        self._batch.packed()
        return np.array(
            _rewards(self._task, achieved_goal, desired_goal, self._batch.params)
        )


@functools.partial(jax.jit, static_argnums=0)
def _rewards(
    task: GoalConditioned, achieved: Array, desired: Array, params: Any
) -> Array:
    """Rewards of goals; the last axis is that of a goal, all others are a batch."""
    one = lambda a, d: task.goal_reward(a, d, params)
    return jnp.vectorize(one, signature="(g),(g)->()")(achieved, desired)
