"""Batch behind the adapters for Gymnasium, Stable Baselines 3 and PyTorch."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt8

from jaxrod.envs.checking import check_action_shape
from jaxrod.envs.drawing import drawable, edge_lengths, missing, picture
from jaxrod.envs.protocol import Environment
from jaxrod.envs.registry import made
from jaxrod.envs.wrappers import VectorEnvironment, VectorState, VectorStep
from jaxrod.installation.backend import compile_for_rods

MOST_FRAMES = 30
"""Largest number of pictures that a film shows in a second."""
METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": MOST_FRAMES}
"""Default metadata of the Gymnasium classes, read before an environment exists."""


def film_metadata(control_period: float, modes: Sequence[str]) -> dict[str, Any]:
    """Metadata of an environment that can be drawn.

    `render_fps` is the frame rate of a film in real time that shows the state after
    every `steps_per_frame` control steps. It is at most 30, rounded to a whole number.

    Args:
        control_period: Time between actions [s].
        modes: Render modes.
    """
    # Rounded, so that 1 / 30 s is not taken for a little less.
    steps = math.ceil(round(1 / (MOST_FRAMES * control_period), 6))
    return {
        "render_modes": [*modes],
        "render_fps": max(1, round(1 / (steps * control_period))),
        "steps_per_frame": steps,
    }


class Batch:
    """Batch of environments that restart by themselves, with its current state.

    Attributes:
        env: The environment.
        num_envs: Number of environments.
        observation_space: Space of one environment: any finite float32 numbers.
        action_space: Space of one environment: [-1, 1].
        metadata: Render modes, and the frame rate of films; see `film_metadata`.
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
        modes: Sequence[str] = ("rgb_array",),
    ) -> None:
        """Makes the environment; computes nothing yet.

        Args:
            task: A task for `jaxrod.envs.make`, or an environment.
            num_envs: Number of environments, at least 1.
            render_mode: None or one of `modes`.
            params: Parameters; None for the environment's defaults.
            options: Passed to `make`.
            modes: Render modes of an environment that can be drawn.

        Raises:
            ValueError: An argument does not fit.
        """
        compile_for_rods()
        self.env = made(task, options)
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
            self.metadata = film_metadata(self.env.control_period, modes)
        known = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in known:
            raise ValueError(
                f"render_mode must be {' or '.join(map(repr, [None, *known]))} for "
                f"{self.env.name}; got {render_mode!r}"
            )
        self._packed: Packed | None = None
        self._dtype: Any = None  # of observations and actions; set by `reset`
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
        self._dtype = state.observation.dtype
        made_of = batch, self._layout, numbers, self.num_envs == 1
        # The programs are looked up once: in every step this would take a twentieth of
        # the time of one arm.
        self._programs = [_program(*made_of, waits) for waits in (False, True)]

    def step(
        self, actions: Any, waiting: Bool[np.ndarray, " num_envs"] | None = None
    ) -> VectorStep:
        """Advances all environments by one control step; the results are NumPy arrays.

        Args:
            actions: Shape (num_envs, action_size).
            waiting: Mask of environments that do not change: they have zero reward and
                do not end.
        """
        return self.advance(np.asarray(actions, self._dtype), np.asarray, waiting)

    def advance(
        self,
        actions: Any,
        convert: Callable[[Array], Any],
        waiting: Bool[np.ndarray, " num_envs"] | None = None,
    ) -> VectorStep:
        """Advances all environments by one control step, for arrays of any library.

        Args:
            actions: Array for JAX, shape (num_envs, action_size), of the dtype of the
                observations.
            convert: Function that makes an array of the other library. The results are
                views of a few such arrays, which nothing else refers to.
            waiting: As in `step`.
        """
        packed = self.packed()
        check_action_shape("actions", actions, (self.num_envs, self.env.action_size))
        program = self._programs[waiting is not None]
        self._packed, (arrays, others) = program.step(
            packed, actions, self._numbers, waiting
        )
        return program.outcome.unpack(
            (tuple(map(convert, arrays)), tuple(map(convert, others)))
        )

    def set_elapsed(self, elapsed: Int[Array, " num_envs"]) -> None:
        """Sets the clocks of the running episodes [control steps], to end them early.

        These episodes count as partial.
        """
        state = self.started()
        partial = jnp.asarray(elapsed) > 0
        state = dataclasses.replace(
            state, elapsed=jnp.asarray(elapsed, state.elapsed.dtype), partial=partial
        )
        self._packed = self._layout.pack(state)

    def packed(self) -> Packed:
        """Current state of the batch, packed into flat arrays.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        if self._packed is None:
            raise gymnasium.error.ResetNeeded("call reset before step and render")
        return self._packed

    def unpacked(self, packed: Packed) -> VectorState:
        """State of the batch as a pytree, from flat arrays that `packed` returned."""
        return self._layout.unpack(packed)

    def started(self) -> VectorState:
        """Current state of the batch as a pytree.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was not called before.
        """
        return self.unpacked(self.packed())

    def picture(self, state: VectorState, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """Draws environment number `index` of a state as an RGB picture.

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
    """Copies an observation into a new writable NumPy array of float32."""
    return np.array(observation, np.float32)


