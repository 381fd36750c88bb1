"""A batch of environments as a `VecEnv` of Stable Baselines 3."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as missing:
    if missing.name != "stable_baselines3":
        raise
    raise ModuleNotFoundError(
        "jaxrod.envs.stable_baselines needs Stable Baselines 3; install it with: "
        'pip install "jaxrod[sb3]"',
        name="stable_baselines3",
    ) from missing

from jaxrod.envs.gymnasium_batch import Batch, observed
from jaxrod.envs.protocol import Environment

__all__ = ["StableBaselinesVecEnv"]

Indices = None | int | Iterable[int]
"""Indices of environments in the batch; None for all."""


class StableBaselinesVecEnv(VecEnv):
    """`jaxrod.envs.VectorEnvironment` for Stable Baselines 3, equal up to round-off.

    `seed(s)` before `reset` starts the batch with `jax.random.key(s)`. Otherwise
    `reset` draws a seed. All environments of the batch are one immutable object:
    `get_attr` and `env_method` query it, and `set_attr` is refused.

    Example:
        >>> from jaxrod.envs.stable_baselines import StableBaselinesVecEnv
        >>> batch = StableBaselinesVecEnv("trivial", num_envs=3)
        >>> batch.reset().shape
        (3, 1)
        >>> observations, rewards, ended, infos = batch.step(np.zeros((3, 1)))
        >>> rewards.shape, ended.tolist()
        ((3,), [False, False, False])
    """

    metadata: dict[str, Any]

    def __init__(
        self,
        task: str | Environment,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        params: Any = None,
        **options: Any,
    ) -> None:
        """Makes the batch.

        Args:
            task: A task for `jaxrod.envs.make`, or an environment.
            num_envs: Number of environments, at least 1.
            render_mode: None, or "rgb_array" for pictures of 480 x 640 pixels.
            params: Parameters shared by the batch; None for the environment's defaults.
            **options: Passed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: An argument does not fit.
        """
        self._batch = Batch(task, num_envs, render_mode, params, options)
        self._render_mode = render_mode
        self._random = np.random.default_rng()
        super().__init__(
            num_envs, self._batch.observation_space, self._batch.action_space
        )
        self.metadata = self._batch.metadata | self.metadata
        self._actions: Any = None

    def reset(self) -> np.ndarray:
        """Starts all episodes.

        Returns:
            First observations, shape (num_envs, observation_size).

        Raises:
            ValueError: `set_options` was called with options.
        """
        options = sorted({name for each in self._options for name in each})
        if options:
            raise ValueError(f"reset takes no options, got {options}")
        seed = self._seeds[0]
        if seed is not None:
            self._random = np.random.default_rng(seed)
        self._reset_seeds()
        self._batch.reset(
            int(self._random.integers(2**32)) if seed is None else int(seed)
        )
        return observed(self._batch.started().observation)

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions of the next step, shape (num_envs, action_size)."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advances all environments by one control step.

        Returns:
            Observations (num_envs, observation_size); rewards and flags of ended
            episodes (num_envs,); and one dictionary for each environment. The
            dictionary is empty unless the episode ended. Then it holds the last
            observation of that episode, whether the episode was cut short, and the
            environment's scalars.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
            ValueError: The actions have another shape.
        """
        step = self._batch.step(self._actions)
        done = np.asarray(step.terminated | step.truncated)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            infos[i] = {name: value[i].item() for name, value in step.info.items()} | {
                "terminal_observation": observed(step.final_observation[i]),
                "TimeLimit.truncated": bool(step.truncated[i] & ~step.terminated[i]),
            }
        return (
            observed(step.observation),
            np.array(step.reward, np.float32),
            done,
            infos,
        )

    def get_images(self) -> Sequence[np.ndarray]:
        """Returns a picture of every environment, RGB of shape (480, 640, 3).

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        state = self._batch.started()
        return [self._batch.picture(state, i) for i in range(self.num_envs)]

    def close(self) -> None:
        """Does nothing: no resource is open."""

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Returns an attribute of the environment, once for every index.

        Raises:
            AttributeError: The environment has no attribute of that name.
        """
        if attr_name == "render_mode":
            value = self._render_mode
        else:
            value = getattr(self._batch.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Refuses to set anything.

        Raises:
            AttributeError: Always raised.
        """
        raise AttributeError(
            f"{attr_name} cannot be set: the environments of a batch are one pure "
            "function; make another batch, with other options or params"
        )

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: Indices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Returns the results of a method of the environment, one for every index.

        Raises:
            AttributeError: The environment has no method of that name.
        """
        method = getattr(self._batch.env, method_name)
        return [
            method(*method_args, **method_kwargs) for _ in self._get_indices(indices)
        ]

    def env_is_wrapped(
        self, wrapper_class: type, indices: Indices = None
    ) -> list[bool]:
        """Returns False for every index: environments of a batch have no wrappers."""
        return [False for _ in self._get_indices(indices)]
