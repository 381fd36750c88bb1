"""Kernels of runs: from the jaxprs of a run to a call of its machine code.

Lanes are for batches: a vector lane for each scene. A short program is written out
element by element, so that neighbours meet in registers. Compiling it takes longer for
more elements. Longer programs, and reverse passes, are lanes in loops: loops over the
elements, whose code does not grow with their number.

Rows are for single scenes, small batches, and scenes that are so large that a vector of
them does not fit into a processor's cache: the same loops, in vectors of elements.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.jax_internals.equations import (
    operand_types,
)
from jaxrod.lanes.choice import (
    ALWAYS,
    AUTO,
    LOOPS,
    NEVER,
    ROWS,
    LaneChoice,
    lane_mode,
    note,
    refused,
)
from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING, EndNodes, Entries, Graph, Step
from jaxrod.lanes.jaxpr.unroll import MOST_NODES, NotUnrolled, Unroller, kind_of
from jaxrod.lanes.kept_kernels import kept
from jaxrod.lanes.llvm.kernel import Kernel, run_kernel, step_kernel
from jaxrod.lanes.llvm.machine_code import not_here, registered, vector_bytes
from jaxrod.lanes.looped.kernels import (
    back_in_lanes,
    cycles_in_lanes,
    run_in_lanes,
)
from jaxrod.lanes.rows.kernels import (
    back_kernel,
    cycles_kernel,
    whole_run_kernel,
)
from jaxrod.lanes.run_spec import Ends, LoopBody, RunSpec, chosen
from jaxrod.lanes.warps.cuda import device, launch_for, slower_than_xla
from jaxrod.lanes.warps.cuda import not_here as no_warps_here
from jaxrod.lanes.warps.cuda import registered as registered_on_gpu
from jaxrod.lanes.warps.kernels import kernel_of_warps

MOST_OPERATIONS = 25_000
"""Largest number of graph nodes of a program that is written out element by element in
mode `"auto"`. Longer programs take several seconds to compile, and are no faster than
lanes in loops."""
MOST_MEMORY = 5_000_000
"""Largest memory of a vector of scenes [bytes] for which lanes in loops are chosen in
mode `"auto"`. More does not fit a processor's cache, so that rows are as fast."""


def lowered_by_lanes(
    name: str, spec: RunSpec, results: Sequence[Any]
) -> Callable[..., Any] | None:
    """Returns the CPU program of a primitive: a kernel's call, or `None` for XLA.

    The kernel is one of lanes, of lanes in loops or of rows. The choice is recorded
    with its reason.

    Args:
        name: Name of the primitive.
        spec: Structure of the operation: step, number of steps, batch.
        results: Shapes and types of the results of the primitive.
    """
    rods = spec.batch.size if spec.batch is not None else 1
    mode = lane_mode()
    if mode == NEVER or not_here() is not None or rods == 0:
        return None
    begun = time.perf_counter()
    few = rods == 1 or 2 * rods < _width(spec.body)
    ways: dict[str, Callable[[str, RunSpec], tuple[Kernel | None, str]]] = {
        "lanes": _written_out,
        "lanes in loops": _in_loops,
        "rows": _of_rows,
    }
    wanted = {
        AUTO: ("rows",) if few else ("lanes", "lanes in loops", "rows"),
        ALWAYS: ("lanes", "lanes in loops"),
        LOOPS: ("lanes in loops",),
        ROWS: ("rows",),
    }[mode]
    try:
        kernel, words, way = None, "", ""
        for way in wanted:
            make = partial(ways[way], name, spec)
            limits = MOST_OPERATIONS, MOST_MEMORY
            kind = f"{way} of {vector_bytes()} bytes, {mode}, {limits}"
            kernel, words = kept(kind, name, spec, make)
            if kernel is not None:
                break
        if kernel is None:
            refused(words, rods)
            return None
        target = registered(kernel)
    except Exception as error:
        _failed(error, rods)
        return None
    seconds = time.perf_counter() - begun
    words = f"{way} of {vector_bytes()} bytes"
    note(LaneChoice(True, words, rods, kernel.operations, seconds))
    # Kernels align their workspace to 64 bytes themselves.
    room = kernel.room + 64 + kernel.kept * spec.every
    return _program(target, room, spec, rods, results)