def random_key(seed: int) -> Key[Array, ""]:
    """`jax.random.key(seed)` below 2^32; larger seeds also fold in their upper bits."""
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
    """Compiled control step of a batch, from packed arrays to packed arrays."""

    def __init__(
        self, batch: VectorEnvironment, state: Layout, params: Layout, in_order: bool
    ) -> None:
        """Prepares the step; compiles nothing yet.

        Args:
            batch: The batch.
            state: Layout of the batch's packed state.
            params: Layout of the packed parameters.
            in_order: Whether XLA is to run the kernels one after another.
        """
        self.outcome: Layout
        """Layout of the packed `VectorStep`; set when the step is traced."""

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
    """Compiled control step, cached so that equal batches share it.

    `waits` tells whether the step takes a mask of waiting environments: these keep
    their state, and their new episode begins with the next step. Such steps have a
    separate program, because choosing between old and new states costs time. `in_order`
    tells whether XLA runs the kernels one after another.
    """
    del waits
    return Program(batch, state, params, in_order)


def _without(
    waiting: Bool[Array, " num_envs"], before: VectorState, outcome: VectorStep
) -> VectorStep:
    """Results of a step, where waiting environments have no reward and do not end.

    Their observation is that of the state `before` the step. `outcome` are the results
    without waiting.
    """
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
    """Rows of `these` where the mask is true, of `those` elsewhere; axis 0: batch."""
    return jax.tree.map(
        lambda a, b: jnp.where(
            jnp.reshape(where, where.shape + (1,) * (jnp.ndim(a) - 1)), a, b
        ),
        these,
        those,
    )


@functools.cache
def _in_order_options() -> dict[str, Any] | None:
    """XLA options to run the kernels of a program one after another, on one thread.

    On CPUs XLA distributes independent kernels over several threads. For one arm this
    takes twice as long as the kernels themselves. None if XLA has no such option.
    """
    options = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
    try:
        jax.jit(lambda x: x + 1, compiler_options=options)(0)
    except jax.errors.JaxRuntimeError:
        return None
    return options


Packed = tuple[tuple[Any, ...], tuple[Any, ...]]
"""Packed pytree: one flat array per dtype, and the leaves that stay unpacked."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Position of a leaf of a pytree in the flat arrays."""

    array: int
    """Index of the flat array."""
    start: int
    """Index of the leaf's first number in that array."""
    stop: int
    """Index after the leaf's last number."""
    shape: tuple[int, ...]
    """Shape of the leaf."""
    key: str | None
    """Name of the implementation if the leaf holds random keys; `None` for numbers."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Rule for packing a pytree into one flat array per dtype.

    Layouts are hashable, and equal for trees of equal structure, shapes and dtypes.

    Packing saves time: a call of a compiled program has a cost for every argument and
    every result. A control step of one arm takes some 10 microseconds; its 46 arguments
    and 11 results took 300.
    """

    structure: Any
    """Structure of the tree, as `jax.tree.structure` returns it."""
    dtypes: tuple[np.dtype, ...]
    """Dtypes of the flat arrays."""
    places: tuple[Place | None, ...]
    """Position of each leaf. `None` for a leaf that stays unpacked, such as a Python
    number: an array would lose its weak type."""

    def pack(self, tree: PyTree) -> Packed:
        """Packs a tree: ravels and concatenates its leaves by dtype.

        Raises:
            ValueError: The tree does not match the one from which the layout was made.
        """
        leaves, structure = jax.tree.flatten(tree)
        if structure != self.structure:
            raise ValueError(f"must be a {self.structure}, got a {structure}")
        parts: list[list[Any]] = [[] for _ in self.dtypes]
        others = []
        for leaf, place in zip(leaves, self.places, strict=True):
            if place is None:
                others.append(leaf)
                continue
            numbers = jnp.asarray(leaf)
            if place.key is not None:
                numbers = jax.random.key_data(numbers)
            if (numbers.shape, numbers.dtype) != (
                place.shape,
                self.dtypes[place.array],
            ):
                raise ValueError(
                    f"must be {self.dtypes[place.array]} of shape {place.shape}, got "
                    f"{numbers.dtype} of shape {numbers.shape}"
                )
            parts[place.array].append(jnp.ravel(numbers))
        return tuple(map(jnp.concatenate, parts)), tuple(others)

    def unpack(self, packed: Packed) -> PyTree:
        """Restores a packed tree; its leaves are NumPy if the flat arrays are."""
        arrays, others = packed
        left = iter(others)
        leaves = []
        for place in self.places:
            if place is None:
                leaves.append(next(left))
                continue
            numbers = arrays[place.array][place.start : place.stop]
            numbers = numbers.reshape(place.shape)
            if place.key is not None:
                numbers = jax.random.wrap_key_data(numbers, impl=place.key)
            leaves.append(numbers)
        return jax.tree.unflatten(self.structure, leaves)


def layout(tree: PyTree) -> Layout:
    """Layout for packing trees like this one, whose leaves may be tracers."""
    leaves, structure = jax.tree.flatten(tree)
    found: list[tuple[np.dtype, tuple[int, ...], str | None] | None] = []
    for leaf in leaves:
        if getattr(leaf, "weak_type", not hasattr(leaf, "dtype")):
            found.append(None)
            continue
        numbers, key = jnp.asarray(leaf), None
        if jnp.issubdtype(numbers.dtype, jax.dtypes.prng_key):
            key = str(jax.random.key_impl(numbers))
            numbers = jax.random.key_data(numbers)
        found.append((np.dtype(numbers.dtype), numbers.shape, key))
    dtypes = tuple(sorted({each[0] for each in found if each}, key=str))
    offsets = [0] * len(dtypes)
    places: list[Place | None] = []
    for each in found:
        if each is None:
            places.append(None)
            continue
        dtype, shape, key = each
        array = dtypes.index(dtype)
        start, stop = offsets[array], offsets[array] + math.prod(shape)
        offsets[array] = stop
        places.append(Place(array, start, stop, shape, key))
    return Layout(structure, dtypes, tuple(places))
