"""Stepping a scene through time: one step, many steps, recorded steps."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from jaxrod.analysis.stability import compression, stable_dt
from jaxrod.effects.memory import memory_of
from jaxrod.effects.time import Clock
from jaxrod.rods.rod import RodState
from jaxrod.scene import (
    Composite,
    Evolvable,
    Scene,
    check_scene,
    check_scene_and_state,
)
from jaxrod.validation import (
    MOST,
    as_array,
    check_array,
    check_count,
    check_kind,
    is_traced,
)

Carry = TypeVar("Carry")
State = TypeVar("State")
Model = Scene | Composite
"""What is stepped: one rod with what acts on it, or a system of several members."""

COMPRESSED = 0.9
"""Of the bound, what is left of it in consistent mode however a rod is compressed."""
ROUNDING = 1e-4
"""Of the bound, what is lost to rounding of positions where nothing is compressed."""


_ADVICE = (
    ": expect the simulation to blow up, with or without NaN. Use "
    "jaxrod.stable_dt(scene).dt, fewer elements, or a softer or thicker rod; "
    'warnings.simplefilter("error", jaxrod.UnstableStepWarning) makes this an error.'
)


class UnstableStepWarning(UserWarning):
    """The time step is above the stability bound of the scene."""


def step(
    scene: Model, state: State, dt: ArrayLike, *, first: int | Int[Array, ""] = 0
) -> State:
    """One step: half drift, kick, half drift. Pure; works inside jit, vmap and grad.

    Args:
        scene: The scene, or a system of several rods and bodies.
        state: Where the rod is and how it moves; of a system, a dict by member.
        dt: Step size [s].
        first: Steps since time zero, where the scene depends on time.

    Returns:
        The state after `dt`.

    Raises:
        ValueError: If `dt` is not positive or the state is not of the scene's rod.
        TypeError: If `scene` or `state` is something else.
    """
    begin = _check_first(scene, first, 1)
    return _static_compiled(scene, state, _check(scene, state, dt, begin), 1, begin)


def advance(
    scene: Model,
    state: State,
    dt: ArrayLike,
    n_steps: int | Int[Array, ""],
    *,
    first: int | Int[Array, ""] = 0,
) -> State:
    """`n_steps` steps of size `dt`, neighbouring half drifts merged.

    Called with plain arrays it runs a program compiled once for any `dt`, any
    number of steps and any numbers in the scene, and warns when `dt` is above
    `stable_dt`. Compression, which takes a tenth from that, is seen before and after
    the steps, not between. Within `jax.jit` it becomes part of that program. With an
    `int` number of steps it is differentiable in reverse mode (memory grows with the
    square root of the number of steps), with a traced one in forward mode. `jax.grad`,
    `jax.vmap` and the like need no `jax.jit` around them: what they make of it is
    compiled once for every `int` number of steps, or once for all traced ones.

    Args:
        scene: The scene, or a system of several rods and bodies.
        state: The initial state; of a system, a dict by member.
        dt: Step size [s].
        n_steps: How many steps, from 0 to 2147483647; an array below 0 counts as 0.
        first: Steps since time zero when it begins, where the scene depends on time:
            with schedules, call after call, `first += n_steps`.

    Returns:
        The final state.

    Raises:
        ValueError: If `dt` is not positive, `n_steps` is not a count, or the state is
            not of the scene's rod.
        TypeError: If `scene` or `state` is something else.

    Warns:
        UnstableStepWarning: If `dt` is above the stability bound.
    """
    if isinstance(n_steps, jax.Array):
        _check_counter(n_steps)
    else:
        n_steps = check_count("n_steps", n_steps, 0)
    begin = _check_first(scene, first, n_steps)
    dt = _check(scene, state, dt, begin)
    if is_traced(scene, state, dt, n_steps, begin):
        if isinstance(n_steps, int):
            return _static_compiled(scene, state, dt, n_steps, begin)
        return _traced_compiled(scene, state, dt, n_steps, begin)
    near_bound = check_step(scene.recalling(state), dt, state)
    after = _traced_compiled(scene, state, dt, jnp.asarray(n_steps), begin)
    if near_bound or scene.remembers:
        check_step(scene.recalling(after), dt, after)
    return after


def rollout(
    scene: Model,
    state: State,
    dt: ArrayLike,
    n_steps: int,
    every: int = 1,
    *,
    first: int | Int[Array, ""] = 0,
) -> State:
    """`n_steps` steps, recorded every `every` steps; differentiable in reverse mode.

    Args:
        scene: The scene, or a system of several rods and bodies.
        state: The initial state; of a system, a dict by member.
        dt: Step size [s].
        n_steps: How many steps, a multiple of `every`.
        every: Steps between records, at least 1.
        first: Steps since time zero when it begins, where the scene depends on time.

    Returns:
        The recorded states, a `RodState` whose leaves have a leading axis of
        `n_steps / every + 1`; the first record is the initial state.

    Raises:
        ValueError: If an argument is out of range.
        TypeError: If `scene` or `state` is something else.

    Warns:
        UnstableStepWarning: If `dt` is above the stability bound.
    """
    records = _check_records(n_steps, every)
    begin = _check_first(scene, first, n_steps)
    dt = _check(scene, state, dt, begin)
    if is_traced(scene, state, dt, begin):
        return _rollout_compiled(scene, state, dt, records, every, begin)
    near_bound = check_step(scene.recalling(state), dt, state)
    states = _rollout_compiled(scene, state, dt, records, every, begin)
    if near_bound or scene.remembers:
        last = jax.tree.map(lambda leaf: leaf[-1], states)
        check_step(scene.recalling(last), dt, last)
    return states


def rollout_times(
    dt: ArrayLike, n_steps: int, every: int = 1
) -> Float[Array, " records"]:
    """The times of the records of `rollout`, counted in integers.

    Args:
        dt: Step size [s].
        n_steps: How many steps, a multiple of `every`.
        every: Steps between records, at least 1.

    Returns:
        Times [s], `n_steps / every + 1` of them; the first is zero.

    Raises:
        ValueError: If an argument is out of range.
    """
    records = _check_records(n_steps, every)
    step = as_array("dt", dt, "s", positive=True)
    return jnp.arange(records + 1) * (every * step)


def check_step(scene: Model, dt: Array, state: Any = None) -> bool:
    """Warns when a concrete time step is above the scene's stability bound.

    Args:
        scene: The scene.
        dt: Step size [s].
        state: Where the rod is, if the bound is to account for compression. In
            consistent mode it is looked at, and so waited for, only where that matters.

    Returns:
        Whether the rod, compressed further, might not be stable at this step: true
        for one near the bound, unless it was warned of.

    Raises:
        ValueError: If `dt` is not a positive number.
    """
    if isinstance(scene, Composite):
        return _warn_of_system(scene, dt)
    check_scene(scene)
    check_array("dt", dt, [()], "s", positive=True)
    if not scene.method.explicit:
        return False
    bound = stable_dt(scene, safety=1.0)
    largest, where = float(bound.dt), ""
    near = float(dt) > COMPRESSED * largest
    if state is not None and (near or scene.method.law == "pyelastica"):
        factor, shortest = map(float, compression(scene, state))
        if factor < 1 - ROUNDING:
            largest *= factor
            where = f" in a rod compressed to {shortest:.3g} of its length"
    if not float(dt) > largest:
        return near
    warnings.warn(
        f"dt = {float(dt):.3g} s is above the stability bound {largest:.3g} s set by "
        f"{bound.limiting_mode}{where}" + _ADVICE,
        UnstableStepWarning,
        stacklevel=3,
    )
    return False


def _warn_of_system(system: Composite, dt: Array) -> bool:
    """Warns when a concrete step is above a system's bound; there is no near."""
    words = system.step_warning(dt)
    if words is not None:
        warnings.warn(words + _ADVICE, UnstableStepWarning, stacklevel=4)
    return False