def lowered_by_warps(
    name: str, spec: RunSpec, results: Sequence[Any]
) -> Callable[..., Any] | None:
    """Returns the GPU program of a primitive: a kernel's call, or `None` for XLA.

    The choice is recorded with its reason. The arguments are those of
    `lowered_by_lanes`.
    """
    rods = spec.batch.size if spec.batch is not None else 1
    mode = lane_mode()
    if mode == NEVER or no_warps_here() is not None or rods == 0:
        return None
    begun = time.perf_counter()
    try:
        kernel = kernel_of_warps(name, spec)
        every = spec.every if kernel.kept else 0
        launch = launch_for(kernel, rods, every, device())
        words = slower_than_xla(kernel, launch, rods, device())
        if words is not None and mode == AUTO:
            refused(words, rods)
            return None
        target = registered_on_gpu(kernel, launch)
    except NotUnrolled as reason:
        refused(str(reason), rods)
        return None
    except Exception as error:
        _failed(error, rods)
        return None
    seconds = time.perf_counter() - begun
    place = "shared memory" if launch.in_shared else "the workspace"
    words = f"warps with {kernel.room} bytes each in {place}"
    note(LaneChoice(True, words, rods, kernel.operations, seconds))
    return _program(target, launch.workspace(kernel), spec, rods, results)


def _failed(error: Exception, rods: int) -> None:
    """Records that a run is left to XLA because its kernel could not be compiled.

    Raises:
        Exception: The error itself, in all modes but `"auto"`.
    """
    if lane_mode() in (ALWAYS, LOOPS, ROWS):
        raise error
    first_line = str(error).partition("\n")[0]
    refused(f"no kernel: {type(error).__name__}: {first_line}", rods)


def _written_out(name: str, spec: RunSpec) -> tuple[Kernel | None, str]:
    """Returns a kernel of lanes, element by element, or `None` and the reason.

    `name` is the name of the primitive, `spec` describes the run. With a kernel the
    reason is empty. Reverse passes are not written out: in loops they are as fast, and
    compiling takes half as long.
    """
    body = spec.body
    most = MOST_OPERATIONS if lane_mode() == AUTO else MOST_NODES
    shared = (True,) * body.n_constants
    if spec.batch is not None:
        shared = tuple(not row for row in spec.batch.rows[: body.n_constants])
    try:
        if spec.ends is not None:
            return _run_kernel(body, spec.ends, shared, most), ""
        if name == "jaxrod_cycles":
            return _steps_kernel(body, shared, spec.keeps, most), ""
        return None, "reverse passes are not written out"
    except NotUnrolled as reason:
        return None, str(reason)


def _in_loops(name: str, spec: RunSpec) -> tuple[Kernel | None, str]:
    """Returns a kernel with a scene in each lane and loops, or `None` and the reason.

    `name` is the name of the primitive, `spec` describes the run. With a kernel the
    reason is empty.
    """
    body, width = spec.body, _width(spec.body)
    batched = (False,) * body.n_constants
    if spec.batch is not None:
        batched = tuple(spec.batch.rows[: body.n_constants])
    try:
        if spec.ends is not None:
            kernel = run_in_lanes(body, spec.ends, batched, width)
        elif name == "jaxrod_cycles":
            kernel = cycles_in_lanes(body, batched, width, checkpoints=spec.keeps)
        else:
            kernel = back_in_lanes(body, spec.moving, batched, width)
    except NotUnrolled as reason:
        return None, str(reason)
    if lane_mode() == AUTO and kernel.room > MOST_MEMORY:
        return None, f"a vector of scenes takes {kernel.room} bytes"
    return kernel, ""


def _of_rows(name: str, spec: RunSpec) -> tuple[Kernel | None, str]:
    """Returns a kernel that runs scenes one by one, or `None` and the reason.

    `name` is the name of the primitive, `spec` describes the run. With a kernel the
    reason is empty.
    """
    body = spec.body
    batched = (False,) * body.n_constants
    if spec.batch is not None:
        batched = tuple(spec.batch.rows[: body.n_constants])
    try:
        if spec.ends is not None:
            return whole_run_kernel(body, spec.ends, batched), ""
        if name == "jaxrod_cycles":
            return cycles_kernel(body, batched, checkpoints=spec.keeps), ""
        return back_kernel(body, spec.moving, batched), ""
    except NotUnrolled as reason:
        return None, str(reason)


