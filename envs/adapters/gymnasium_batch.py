"""The running batch behind the Gymnasium adapters: seeds and NumPy in and out."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Array, Float, Key, UInt8

from jaxrod.envs.drawing import drawable, edge_lengths, missing, picture
from jaxrod.envs.protocol import Environment
from jaxrod.envs.registry import make
from jaxrod.envs.wrappers import VectorEnvironment, VectorState, VectorStep

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 714}
"""Metadata that Gymnasium reads from both classes before there is an environment."""


class Batch:
    """Environments that restart by themselves, and the state they are in.

    Attributes:
        env: the environment.
        num_envs: number of environments.
        observation_space: of one environment: any finite float32 numbers.
        action_space: of one environment: [-1, 1].
        metadata: render modes, and `render_fps`: control steps in a second.
        params: parameters of the environment; None for its own, until the first
            reset makes them.
        state: state of the batch, or None before the first reset.
    """

    def __init__(
        self,
        task: str | Environment,
        num_envs: int,
        render_mode: str | None,
        params: Any,
        options: dict[str, Any],
    ) -> None:
        """Makes the environment; computes nothing yet.

        Args:
            task: a task for `jaxrod.envs.make`, or an environment.
            num_envs: number of environments, at least 1.
            render_mode: None or "rgb_array".
            params: parameters; None for the environment's own.
            options: handed to `make`.

        Raises:
            ValueError: an argument does not fit.
        """
        if not isinstance(task, str) and options:
            raise ValueError(f"an environment takes no options, got {sorted(options)}")
        self.env = make(task, **options) if isinstance(task, str) else task
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        self.num_envs = num_envs
        self.params = params
        largest = float(np.finfo(np.float32).max)
        self.observation_space = Box(
            -largest, largest, (self.env.observation_size,), np.float32
        )
        self.action_space = Box(-1, 1, (self.env.action_size,), np.float32)
        self.metadata: dict[str, Any] = {"render_modes": []}
        if drawable(self.env):
            self.metadata = {
                "render_modes": ["rgb_array"],
                "render_fps": round(1 / self.env.control_period),
            }
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(
                f"render_mode must be None{' or ' if modes else ''}"
                f"{', '.join(map(repr, modes))} for {self.env.name}; "
                f"got {render_mode!r}"
            )
        self.state: VectorState | None = None
        self._lengths: np.ndarray | None = None

    def reset(self, seed: int) -> None:
        """Starts all episodes anew."""
        if self.params is None:
            self.params = self.env.default_params()
        batch = VectorEnvironment(self.env)
        self.state = _reset(batch, random_key(seed), self.num_envs, self.params)

    def step(self, actions: Any) -> VectorStep:
        """One control step of all; the arrays of the result are NumPy's."""
        state = self.started()
        actions = np.asarray(actions)
        shape = (self.num_envs, self.env.action_size)
        if actions.shape != shape:
            raise ValueError(f"actions must have shape {shape}, got {actions.shape}")
        self.state, step = _step(
            VectorEnvironment(self.env),
            state,
            jnp.asarray(actions, state.observation.dtype),
            self.params,
        )
        return jax.device_get(step)

    def started(self) -> VectorState:
        """The state.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before step and render")
        return self.state

    def picture(self, state: VectorState, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """A picture of environment number `index`.

        Raises:
            ValueError: the environment does not say what to draw.
        """
        env = self.env
        if not drawable(env):
            raise ValueError(missing(env))
        if self._lengths is None:
            self._lengths = edge_lengths(env, self.params)
        one = jax.tree.map(lambda leaf: leaf[index], state.states)
        seconds = int(state.elapsed[index]) * env.control_period
        return picture(env.snapshot(one, self.params), self._lengths, seconds)


def observed(observation: Array) -> Float[np.ndarray, "..."]:
    """An observation of the caller's own: float32, writable, shared with nobody."""
    return np.array(observation, np.float32)


def random_key(seed: int) -> Key[Array, ""]:
    """`jax.random.key(seed)`, and another one for every larger seed."""
    key = jax.random.key(seed & 0xFFFFFFFF)
    while seed := seed >> 32:
        key = jax.random.fold_in(key, seed & 0xFFFFFFFF)
    return key


@functools.partial(jax.jit, static_argnums=(0, 2))
def _reset(
    batch: VectorEnvironment, key: Key[Array, ""], num_envs: int, params: Any
) -> VectorState:
    return batch.reset(key, num_envs, params)


@functools.partial(jax.jit, static_argnums=0)
def _step(
    batch: VectorEnvironment, state: VectorState, action: Array, params: Any
) -> tuple[VectorState, VectorStep]:
    return batch.step(state, action, params)
