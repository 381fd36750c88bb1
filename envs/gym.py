"""The tasks for Gymnasium: import this module, then `gymnasium.make("jaxrod/...")`.

The ids are `jaxrod/TASK-VARIANT-v0`, for example `jaxrod/tracking-paper-v0`; `ids()`
lists them. Keyword arguments of `make` and `make_vec` go to the task, for example
`controls=4` to `structured`. An id's version rises when its results change.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

try:
    import gymnasium
    from gymnasium.envs.registration import EnvSpec
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as missing:
    if missing.name != "gymnasium":
        raise
    raise ModuleNotFoundError(
        'jaxrod.envs.gym needs gymnasium; install it with: pip install "jaxrod[gym]"',
        name="gymnasium",
    ) from missing

from jaxrod.envs.checking import check_action_shape
from jaxrod.envs.gymnasium_batch import METADATA, Batch, Packed, observed
from jaxrod.envs.protocol import Environment
from jaxrod.envs.wrappers import VectorStep

__all__ = ["GymnasiumEnv", "GymnasiumVectorEnv", "ids"]

VARIANTS = {
    "tracking": ("paper", "clean"),
    "reaching": ("paper", "clean"),
    "structured": ("paper", "clean"),
    "unstructured": ("paper", "clean"),
    "snake": ("clean",),
    "octopus": ("clean",),
    "gripper": ("clean",),
    "lift": ("clean",),
    "insert": ("clean",),
    "catheter": ("clean",),
    "following": ("clean",),
}
"""Tasks that are registered with Gymnasium, and the variants of each."""


def ids() -> tuple[str, ...]:
    """Returns the Gymnasium ids of all tasks.

    Example:
        >>> from jaxrod.envs.gym import ids
        >>> ids()[:2]
        ('jaxrod/tracking-paper-v0', 'jaxrod/tracking-clean-v0')
    """
    return tuple(_id(task, variant) for task in VARIANTS for variant in VARIANTS[task])


def _id(task: str, variant: str) -> str:
    return f"jaxrod/{task}-{variant}-v0"


class _Limited:
    """Base class with the episode's length as `spec.max_episode_steps`.

    The length is an option of the task, so no number could be registered with an id.
    """

    _batch: Batch
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Arguments of `gymnasium.make`; None for an environment made otherwise."""
        return self._spec

    @spec.setter
    def spec(self, given: EnvSpec | None) -> None:
        """Keeps a copy, with the episode's length."""
        self._spec = copy.copy(given)
        if self._spec is not None:
            self._spec.max_episode_steps = self._batch.env.episode_length


