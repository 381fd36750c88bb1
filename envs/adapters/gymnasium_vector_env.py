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
from jaxrod.envs.wrappers import VectorStep


class GymnasiumVectorEnv(
    gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]
):
    """`jaxrod.envs.VectorEnvironment` for Gymnasium, equal up to round-off.

    The seed s starts the batch with `jax.random.key(s)`. When an episode ends the
    environment restarts by `autoreset_mode`, as Gymnasium defines the modes:

    - `SAME_STEP`: at once. The observation is the first of the next episode.
      `infos["final_obs"]` and `infos["final_info"]` are the last of the ended episode,
      where `infos["_final_obs"]` is true.
    - `NEXT_STEP`: in the next step, which ignores the action and earns nothing.
      Gymnasium's wrappers that normalise observations require it.
    - `DISABLED`: on request, by `reset(options={"reset_mask": ended})`.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        task: str | Environment,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        params: Any = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **options: Any,
    ) -> None:
        """Makes the batch.

        Args:
            task: A task for `jaxrod.envs.make`, or an environment.
            num_envs: Number of environments, at least 1.
            render_mode: None, or "rgb_array" for pictures of 480 x 640 pixels.
            params: Parameters shared by the batch; None for the environment's defaults.
            autoreset_mode: One of `gymnasium.vector.AutoresetMode`, or its value:
                "SameStep", "NextStep" or "Disabled".
            **options: Passed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: An argument does not fit.
        """
        self._mode = _mode(autoreset_mode)
        self._batch = Batch(task, num_envs, render_mode, params, options)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._ended = np.zeros(num_envs, bool)
        self.metadata = self._batch.metadata | {"autoreset_mode": self._mode}
        self.single_observation_space = self._batch.observation_space
        self.single_action_space = self._batch.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts all episodes.

        Args:
            seed: Seed; equal seeds give equal episodes. None for fresh ones.
            options: `reset_mask`, in the mode `DISABLED`: booleans of shape
                (num_envs,), true for the environments that start an episode; the others
                go on.

        Returns:
            First observations, shape (num_envs, observation_size), and an empty
            dictionary.

        Raises:
            ValueError: `options` holds something else.
        """
        super().reset(seed=seed)
        where = self._where(options or {})
        drawn = int(self.np_random.integers(2**32)) if seed is None else seed
        self._batch.reset(drawn, where)
        self._ended = self._ended & (False if where is None else ~where)
        return observed(self._batch.started().observation), {}

    def _where(self, options: dict[str, Any]) -> np.ndarray | None:
        """Mask of the environments that start an episode; None for all."""
        if not options:
            return None
        if self._mode is not AutoresetMode.DISABLED or set(options) != {"reset_mask"}:
            known = (
                "no options but reset_mask"
                if self._mode is AutoresetMode.DISABLED
                else "no options"
            )
            raise ValueError(f"reset takes {known}, got {sorted(options)}")
        where = np.asarray(options["reset_mask"])
        if where.dtype != bool or where.shape != (self.num_envs,):
            raise ValueError(
                f"reset_mask must be booleans of shape ({self.num_envs},), got "
                f"{where.dtype} of shape {where.shape}"
            )
        return where

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances all environments by one control step.

        Args:
            actions: In [-1, 1], shape (num_envs, action_size).

        Returns:
            Observations (num_envs, observation_size); rewards, terminations and
            truncations (num_envs,); and a dictionary with other information.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before; in the mode
                `DISABLED` also after an episode has ended.
            ValueError: The actions have another shape.
        """
        if self._mode is AutoresetMode.DISABLED and self._ended.any():
            which = np.flatnonzero(self._ended).tolist()
            raise gymnasium.error.ResetNeeded(
                f"the episodes of environments {which} have ended: call "
                'reset(options={"reset_mask": ...})'
            )
        waits = self._mode is AutoresetMode.NEXT_STEP
        waiting = self._ended if waits else None
        step = self._batch.step(actions, waiting)
        ended = np.asarray(step.terminated | step.truncated)
        self._ended = ended
        if self._mode is AutoresetMode.SAME_STEP:
            observation, infos = step.observation, _infos(step, ended)
        else:
            observation = step.final_observation
            infos = _masked(
                step.info, np.ones_like(ended) if waiting is None else ~waiting
            )
        return (
            observed(observation),
            np.array(step.reward, float),
            np.array(step.terminated),
            np.array(step.truncated),
            infos,
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of every environment, RGB of shape (480, 640, 3).

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('nothing is drawn unless render_mode="rgb_array"')
            return None
        state = self._batch.started()
        return tuple(self._batch.picture(state, i) for i in range(self.num_envs))


def _mode(given: AutoresetMode | str) -> AutoresetMode:
    """The mode, given as the enumeration member or as its value."""
    try:
        return AutoresetMode(given)
    except ValueError:
        known = ", ".join(mode.value for mode in AutoresetMode)
        raise ValueError(
            f"autoreset_mode must be one of {known}; got {given!r}"
        ) from None


def _infos(step: VectorStep, ended: np.ndarray) -> dict[str, Any]:
    """Scalars of the running episodes, and final ones of the ended episodes."""
    infos: dict[str, Any] = _masked(step.info, ~ended)
    if not ended.any():
        return infos
    last = np.full(len(ended), None, object)
    finals = observed(step.final_observation[ended])
    for i, final in zip(np.flatnonzero(ended), finals, strict=True):
        last[i] = final
    return infos | {
        "final_obs": last,
        "_final_obs": ended.copy(),
        "final_info": _masked(step.info, ended),
        "_final_info": ended.copy(),
    }


def _masked(scalars: Mapping[str, Any], where: np.ndarray) -> dict[str, np.ndarray]:
    """Scalars with their masks, in Gymnasium's layout; empty if the mask is empty."""
    if not where.any():
        return {}
    infos = {}
    for name, value in scalars.items():
        kind = bool if value.dtype == bool else float
        infos[name] = np.where(where, value, kind()).astype(kind)
        infos[f"_{name}"] = where.copy()
    return infos
