"""The running batch behind the Gymnasium adapters: seeds, NumPy inputs and outputs."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Array, Bool, Float, Key, UInt8

from jaxrod.envs.actions import check_action_shape
from jaxrod.envs.adapters.packing import Layout, Packed, layout
from jaxrod.envs.drawing import drawable, edge_lengths, missing, picture
from jaxrod.envs.protocol import Environment
from jaxrod.envs.registry import make
from jaxrod.envs.wrappers import VectorEnvironment, VectorState, VectorStep
from jaxrod.installation.backend import compile_for_rods

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 714}
"""Metadata that Gymnasium reads from both classes before an environment exists."""


class Batch:
    """Environments that restart by themselves, and their current state.

    Attributes:
        env: The environment.
        num_envs: Number of environments.
        observation_space: Space of one environment: any finite float32 numbers.
        action_space: Space of one environment: [-1, 1].
        metadata: Render modes, and `render_fps`: control steps per second.
        params: Parameters of the environment; None means its defaults, which the first
            reset makes.
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
            task: A task for `jaxrod.envs.make`, or an environment.
            num_envs: Number of environments, at least 1.
            render_mode: None or "rgb_array".
            params: Parameters; None for the environment's defaults.
            options: Passed to `make`.

        Raises:
            ValueError: An argument does not fit.
        """
        compile_for_rods()
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
        self._packed: Packed | None = None
        self._lengths: np.ndarray | None = None

    def reset(
        self, seed: int, where: Bool[np.ndarray, " num_envs"] | None = None
    ) -> None:
        """Starts new episodes in all environments, or in some.

        Args:
            seed: Seed of the random numbers.
            where: Mask of the environments that start; None for all.
        """
        if self.params is None:
            self.params = self.env.default_params()
        batch = VectorEnvironment(self.env)
        state = _reset(batch, random_key(seed), self.num_envs, self.params)
        if where is not None:
            state = _chosen(where, state, self.started())
        self._layout, numbers = layout(state), layout(self.params)
        self._packed = self._layout.pack(state)
        self._numbers = numbers.pack(self.params)
        self._dtype = np.dtype(state.observation.dtype)
        made_of = batch, self._layout, numbers, self.num_envs == 1
        # Looked up once, here: in every step it would take a twentieth of one arm's
        # time.
        self._programs = [_program(*made_of, waits) for waits in (False, True)]

    def step(
        self, actions: Any, waiting: Bool[np.ndarray, " num_envs"] | None = None
    ) -> VectorStep:
        """Advances all environments by one control step; the results are NumPy arrays.

        Args:
            actions: Shape (num_envs, action_size).
            waiting: Mask of environments that stay as they are: they earn nothing and
                do not end.
        """
        packed = self.packed()
        actions = np.asarray(actions)
        check_action_shape("actions", actions, (self.num_envs, self.env.action_size))
        actions = actions.astype(self._dtype)
        program = self._programs[waiting is not None]
        self._packed, (arrays, others) = program.step(
            packed, actions, self._numbers, waiting
        )
        return program.outcome.unpack(
            (tuple(map(np.asarray, arrays)), tuple(map(np.asarray, others)))
        )

    def packed(self) -> Packed:
        """The state, packed.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        if self._packed is None:
            raise gymnasium.error.ResetNeeded("call reset before step and render")
        return self._packed

    def unpacked(self, packed: Packed) -> VectorState:
        """The unpacked state."""
        return self._layout.unpack(packed)

    def started(self) -> VectorState:
        """The current state.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        return self.unpacked(self.packed())

    def picture(self, state: VectorState, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """A picture of environment number `index`.

        Raises:
            ValueError: The environment cannot be drawn.
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
    """A private copy of an observation: float32, writable, shared with nobody."""
    return np.array(observation, np.float32)


def random_key(seed: int) -> Key[Array, ""]:
    """`jax.random.key(seed)`; a distinct key for every larger seed, too."""
    key = jax.random.key(seed & 0xFFFFFFFF)
    while seed := seed >> 32:
        key = jax.random.fold_in(key, seed & 0xFFFFFFFF)
    return key


@functools.partial(jax.jit, static_argnums=(0, 2))
def _reset(
    batch: VectorEnvironment, key: Key[Array, ""], num_envs: int, params: Any
) -> VectorState:
    return batch.reset(key, num_envs, params)


class Program:
    """The compiled control step of a batch."""

    def __init__(
        self, batch: VectorEnvironment, state: Layout, params: Layout, in_order: bool
    ) -> None:
        """Prepares the step; compiles nothing yet.

        Args:
            batch: The batch.
            state: Layout of its packed state.
            params: Layout of its packed parameters.
            in_order: Whether its kernels are to run one after the other.
        """
        self.outcome: Layout
        """Layout of the packed results; known once the step has been traced."""

        def step(
            packed: Packed,
            action: Array,
            numbers: Packed,
            waiting: Bool[Array, " num_envs"] | None,
        ) -> tuple[Packed, Packed]:
            before = state.unpack(packed)
            after, outcome = batch.step(before, action, params.unpack(numbers))
            if waiting is not None:
                after = _chosen(waiting, before, after)
                outcome = _without(waiting, before, outcome)
            self.outcome = layout(outcome)
            return state.pack(after), self.outcome.pack(outcome)

        options = _in_order_options() if in_order else None
        self.step = jax.jit(step, compiler_options=options)


@functools.lru_cache(maxsize=64)
def _program(
    batch: VectorEnvironment,
    state: Layout,
    params: Layout,
    in_order: bool,
    waits: bool,
) -> Program:
    """The compiled control step, shared by all equal batches.

    Batches with waiting environments get their own program: the others do not pay for
    it.
    """
    del waits
    return Program(batch, state, params, in_order)


def _without(
    waiting: Bool[Array, " num_envs"], before: VectorState, outcome: VectorStep
) -> VectorStep:
    """Outcome of a step in which some environments wait."""
    nothing = jnp.zeros_like(outcome.reward)
    shown, final = outcome.observation, outcome.final_observation
    return dataclasses.replace(
        outcome,
        observation=_chosen(waiting, before.observation, shown),
        final_observation=_chosen(waiting, before.observation, final),
        reward=jnp.where(waiting, nothing, outcome.reward),
        terminated=outcome.terminated & ~waiting,
        truncated=outcome.truncated & ~waiting,
    )


@jax.jit
def _chosen(where: Bool[Array, " num_envs"], these: Any, those: Any) -> Any:
    """Leaves of `these` where the mask holds, of `those` elsewhere."""
    return jax.tree.map(
        lambda a, b: jnp.where(
            jnp.reshape(where, where.shape + (1,) * (jnp.ndim(a) - 1)), a, b
        ),
        these,
        those,
    )


@functools.cache
def _in_order_options() -> dict[str, Any] | None:
    """XLA options to run the kernels of a program one after the other, on one thread.

    On CPUs XLA distributes independent kernels over several threads. For one arm this
    takes twice as long as the kernels themselves. None if XLA has no such option.
    """
    options = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
    try:
        jax.jit(lambda x: x + 1, compiler_options=options)(0)
    except jax.errors.JaxRuntimeError:
        return None
    return options