def _check_counter(n_steps: Array, name: str = "n_steps") -> None:
    """Checks a number of steps that may be traced."""
    if n_steps.shape != () or not jnp.issubdtype(n_steps.dtype, jnp.integer):
        raise ValueError(
            f"{name} must be one integer, got {n_steps.dtype}{list(n_steps.shape)}"
        )


def _check_first(
    scene: Model, first: int | Array, n_steps: int | Array
) -> Array | None:
    """The step to begin with, for a scene to which it matters."""
    if not isinstance(scene, Composite):
        check_scene(scene)
    if isinstance(first, jax.Array):
        _check_counter(first, "first")
    else:
        known = n_steps if isinstance(n_steps, int) else 0
        first = check_count("first", first, 0, MOST - known)
    if not scene.evolves:
        return None
    return jnp.asarray(first, jnp.int32)


def with_memory(scene: Model, state: Any) -> Any:
    """The state with the memory that the scene's effects begin with, if it has none.

    Runs do this themselves. A loop of your own (`jax.lax.scan`) and `freeze` need it
    before the first run, so that states before and after it are alike.

    Args:
        scene: The scene.
        state: A state of its rod.
    """
    if isinstance(scene, Composite):
        return scene.with_memory(state)
    check_scene(scene)
    check_kind("state", state, RodState)
    if state.memory is not None or not scene.remembers:
        return state
    return replace(state, memory=memory_of(scene.effects))


def _check_records(n_steps: int, every: int) -> int:
    """Checks how a run is recorded; returns the number of records but the first."""
    n_steps = check_count("n_steps", n_steps, 0)
    every = check_count("every", every, 1)
    if n_steps % every:
        raise ValueError(
            f"n_steps must be a multiple of every, got {n_steps} and {every}"
        )
    return n_steps // every


