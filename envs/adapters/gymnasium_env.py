"""One environment as a `gymnasium.Env`."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from jaxrod.envs.actions import check_action_shape
from jaxrod.envs.adapters.gymnasium_batch import METADATA, Batch, observed
from jaxrod.envs.adapters.packing import Packed
from jaxrod.envs.protocol import Environment


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment as a `gymnasium.Env`.

    It is a batch of one of `jaxrod.envs.VectorEnvironment`, up to round-off, and equal
    to the `GymnasiumVectorEnv` of one to the last bit. The seed s starts it with
    `jax.random.key(s)`, and the episode after an ended one is the batch's next episode.
    `reset` without a seed in mid-episode starts with a new seed drawn from `np_random`.
    """

    metadata = METADATA

    def __init__(
        self,
        task: str | Environment,
        *,
        render_mode: str | None = None,
        params: Any = None,
        **options: Any,
    ) -> None:
        """Makes the environment.

        Args:
            task: A task for `jaxrod.envs.make`, or an environment.
            render_mode: None, or "rgb_array" for pictures of 480 x 640 pixels.
            params: Parameters of the environment; None for its defaults.
            **options: Passed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: An argument does not fit.
        """
        self._batch = Batch(task, 1, render_mode, params, options)
        self.render_mode = render_mode
        self.metadata = self._batch.metadata
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space
        self._ended = False
        self._shown: Packed | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seed; equal seeds give equal episodes. None for a fresh episode.
            options: Must be empty or None: no options are known.

        Returns:
            The first observation, shape (observation_size,), and an empty dictionary.

        Raises:
            ValueError: `options` is not empty.
        """
        super().reset(seed=seed)
        if options:
            raise ValueError(f"reset takes no options, got {sorted(options)}")
        if seed is not None or not self._ended:
            drawn = int(self.np_random.integers(2**32)) if seed is None else seed
            self._batch.reset(drawn)
        self._ended = False
        self._shown = self._batch.packed()
        return observed(self._batch.started().observation[0]), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances one control step.

        Args:
            action: In [-1, 1], shape (action_size,).

        Returns:
            Observation, reward, terminated, truncated, and the environment's scalars.

        Raises:
            gymnasium.error.ResetNeeded: No episode is running.
            ValueError: The action has another shape.
        """
        if self._ended:
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset")
        before = self._batch.packed()
        check_action_shape("action", action, (self._batch.env.action_size,))
        step = self._batch.step(np.asarray(action)[None])
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._ended = terminated or truncated
        # The batch has already begun the next episode: the picture shows the last
        # moment but one of the ended episode.
        self._shown = before if self._ended else self._batch.packed()
        return (
            observed(step.final_observation[0]),
            float(step.reward[0]),
            terminated,
            truncated,
            {name: value[0].item() for name, value in step.info.items()},
        )

    def render(self) -> np.ndarray | None:
        """A picture, RGB of shape (480, 640, 3), or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('nothing is drawn unless render_mode="rgb_array"')
            return None
        if self._shown is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        return self._batch.picture(self._batch.unpacked(self._shown), 0)