class GymnasiumEnv(_Limited, gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment as a `gymnasium.Env`.

    Its results equal those of `jaxrod.envs.VectorEnvironment` with one environment up
    to round-off, and those of `GymnasiumVectorEnv` with one environment to the last
    bit. The seed s starts a batch of one environment with `jax.random.key(s)`. `reset`
    without a seed starts the next episode of this batch if the previous one has ended,
    and otherwise draws a new seed from `np_random`.

    In the render mode "human" a window of matplotlib shows the motion, never faster
    than in real time. It gets a new picture after every `metadata["steps_per_frame"]`
    control steps. Films of these pictures at `metadata["render_fps"]` frames a second
    play in real time. Films with a picture of every control step, such as those of
    `gymnasium.wrappers.RecordVideo`, play `steps_per_frame` times as slowly.

    Example:
        >>> from jaxrod.envs.gym import GymnasiumEnv
        >>> env = GymnasiumEnv("trivial")
        >>> observation, info = env.reset(seed=0)
        >>> action = env.action_space.sample()
        >>> observation, reward, terminated, truncated, info = env.step(action)
        >>> observation.shape, terminated, truncated
        ((1,), False, False)
    """

    metadata = METADATA | {"render_modes": ["human", "rgb_array"]}

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
            render_mode: None, "rgb_array" for pictures of 480 x 640 pixels, or "human"
                for a window.
            params: Parameters of the environment; None for its defaults.
            **options: Passed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: An argument does not fit.
        """
        modes = self.metadata["render_modes"]
        self._batch = Batch(task, 1, render_mode, params, options, modes)
        self.render_mode = render_mode
        self.metadata = self._batch.metadata
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space
        self._ended = False
        self._shown: Packed | None = None
        self._steps = 0  # control steps of the episode; used in the mode "human"
        self._window = _Window(self._batch.env.name)

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
        self._steps = 0
        self._show()
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
        # The batch has already begun the next episode, so the picture shows the ended
        # episode one step before its end.
        self._shown = before if self._ended else self._batch.packed()
        self._steps += 1
        self._show()
        return (
            observed(step.final_observation[0]),
            float(step.reward[0]),
            terminated,
            truncated,
            {name: value[0].item() for name, value in step.info.items()},
        )

    def render(self) -> np.ndarray | None:
        """Draws a picture, RGB of shape (480, 640, 3), in the mode "rgb_array".

        Returns:
            The picture; None in the mode "human", whose window needs no call, and
            without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('nothing is drawn unless render_mode="rgb_array"')
            return None
        if self._shown is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        return None if self.render_mode == "human" else self._picture(self._shown)

    def _picture(self, shown: Packed) -> np.ndarray:
        """Picture of a packed state of the batch, RGB."""
        return self._batch.picture(self._batch.unpacked(shown), 0)

    def _show(self) -> None:
        """Puts a picture in the window, if there is a window and one is due."""
        if self.render_mode != "human" or self._shown is None:
            return
        if self._steps % self.metadata["steps_per_frame"] == 0:
            picture = self._picture(self._shown)
            self._window.show(picture, 1 / self.metadata["render_fps"])

    def close(self) -> None:
        """Closes the window, if there is one."""
        self._window.close()


class _Window:
    """Window of matplotlib that shows one picture after another."""

    def __init__(self, title: str) -> None:
        """Opens no window yet; `title` is its title."""
        self._title = title
        self._figure: Any = None
        self._image: Any = None
        self._due = 0.0  # earliest time of the next picture, of time.monotonic [s]

    def show(self, picture: np.ndarray, seconds: float) -> None:
        """Shows an RGB picture, no sooner than `seconds` after the one before."""
        from matplotlib import pyplot

        if self._figure is None:
            height, width, _ = picture.shape
            size = width / 100, height / 100
            self._figure = pyplot.figure(self._title, size, 100)
            self._image = self._figure.figimage(picture)
            if self._figure.canvas.required_interactive_framework is None:
                gymnasium.logger.warn(
                    'render_mode="human" shows nothing: matplotlib has no window here, '
                    f"its backend is {pyplot.get_backend()!r}"
                )
            else:
                self._figure.show()
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.start_event_loop(max(self._due - time.monotonic(), 1e-3))
        self._due = time.monotonic() + seconds

    def close(self) -> None:
        """Closes the window."""
        if self._figure is not None:
            from matplotlib import pyplot

            pyplot.close(self._figure)
            self._figure = None


class GymnasiumVectorEnv(
    _Limited, gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]
):
    """`jaxrod.envs.VectorEnvironment` for Gymnasium, equal up to round-off.

    The seed s starts the batch with `jax.random.key(s)`. When an episode ends the
    environment restarts by `autoreset_mode`, as Gymnasium defines the modes:

    - `SAME_STEP`: at once. The observation is the first of the next episode.
      `infos["final_obs"]` and `infos["final_info"]` are the last of the ended episode,
      where `infos["_final_obs"]` is true.
    - `NEXT_STEP`: in the next step, which ignores the action and has zero reward.
      Gymnasium's wrappers that normalise observations require it.
    - `DISABLED`: on request, by `reset(options={"reset_mask": ended})`.

    Example:
        >>> from jaxrod.envs.gym import GymnasiumVectorEnv
        >>> batch = GymnasiumVectorEnv("trivial", num_envs=3)
        >>> observations, infos = batch.reset(seed=0)
        >>> actions = batch.action_space.sample()
        >>> observations, rewards, *_ = batch.step(actions)
        >>> observations.shape, rewards.shape
        ((3, 1), (3,))
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
        max_episode_steps: int | None = None,
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
            max_episode_steps: The task's option `episode_length` under Gymnasium's
                name; the smaller one counts. A `spec` that is made again has both.
            **options: Passed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: An argument does not fit.
        """
        if max_episode_steps is not None:
            length = options.get("episode_length", max_episode_steps)
            options["episode_length"] = min(length, max_episode_steps)
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
                continue.

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
        """Checked `reset_mask`, true for the environments to reset; None for all."""
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
        """Draws every environment, RGB of shape (480, 640, 3).

        Returns:
            A picture of each environment; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('nothing is drawn unless render_mode="rgb_array"')
            return None
        state = self._batch.started()
        return tuple(self._batch.picture(state, i) for i in range(self.num_envs))


def _mode(given: AutoresetMode | str) -> AutoresetMode:
    """Autoreset mode from its enumeration member or value; otherwise a ValueError."""
    try:
        return AutoresetMode(given)
    except ValueError:
        known = ", ".join(mode.value for mode in AutoresetMode)
        raise ValueError(
            f"autoreset_mode must be one of {known}; got {given!r}"
        ) from None


def _infos(step: VectorStep, ended: np.ndarray) -> dict[str, Any]:
    """`infos` of `SAME_STEP`: scalars of running episodes, final data of ended ones."""
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
    """Scalars of the environments in a mask, zero elsewhere, in Gymnasium's layout.

    The entry "_name" is the mask of "name". Empty if no environment is in the mask.
    """
    if not where.any():
        return {}
    infos = {}
    for name, value in scalars.items():
        kind = bool if value.dtype == bool else float
        infos[name] = np.where(where, value, kind()).astype(kind)
        infos[f"_{name}"] = where.copy()
    return infos


for _task, _variants in VARIANTS.items():
    for _variant in _variants:
        gymnasium.register(
            id=_id(_task, _variant),
            entry_point="jaxrod.envs.gym:GymnasiumEnv",
            vector_entry_point="jaxrod.envs.gym:GymnasiumVectorEnv",
            kwargs={"task": _task, "variant": _variant},
        )