def _program(
    target: str, room: int, spec: RunSpec, rods: int, results: Sequence[Any]
) -> Callable[..., Any]:
    """Returns a function that calls the kernel registered as `target`.

    The function takes the number of steps and the operands, and returns results of the
    types `results`. The kernel gets `room` bytes of workspace, the number of rods, and
    the number of checkpoints and steps between them, from `spec`.
    """
    kept = spec.n_kept if spec.keeps else 0
    every = spec.every if kept else 2**31 - 1
    shapes = [jax.ShapeDtypeStruct(made.shape, made.dtype) for made in results]
    call = jax.ffi.ffi_call(target, [*shapes, jax.ShapeDtypeStruct((room,), jnp.uint8)])

    def program(steps: Any, *arrays: Any) -> list[Any]:
        counts = [jnp.asarray(n, jnp.int32) for n in (steps, every, rods, kept)]
        return list(call(jnp.stack(counts), *arrays))[:-1]

    return program


@lru_cache(maxsize=64)
def _steps_kernel(
    body: LoopBody, shared: tuple[bool, ...], keeps: bool, most: int
) -> Kernel:
    step, _, _ = _unrolled_step(body, shared, most)
    return step_kernel(step, _width(body), checkpoints=keeps)


@lru_cache(maxsize=64)
def _run_kernel(
    body: LoopBody, ends: Ends, shared: tuple[bool, ...], most: int
) -> Kernel:
    step, around = _unrolled_run(body, ends, shared, most)
    return run_kernel(step, around, _width(body))


def _width(body: LoopBody) -> int:
    """Number of the carry's widest floats per vector register, at least 2."""
    sizes = [aval.dtype.itemsize for aval in chosen(body.avals, body.floating)] or [4]
    return max(vector_bytes() // max(sizes), 2)


def _unrolled_step(
    body: LoopBody, shared: tuple[bool, ...], most: int
) -> tuple[Step, Unroller, list[Any]]:
    """Unrolls a step to a graph of operations on single numbers.

    Args:
        body: The step.
        shared: Whether each constant is the same for all rods.
        most: Largest number of graph nodes.

    Returns:
        The step as a graph, its unroller, and the nodes of its operands.

    Raises:
        NotUnrolled: The step cannot be unrolled, or has more than `most` nodes.
    """
    graph = Graph()
    unroller = Unroller(graph, most)
    inputs, entries = [], []
    for i, aval in enumerate(operand_types(body.closed)):
        rate = VARYING
        if i < body.n_constants:
            rate = UNIFORM if shared[i] else FIXED
        kind = kind_of(aval)
        inputs.append(graph.inputs(i, aval.shape, kind, rate))
        entries.append(Entries(kind, inputs[-1].size, rate))
    made = unroller.run(body.closed, inputs)
    outputs = [array.reshape(-1).tolist() for array in made]
    constants, carry = entries[: body.n_constants], entries[body.n_constants :]
    return Step(graph, constants, carry, outputs), unroller, inputs


def _unrolled_run(
    body: LoopBody, ends: Ends, shared: tuple[bool, ...], most: int
) -> tuple[Step, EndNodes]:
    """Unrolls a step, and the beginning and end of a run, into one graph.

    Args:
        body: The step.
        ends: Beginning and end of the run.
        shared: Whether each constant is the same for all rods.
        most: Largest number of nodes in the graph.

    Raises:
        NotUnrolled: The run cannot be unrolled, or has more than `most` nodes.
    """
    step, unroller, inputs = _unrolled_step(body, shared, most)
    graph, n = step.graph, body.n_constants
    avals = ends.given[n:]
    first = len(inputs)
    given = [
        graph.inputs(first + i, aval.shape, kind_of(aval), VARYING)
        for i, aval in enumerate(avals)
    ]
    begun = unroller.run(ends.begin, [*inputs[:n], *given])
    ended = unroller.run(ends.end, inputs)
    return step, EndNodes(
        [_entries_of(aval) for aval in avals],
        [array.reshape(-1).tolist() for array in begun],
        [_entries_of(aval) for aval in ends.made],
        [array.reshape(-1).tolist() for array in ended],
    )


def _entries_of(aval: Any) -> Entries:
    """Returns number type and size of an array, marked as changing at every step."""
    return Entries(kind_of(aval), math.prod(aval.shape), VARYING)
