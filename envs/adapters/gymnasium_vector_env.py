"""A batch of environments as a `gymnasium.vector.VectorEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from jaxrod.envs.adapters.gymnasium_batch import METADATA, Batch, observed
from jaxrod.envs.protocol import Environment


class GymnasiumVectorEnv(
    gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]
):
    """`jaxrod.envs.VectorEnvironment` as Gymnasium knows it, to the last bit.

    An environment restarts in the step that ends its episode: the observation is the
    first of the next episode, `infos["final_obs"]` and `infos["final_info"]` are the
    last of the one that ended, where `infos["_final_obs"]` says so. The seed s starts
    the batch with `jax.random.key(s)`.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

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
            task: a task for `jaxrod.envs.make`, or an environment.
            num_envs: number of environments, at least 1.
            render_mode: None, or "rgb_array" for pictures of 480 x 640 pixels.
            params: parameters shared by the batch; None for the environment's own.
            **options: handed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: an argument does not fit.
        """
        self._batch = Batch(task, num_envs, render_mode, params, options)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.metadata = self._batch.metadata | {
            "autoreset_mode": AutoresetMode.SAME_STEP
        }
        self.single_observation_space = self._batch.observation_space
        self.single_action_space = self._batch.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts all episodes.

        Args:
            seed: the same seed, the same episodes; None for fresh ones.
            options: none are known.

        Returns:
            First observations, shape (num_envs, observation_size), and an empty
            dictionary.

        Raises:
            ValueError: `options` holds something.
        """
        super().reset(seed=seed)
        if options:
            raise ValueError(f"reset takes no options, got {sorted(options)}")
        self._batch.reset(int(self.np_random.integers(2**32)) if seed is None else seed)
        return observed(self._batch.started().observation), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of all environments.

        Args:
            actions: in [-1, 1], shape (num_envs, action_size).

        Returns:
            Observations (num_envs, observation_size); rewards, terminations and
            truncations (num_envs,); and what else is known.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            ValueError: the actions have another shape.
        """
        step = self._batch.step(actions)
        ended = np.asarray(step.terminated | step.truncated)
        infos: dict[str, Any] = _masked(step.info, ~ended)
        if ended.any():
            last = np.full(self.num_envs, None, object)
            for i, final in zip(
                np.flatnonzero(ended),
                observed(step.final_observation[ended]),
                strict=True,
            ):
                last[i] = final
            infos |= {
                "final_obs": last,
                "_final_obs": ended.copy(),
                "final_info": _masked(step.info, ended),
                "_final_info": ended.copy(),
            }
        return (
            observed(step.observation),
            np.array(step.reward, float),
            np.array(step.terminated),
            np.array(step.truncated),
            infos,
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of every environment, RGB of shape (480, 640, 3).

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('nothing is drawn unless render_mode="rgb_array"')
            return None
        state = self._batch.started()
        return tuple(self._batch.picture(state, i) for i in range(self.num_envs))


def _masked(scalars: Mapping[str, Any], where: np.ndarray) -> dict[str, np.ndarray]:
    """Scalars with their masks, as Gymnasium keeps them; nothing where nothing is."""
    if not where.any():
        return {}
    infos = {}
    for name, value in scalars.items():
        kind = bool if value.dtype == bool else float
        infos[name] = np.where(where, value, kind()).astype(kind)
        infos[f"_{name}"] = where.copy()
    return infos
