"""The choice between lanes and XLA, and a record of the choices with their reasons."""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.jax_internals.equations import result_types
from jaxrod.lanes.cycle import Cycle, Ends, Plan, adjoint_cycle, chosen
from jaxrod.lanes.graph import VARYING
from jaxrod.lanes.kernel import Kernel, adjoint_kernel, run_kernel, step_kernel
from jaxrod.lanes.kernel_plan import Entries, Step
from jaxrod.lanes.lengths import most_operations
from jaxrod.lanes.machine_code import (
    llvm_is_installed,
    not_here,
    registered,
    vector_bytes,
)
from jaxrod.lanes.unroll import NotUnrolled, kind_of
from jaxrod.lanes.unrolled import check_length, unrolled_run, unrolled_step

AUTO, ALWAYS, NEVER = "auto", "always", "never"
MODES = (AUTO, ALWAYS, NEVER)
FEWEST_RODS = 4
"""Smallest batch that lanes take; smaller ones are left to XLA."""

_log = logging.getLogger("jaxrod.lanes")
_mode = [os.environ.get("JAXROD_LANES", AUTO)]


@dataclass(frozen=True)
class LaneChoice:
    """The choice between lanes and XLA for one compiled run."""

    taken: bool
    """Whether lanes were chosen; otherwise XLA was."""
    why: str
    """Reason in words."""
    rods: int
    """Number of rods in the batch; 1 without a batch."""
    operations: int = 0
    """Operations in a step of one rod; for a whole run, those of its beginning and end
    are included."""
    seconds: float = 0.0
    """Time to write and compile the kernel [s]."""


_choices: deque[LaneChoice] = deque(maxlen=100)


def use_lanes(mode: str) -> None:
    """Sets when programs that are compiled from now on use lanes.

    Lanes are for CPUs. Other devices have none: XLA runs there.

    Args:
        mode: `"auto"` (where lanes are faster), `"always"` (wherever lanes are
            possible), or `"never"`. The environment variable `JAXROD_LANES` sets the
            initial mode.

    Raises:
        ValueError: The mode is unknown.
    """
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}; got {mode!r}")
    _mode[0] = mode


def lane_choices() -> list[LaneChoice]:
    """Returns the latest choices between lanes and XLA, one for each compiled run."""
    return list(_choices)


def lane_mode() -> str:
    """Returns the mode of lanes. Programs compiled in one mode serve no other mode."""
    if _mode[0] not in MODES:
        raise ValueError(
            f"JAXROD_LANES must be one of {', '.join(MODES)}; got {_mode[0]!r}"
        )
    return _mode[0]


def lanes_wanted() -> bool:
    """Whether runs are built in the form that lanes can take."""
    on_cpu = jax.default_backend() == "cpu"
    return lane_mode() != NEVER and on_cpu and not_here() is None


def slower() -> str | None:
    """Returns the reason why batches on CPUs are slower than they could be.

    Returns:
        One sentence, or `None` if batches run in lanes.
    """
    reason = "the mode is 'never'" if lane_mode() == NEVER else not_here()
    if reason is None:
        return None
    return (
        "Lanes are off: batches on CPUs run in XLA, about a fifth as fast, because "
        f"{reason}."
    )


@cache
def say_if_slower() -> None:
    """Logs one line, once, if lanes are installed but cannot be used."""
    reason = not_here()
    if reason is None or jax.default_backend() != "cpu":
        return
    refused(reason)
    if llvm_is_installed():
        _log.warning("jaxrod: %s", slower())


def refused(words: str, rods: int = 1) -> None:
    """Records that a run is left to XLA, and why."""
    _note(LaneChoice(False, words, rods))