def _check(scene: Model, state: Any, dt: ArrayLike, first: Array | None) -> Array:
    """Checks the arguments of a run; gives the step the type of the scene."""
    if isinstance(scene, Composite):
        return scene.check_run(state, dt)
    check_scene_and_state(scene, state)
    dtype = scene.rod.rest_lengths.dtype
    step = as_array("dt", dt, "s", positive=True, dtype=dtype)
    if state.positions.dtype != dtype:
        raise ValueError(
            f"state must be {dtype}, as the scene's rod is, got {state.positions.dtype}"
        )
    # Within jit the step is traced, and so is whatever is worked out there.
    if not is_traced(scene, state, step, first):
        now = scene.recalling(state)
        if first is not None:
            now = now.at(Clock(first, jnp.zeros_like(step), step))
        scene.method.check_state(now, state)
        if scene.evolves:
            # Zero now may be out of the plane or about the axis later.
            scene.method.check_state(scene.stirred, state)
    return step


def _run_traced(
    scene: Model, state: Any, dt: Array, n_steps: Array, first: Array | None
) -> Any:
    state = with_memory(scene, state)
    after = _run(scene, state, dt, n_steps, first, _repeat_traced)
    return jax.tree.map(
        lambda after, before: jnp.where(n_steps > 0, after, before), after, state
    )


def _run_static(
    scene: Model, state: Any, dt: Array, n_steps: int, first: Array | None
) -> Any:
    state = with_memory(scene, state)
    if n_steps == 0:
        return state
    return _run(scene, state, dt, n_steps, first, repeat)


def _run(
    scene: Model,
    state: Any,
    dt: Array,
    n_steps: int | Array,
    first: Array | None,
    loop: Callable[[Callable[[Any], Any], Any, Any], Any],
) -> Any:
    """At least one step."""
    integrator = stepper(scene, state, dt, first)
    cycles = n_steps - integrator.steps_of_end
    return integrator.end(loop(integrator.cycle, integrator.begin(state), cycles))


def stepper(scene: Model, state: Any, dt: Array, first: Array | None) -> Any:
    """The integrator of a scene; `first` counts where it depends on time."""
    if isinstance(scene, Composite):
        return scene.run_stepper(state, dt, first)
    if first is None:
        return scene.method.stepper(scene, state, dt)
    start = scene.at(Clock(first, jnp.zeros_like(dt), dt))
    constants = scene.method.stepper(start, state, dt)
    if not isinstance(constants, Evolvable):
        raise ValueError(
            f"{type(scene.method).__name__} has no steps for a scene that depends on "
            "time or remembers: its stepper needs a method `evolving`"
        )
    return constants.evolving(scene, first)


def _repeat_traced(
    function: Callable[[Carry], Carry], carry: Carry, n_times: Array
) -> Carry:
    return lax.fori_loop(0, n_times, lambda _, c: function(c), carry)


def repeat(function: Callable[[Carry], Carry], carry: Carry, n_times: int) -> Carry:
    """Applies a function a static number of times, cheap to differentiate.

    Every application is checkpointed: reverse mode works from the carries alone,
    which compiles and runs several times faster than storing what happens in a step.
    Many applications go in two nested loops, so that about `2 sqrt(n_times)` carries
    are kept instead of `n_times`, for one more forward pass.
    """
    remembered = jax.checkpoint(function)

    def inner(carry: Carry, length: int) -> Carry:
        return lax.scan(lambda c, _: (remembered(c), None), carry, length=length)[0]

    if n_times < 64:
        return inner(carry, n_times)
    block = math.isqrt(n_times)
    blocks, rest = divmod(n_times, block)
    checkpointed = jax.checkpoint(lambda c: inner(c, block), prevent_cse=False)
    carry = lax.scan(lambda c, _: (checkpointed(c), None), carry, length=blocks)[0]
    return inner(carry, rest) if rest else carry


# Within another jit these change nothing. Under a transformation alone they keep a
# run from being compiled again in every call.
_traced_compiled = jax.jit(_run_traced)
_static_compiled = jax.jit(_run_static, static_argnames="n_steps")


@jax.jit(static_argnames=("records", "every"))
def _rollout_compiled(
    scene: Model,
    state: Any,
    dt: Array,
    records: int,
    every: int,
    first: Array | None,
) -> Any:
    state = with_memory(scene, state)

    def block(state: Any, count: Array | None) -> Any:
        begin = None if first is None or count is None else first + every * count
        return _run_static(scene, state, dt, every, begin)

    def record(carry: Any, count: Array | None) -> tuple[Any, Any]:
        after = jax.checkpoint(block, prevent_cse=False)(carry, count)
        return after, after

    counts = None if first is None else jnp.arange(records, dtype=jnp.int32)
    _, states = lax.scan(record, state, counts, length=records)
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]), state, states
    )
