"""One environment in the shape of gymnax, for learners that are whole JAX programs.

rejax, purejaxrl and other such learners call `reset` and `step` under `jit`, `vmap` and
`scan`. Nothing of gymnax is imported here.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod.envs.checking import action_of_size
from jaxrod.envs.protocol import Environment, Info
from jaxrod.envs.registry import made
from jaxrod.installation.backend import compile_for_rods
from jaxrod.structure import pytree

__all__ = ["Box", "GymnaxEnv", "GymnaxParams", "GymnaxState"]


@dataclasses.dataclass(frozen=True)
class Box:
    """Space of arrays between two bounds, with the attributes of gymnax's.

    Example:
        >>> from jaxrod.envs.gymnax_env import Box
        >>> space = Box(-1.0, 1.0, (2,))
        >>> action = space.sample(jax.random.key(0))
        >>> bool(space.contains(action)), bool(space.contains(action + 2))
        (True, False)
    """

    low: float
    """Smallest value of every entry."""
    high: float
    """Largest value of every entry."""
    shape: tuple[int, ...]
    """Shape of the arrays."""
    dtype: Any = jnp.float32
    """Type of the numbers."""

    def sample(self, key: Key[Array, ""]) -> Float[Array, "..."]:
        """Draws an array, uniform between the bounds."""
        return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: Float[Array, "..."]) -> Bool[Array, ""]:
        """Whether all entries of an array are between the bounds."""
        return jnp.all((x >= self.low) & (x <= self.high))


@pytree
class GymnaxParams:
    """Parameters of a `GymnaxEnv`; every number is a traced leaf.

    Example:
        >>> from jaxrod.envs.gymnax_env import GymnaxEnv
        >>> params = GymnaxEnv("trivial").default_params
        >>> shorter = replace(params, max_steps_in_episode=10)
        >>> params.max_steps_in_episode, shorter.max_steps_in_episode
        (20, 10)
    """

    task: Any
    """Parameters of the task."""
    max_steps_in_episode: Int[Array, ""] | int
    """Control steps after which an episode is truncated; at most the length of the
    task's episodes has an effect."""


@pytree
class GymnaxState:
    """State of a `GymnaxEnv`.

    Example:
        >>> from jaxrod.envs.gymnax_env import GymnaxEnv
        >>> observation, start = GymnaxEnv("trivial").reset(jax.random.key(0))
        >>> int(start.time), bool((start.observation == observation).all())
        (0, True)
    """

    task: Any
    """State of the task."""
    time: Int[Array, ""]
    """Control steps of the running episode."""
    observation: Float[Array, " observation"]
    """Current observation; after a restart the first of the new episode."""
    final_observation: Float[Array, " observation"]
    """Observation after the last step and before a restart, to bootstrap from after a
    truncation. It is not in `info`, of which learners keep every step."""