def lowered_by_lanes(
    name: str, plan: Plan, results: Sequence[Any]
) -> Callable[..., Any] | None:
    """Returns the program of a primitive in lanes, or `None` to leave it to XLA.

    Args:
        name: Name of the primitive.
        plan: Structure of the operation.
        results: Shapes and types of its results.
    """
    cycle = plan.cycle
    rods = plan.batch.size if plan.batch is not None else 1
    mode = lane_mode()
    if mode == NEVER or not_here() is not None or rods == 0:
        return None
    if mode == AUTO and rods < FEWEST_RODS:
        refused(f"fewer than {FEWEST_RODS} rods", rods)
        return None
    begun = time.perf_counter()
    shared = (True,) * cycle.n_constants
    if plan.batch is not None:
        shared = tuple(not row for row in plan.batch.rows[: cycle.n_constants])
    try:
        if plan.ends is not None:
            kernel = _run_kernel(cycle, plan.ends, shared)
        elif name == "jaxrod_cycles":
            kernel = _steps_kernel(cycle, shared, plan.keeps)
        else:
            kernel = _back_kernel(cycle, plan.moving, shared)
        target = registered(kernel)
    except NotUnrolled as reason:
        refused(str(reason), rods)
        return None
    except Exception as error:
        # A run that XLA can do must not fail because there is no kernel for it.
        if mode == ALWAYS:
            raise
        first_line = str(error).partition("\n")[0]
        refused(f"no kernel: {type(error).__name__}: {first_line}", rods)
        return None
    seconds = time.perf_counter() - begun
    words = f"lanes of {vector_bytes()} bytes"
    _note(LaneChoice(True, words, rods, kernel.operations, seconds))
    return _call(target, kernel, plan, rods, results)


def _call(
    target: str, kernel: Kernel, plan: Plan, rods: int, results: Sequence[Any]
) -> Callable[..., Any]:
    """Returns a function that calls a kernel from JAX."""
    kept = plan.n_kept if plan.keeps else 0
    every = plan.every if kept else 2**31 - 1
    # Kernels align their workspace to 64 bytes themselves.
    room = kernel.room + 64 + kernel.kept * plan.every
    shapes = [jax.ShapeDtypeStruct(made.shape, made.dtype) for made in results]
    call = jax.ffi.ffi_call(target, [*shapes, jax.ShapeDtypeStruct((room,), jnp.uint8)])

    def program(steps: Any, *arrays: Any) -> list[Any]:
        counts = [jnp.asarray(n, jnp.int32) for n in (steps, every, rods, kept)]
        return list(call(jnp.stack(counts), *arrays))[:-1]

    return program


@lru_cache(maxsize=64)
def _steps_kernel(cycle: Cycle, shared: tuple[bool, ...], keeps: bool) -> Kernel:
    step, _, _ = unrolled_step(cycle, shared, most_operations(cycle))
    return step_kernel(step, _width(cycle), checkpoints=keeps)


@lru_cache(maxsize=64)
def _run_kernel(cycle: Cycle, ends: Ends, shared: tuple[bool, ...]) -> Kernel:
    step, around = unrolled_run(cycle, ends, shared, most_operations(cycle))
    return run_kernel(step, around, _width(cycle))


@lru_cache(maxsize=64)
def _back_kernel(
    cycle: Cycle, moving: tuple[bool, ...], shared: tuple[bool, ...]
) -> Kernel:
    step, unroller, inputs = unrolled_step(cycle, shared, most_operations(cycle))
    graph = step.graph
    plan = Plan(cycle, 0, moving)
    closed = adjoint_cycle(plan)
    floats = chosen(step.carry, cycle.floating)
    sums = chosen(step.constants, moving)
    carry = [Entries(e.kind, e.size, VARYING) for e in (*floats, *sums)]
    first = len(step.constants) + len(step.carry)
    given = [
        graph.inputs(first + i, aval.shape, kind_of(aval), VARYING)
        for i, aval in enumerate(result_types(closed))
    ]
    made = unroller.run(closed, [*inputs, *given[: len(floats)]])
    total = [
        graph.each("add", e.kind, old, new)
        for e, old, new in zip(
            sums, given[len(floats) :], made[len(floats) :], strict=True
        )
    ]
    check_length(len(graph), most_operations(cycle))
    outputs = [array.reshape(-1).tolist() for array in (*made[: len(floats)], *total)]
    adjoint = Step(graph, step.constants, carry, outputs)
    return adjoint_kernel(step, adjoint, len(floats), _width(cycle))


def _width(cycle: Cycle) -> int:
    """Rods in a vector of the widest floats of the carry."""
    sizes = [aval.dtype.itemsize for aval in chosen(cycle.avals, cycle.floating)] or [4]
    return max(vector_bytes() // max(sizes), 2)


def _note(choice: LaneChoice) -> None:
    _choices.append(choice)
    _log.info(
        "%s for %d rods: %s",
        "lanes" if choice.taken else "XLA",
        choice.rods,
        choice.why,
    )
