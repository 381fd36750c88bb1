"""Runs of a model (single, repeated and recorded steps), and argument checks."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxrod.jax_internals.scans import scan
from jaxrod.lanes.choice import lane_mode
from jaxrod.model import Model, TimeStep, check_model
from jaxrod.stepping.loops import integrated
from jaxrod.validation import MOST, as_time_step, check_count, is_traced, warn

State = TypeVar("State")

_ADVICE = (
    ": expect the simulation to blow up, with or without NaN. Use "
    "jaxrod.stable_dt(scene).dt, fewer elements, or a softer or thicker rod; "
    'warnings.simplefilter("error", jaxrod.UnstableStepWarning) makes this an error.'
)


class UnstableStepWarning(UserWarning):
    """The time step is above the stability bound of the scene."""


def check_step(scene: Model, dt: Array, state: Any = None) -> bool:
    """Warns if a concrete time step is above the scene's stability bound.

    Args:
        scene: The scene.
        dt: Step size [s].
        state: State of the rod, if the bound is to account for compression. In
            consistent mode its values are read, which waits for JAX, only if `dt` is
            near the bound.

    Returns:
        Whether the step may become unstable if the rod is compressed further. True if
        it is near the bound and no warning was given.

    Raises:
        ValueError: If `dt` is not a positive number.
    """
    words, near = scene.step_warning(dt, state)
    if words is not None:
        warn(words + _ADVICE, UnstableStepWarning)
    return near


def check_counter(n_steps: Array, name: str = "n_steps") -> None:
    """Raises a ValueError unless a number of steps, traced or not, is one integer."""
    if n_steps.shape != () or not jnp.issubdtype(n_steps.dtype, jnp.integer):
        raise ValueError(
            f"{name} must be one integer, got {n_steps.dtype}{list(n_steps.shape)}"
        )


def check_first(scene: Model, first: int | Array, n_steps: int | Array) -> Array | None:
    """Validates the number of a run's first step, and returns it as an int32 array.

    Returns `None` for a scene without schedules and memory. `n_steps` is the number of
    steps of the run.
    """
    check_model(scene)
    if isinstance(first, jax.Array):
        check_counter(first, "first")
    else:
        known = n_steps if isinstance(n_steps, int) else 0
        first = check_count("first", first, 0, MOST - known)
    if not scene.evolves:
        return None
    return jnp.asarray(first, jnp.int32)


def check_records(n_steps: int, every: int) -> int:
    """Validates both counts; returns the number of records after the initial one."""
    n_steps = check_count("n_steps", n_steps, 0)
    every = check_count("every", every, 1)
    if n_steps % every:
        raise ValueError(
            f"n_steps must be a multiple of every, got {n_steps} and {every}"
        )
    return n_steps // every


def with_memory(scene: Model, state: State) -> State:
    """State with the initial memory of the scene's effects, if it has none yet.

    Runs do this themselves. A loop that you write (`jax.lax.scan`) and `freeze` need it
    before the first run, so that states before and after it have the same structure.

    Args:
        scene: The scene.
        state: A state of its rod.

    Raises:
        TypeError: If `scene` or `state` has the wrong type.

    Example:
        >>> ready = jaxrod.with_memory(scene, state)
        >>> ready.memory is None  # no effect of this scene remembers anything
        True
    """
    check_model(scene)
    kept: State = scene.with_memory(state)
    return kept


def step(
    scene: Model, state: State, dt: TimeStep, *, first: int | Int[Array, ""] = 0
) -> State:
    """Takes one step: half drift, kick, half drift in explicit methods.

    Pure; works inside jit, vmap and grad.

    Args:
        scene: The scene, or a system of several rods and bodies.
        state: Configuration and rates of the rod; for a system, a dict by member.
        dt: Step size [s], or the result of `stable_dt`.
        first: Number of steps since time zero, if the scene depends on time.

    Returns:
        The state after `dt`.

    Raises:
        ValueError: If `dt` is not positive or the state does not match the scene's rod.
        TypeError: If `scene` or `state` has the wrong type.

    Example:
        >>> after = jaxrod.step(scene, state, 1e-4)
        >>> bool(after.tip[2] < state.tip[2])  # it falls
        True
    """
    begin = check_first(scene, first, 1)
    dt = scene.check_run(state, dt, begin)
    state = scene.with_memory(state)
    return _static_compiled(scene, state, dt, 1, begin, lane_mode())


def advance(
    scene: Model,
    state: State,
    dt: TimeStep,
    n_steps: int | Int[Array, ""],
    *,
    first: int | Int[Array, ""] = 0,
) -> State:
    """Takes `n_steps` steps of size `dt`, with neighbouring half drifts merged.

    Called with plain arrays it runs a program compiled once for any `dt`, any number of
    steps and any numbers in the scene, and warns if `dt` is above `stable_dt`. That
    bound may fall by a tenth under compression, which is checked before and after the
    steps, not in between. Within `jax.jit` it becomes part of that program. With an
    `int` number of steps it is differentiable in reverse mode (memory grows with the
    square root of the number of steps), with a traced one in forward mode. `jax.grad`,
    `jax.vmap` and similar transformations need no `jax.jit` around them: the
    transformed program is compiled once for every `int` number of steps, or once for
    all traced ones.

    Calls with m and with n steps give the same as one call with m + n steps, up to
    round-off. That does not hold if a section or a rigid body, with its attachments, is
    not axisymmetric: then two half steps of free rotation equal a whole one to second
    order in `dt` only, which is the order of the method. The records of `rollout`
    divide a run in the same way.

    Args:
        scene: The scene, or a system of several rods and bodies.
        state: The initial state; for a system, a dict by member.
        dt: Step size [s], or the result of `stable_dt`.
        n_steps: Number of steps, from 0 to 2147483647; an array below 0 counts as 0.
        first: Number of steps between time zero and the start, if the scene depends on
            time. For consecutive calls, add `n_steps` to it after each.

    Returns:
        The final state.

    Raises:
        ValueError: If `dt` is not positive, `n_steps` is not a count, or the state does
            not match the scene's rod.
        TypeError: If `scene` or `state` has the wrong type.

    Warns:
        UnstableStepWarning: If `dt` is above the stability bound.

    Example:
        >>> later = jaxrod.advance(scene, state, jaxrod.stable_dt(scene), 100)
        >>> bool(later.tip[2] < state.tip[2])  # it falls
        True
    """
    if isinstance(n_steps, jax.Array):
        check_counter(n_steps)
    else:
        n_steps = check_count("n_steps", n_steps, 0)
    begin = check_first(scene, first, n_steps)
    dt = scene.check_run(state, dt, begin)
    # Before compilation, so that the next call uses the same program.
    state = scene.with_memory(state)
    if is_traced(scene, state, dt, n_steps, begin):
        if isinstance(n_steps, int):
            return _static_compiled(scene, state, dt, n_steps, begin, lane_mode())
        return _traced_compiled(scene, state, dt, n_steps, begin, lane_mode())
    near_bound = check_step(scene.recalling(state), dt, state)
    count = jnp.asarray(n_steps)
    after = _traced_compiled(scene, state, dt, count, begin, lane_mode())
    if near_bound or scene.remembers:
        check_step(scene.recalling(after), dt, after)
    return after


def rollout(
    scene: Model,
    state: State,
    dt: TimeStep,
    n_steps: int,
    every: int = 1,
    *,
    first: int | Int[Array, ""] = 0,
) -> State:
    """Takes `n_steps` steps and records every `every`-th; reverse-mode differentiable.

    Args:
        scene: The scene, or a system of several rods and bodies.
        state: The initial state; for a system, a dict by member.
        dt: Step size [s], or the result of `stable_dt`.
        n_steps: Number of steps, a multiple of `every`.
        every: Number of steps between records, at least 1.
        first: Number of steps between time zero and the start, if the scene depends on
            time.

    Returns:
        The recorded states, a `RodState` whose leaves have a leading axis of
        `n_steps / every + 1`; the first record is the initial state.

    Raises:
        ValueError: If an argument is out of range.
        TypeError: If `scene` or `state` has the wrong type.

    Warns:
        UnstableStepWarning: If `dt` is above the stability bound.

    Example:
        >>> records = jaxrod.rollout(scene, state, 1e-4, 100, every=10)
        >>> records.tip.shape
        (11, 3)
    """
    records = check_records(n_steps, every)
    begin = check_first(scene, first, n_steps)
    dt = scene.check_run(state, dt, begin)
    state = scene.with_memory(state)
    if is_traced(scene, state, dt, begin):
        return _rollout_compiled(scene, state, dt, records, every, begin, lane_mode())
    near_bound = check_step(scene.recalling(state), dt, state)
    states = _rollout_compiled(scene, state, dt, records, every, begin, lane_mode())
    if near_bound or scene.remembers:
        last = jax.tree.map(lambda leaf: leaf[-1], states)
        check_step(scene.recalling(last), dt, last)
    return states


def rollout_times(
    dt: TimeStep, n_steps: int, every: int = 1
) -> Float[Array, " records"]:
    """Times of the records of `rollout`, from integer counts of steps.

    Args:
        dt: Step size [s], or the result of `stable_dt`.
        n_steps: Number of steps, a multiple of `every`.
        every: Number of steps between records, at least 1.

    Returns:
        Times [s], `n_steps / every + 1` of them; the first is zero.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> jaxrod.rollout_times(0.25, 8, every=2).tolist()
        [0.0, 0.5, 1.0, 1.5, 2.0]
    """
    records = check_records(n_steps, every)
    step = as_time_step(dt)
    return jnp.arange(records + 1) * (every * step)


def _run_traced(
    scene: Model,
    state: Any,
    dt: Array,
    n_steps: Array,
    first: Array | None,
    lanes: str,
) -> Any:
    """State after a traced number of steps, from step number `first` on.

    The argument `lanes` is not read here: it keeps programs that were compiled in
    different modes of `use_lanes` apart.
    """
    state = scene.with_memory(state)
    after = _run(scene, state, dt, n_steps, first)
    return jax.tree.map(
        lambda after, before: jnp.where(n_steps > 0, after, before), after, state
    )


def _run_static(
    scene: Model,
    state: Any,
    dt: Array,
    n_steps: int,
    first: Array | None,
    lanes: str,
) -> Any:
    state = scene.with_memory(state)
    if n_steps == 0:
        return state
    return _run(scene, state, dt, n_steps, first)


def _run(
    scene: Model, state: Any, dt: Array, n_steps: int | Array, first: Array | None
) -> Any:
    """State after `n_steps` steps, at least one, from step number `first` on."""
    stepper = scene.run_stepper(state, dt, first)
    return integrated(stepper, state, n_steps)


# Within another jit these change nothing. Under other transformations without jit they
# avoid compiling a run again in every call.
_traced_compiled = jax.jit(_run_traced, static_argnames="lanes")
_static_compiled = jax.jit(_run_static, static_argnames=("n_steps", "lanes"))


@jax.jit(static_argnames=("records", "every", "lanes"))
def _rollout_compiled(
    scene: Model,
    state: Any,
    dt: Array,
    records: int,
    every: int,
    first: Array | None,
    lanes: str,
) -> Any:
    state = scene.with_memory(state)

    def block(state: Any, count: Array | None) -> Any:
        begin = None if first is None or count is None else first + every * count
        return _run_static(scene, state, dt, every, begin, lanes)

    def record(carry: Any, count: Array | None) -> tuple[Any, Any]:
        after = jax.checkpoint(block, prevent_cse=False)(carry, count)
        return after, after

    counts = None if first is None else jnp.arange(records, dtype=jnp.int32)
    _, states = scan(record, state, counts, length=records)
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]), state, states
    )