class GymnaxEnv:
    """An environment with the interface of gymnax: functions of keys and parameters.

    A step that ends an episode restarts it. The returned observation and state are then
    those of the new episode. As in `jaxrod.envs.VectorEnvironment`, a step that returns
    a non-finite number has zero reward and truncates the episode, and its final
    observation is the one before.

    Attributes:
        env: The environment.
        default_params: Its default parameters.

    Example:
        >>> from jaxrod.envs.gymnax_env import GymnaxEnv
        >>> env = GymnaxEnv("trivial", episode_length=1)
        >>> params = env.default_params
        >>> keys = jax.random.split(jax.random.key(0), 3)
        >>> observation, start = jax.vmap(env.reset, (0, None))(keys, params)
        >>> step = jax.vmap(env.step, (0, 0, 0, None))
        >>> after = step(keys, start, jnp.zeros((3, env.num_actions)), params)
        >>> observation, state, reward, done, info = after
        >>> done.tolist(), info["truncated"].tolist()
        ([True, True, True], [True, True, True])
    """

    def __init__(self, task: str | Environment, **options: Any) -> None:
        """Makes the environment.

        Args:
            task: A task for `jaxrod.envs.make`, or an environment.
            **options: Passed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: An argument does not fit.
        """
        compile_for_rods()
        self.env = made(task, options)
        self.default_params = GymnaxParams(
            self.env.default_params(), self.env.episode_length
        )

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.env.name

    @property
    def num_actions(self) -> int:
        """Length of the action vector."""
        return self.env.action_size

    def action_space(self, params: GymnaxParams | None = None) -> Box:
        """Space of the actions: [-1, 1]."""
        return Box(-1.0, 1.0, (self.env.action_size,))

    def observation_space(self, params: GymnaxParams | None = None) -> Box:
        """Space of the observations: any finite numbers."""
        largest = float(jnp.finfo(jnp.float32).max)
        return Box(-largest, largest, (self.env.observation_size,))

    def reset(
        self, key: Key[Array, ""], params: GymnaxParams | None = None
    ) -> tuple[Float[Array, " observation"], GymnaxState]:
        """Starts an episode.

        Args:
            key: Random key, typed or of `jax.random.PRNGKey`.
            params: Parameters; None for `default_params`.

        Returns:
            The first observation and the state.

        Example:
            >>> from jaxrod.envs.gymnax_env import GymnaxEnv
            >>> observation, start = GymnaxEnv("trivial").reset(jax.random.key(0))
            >>> observation.shape, int(start.time)
            ((1,), 0)
        """
        return self._start(_typed(key), self._given(params))

    def step(
        self,
        key: Key[Array, ""],
        state: GymnaxState,
        action: Float[Array, " action"],
        params: GymnaxParams | None = None,
    ) -> tuple[
        Float[Array, " observation"],
        GymnaxState,
        Float[Array, ""],
        Bool[Array, ""],
        Info,
    ]:
        """Advances one control step, and restarts the episode if it ends.

        Args:
            key: Random key of this step, typed or of `jax.random.PRNGKey`.
            state: State from `reset` or from the step before.
            action: In [-1, 1], shape (action_size,).
            params: Parameters; None for `default_params`.

        Returns:
            Observation, state, reward, whether the episode ended, and the environment's
            scalars, with `"terminated"`, `"truncated"` and `"flagged"`.

        Raises:
            ValueError: The action has another shape.
        """
        given = self._given(params)
        moving, restarting = jax.random.split(_typed(key))
        seen, after, reward, terminated, truncated, info = self.env.step(
            moving, state.task, action_of_size(action, self.num_actions), given.task
        )
        sound = jnp.isfinite(reward) & jnp.all(jnp.isfinite(seen))
        seen = jnp.where(sound, seen, state.observation)
        time = state.time + info.get("control_steps", 1)
        terminated = terminated & sound
        truncated = truncated | ~sound | (time >= given.max_steps_in_episode)
        done = terminated | truncated
        first, start = self._start(restarting, given)
        running = GymnaxState(after, time, seen, seen)
        following = jax.tree.map(lambda a, b: jnp.where(done, a, b), start, running)
        info = info | {
            "terminated": terminated,
            "truncated": truncated & ~terminated,
            "flagged": ~sound | info.get("flagged", ~sound),
        }
        return (
            jnp.where(done, first, seen),
            dataclasses.replace(following, final_observation=seen),
            jnp.where(sound, reward, 0).astype(seen.dtype),
            done,
            info,
        )

    def _start(
        self, key: Key[Array, ""], given: GymnaxParams
    ) -> tuple[Float[Array, " observation"], GymnaxState]:
        """First observation and state of an episode."""
        first, start = self.env.reset(key, given.task)
        return first, GymnaxState(start, jnp.zeros((), jnp.int32), first, first)

    def _given(self, params: GymnaxParams | None) -> GymnaxParams:
        """Parameters, or the default ones, which XLA is kept from folding.

        They would be constants of the caller's program. XLA folds constants ahead of
        time, to other last bits than a computation with arguments.
        """
        if params is not None:
            return params
        return jax.lax.optimization_barrier(self.default_params)


def _typed(key: Array) -> Key[Array, ""]:
    """Typed random key; a raw one, of `jax.random.PRNGKey`, is wrapped."""
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        return key
    return jax.random.wrap_key_data(key)
