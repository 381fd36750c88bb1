"""Runs for GPUs: all steps of a block of rods in one launch, a rod in each thread.

A row of numbers holds one entry of all rods, so that neighbouring threads read
neighbouring numbers. What changes from step to step stays in memory, in two sets of rows
that are read and written in turn: a rod has more numbers than a thread has registers.
What all rods share is worked out by a kernel of its own, before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxrod.lanes.cycle import Plan
from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING
from jaxrod.lanes.kernel import Entries
from jaxrod.lanes.pallas_code import (
    Values,
    from_memory,
    refused_on_gpu,
    to_memory,
    type_in_memory,
)
from jaxrod.lanes.pallas_layout import Layout, Place, layout_of_plan

BLOCK = 32
"""Rods of a block: the threads of one warp, so that each has one rod, and the same one
in everything it loads and stores. Not tuned on a GPU."""

_Refs = Mapping[tuple[str, str], Any]


def pallas_program(plan: Plan, rods: int, *, interpret: bool) -> Callable[..., Any]:
    """The program of a run, or of cycles, as a kernel for GPUs.

    Args:
        plan: The structure of the operation; it keeps no carries on the way.
        rods: Of the batch.
        interpret: Whether JAX works out what the kernel does instead of compiling it.

    Returns:
        A function of the number of steps and of the operands of the operation.

    Raises:
        NotUnrolled: If it cannot be done.
    """
    n, layout = plan.cycle.n_constants, layout_of_plan(plan)
    if not interpret:
        refused_on_gpu(layout.step.graph, layout.used)
    columns = -(-rods // BLOCK) * BLOCK
    first_given = n + len(layout.step.carry)

    def program(steps: Any, *arrays: Any) -> list[Any]:
        constants, given = arrays[:n], arrays[n:]
        if plan.batch is None:
            given = tuple(array[None] for array in given)
        operands = {**dict(enumerate(constants)), **dict(enumerate(given, first_given))}
        numbers = [
            jnp.concatenate([_typed(a, e).reshape(-1) for a, e in parts])
            for parts in _parts(layout, "numbers", operands)
        ]
        rows = [
            _rows([_typed(a, e) for a, e in parts], columns)
            for region in ("own", "given")
            for parts in _parts(layout, region, operands)
        ]
        derived = _derived(layout, numbers, interpret)
        count = jnp.asarray(steps, jnp.int32).reshape(1)
        made = _run(layout, columns, interpret)(count, *numbers, *derived, *rows)
        results = _results(layout, plan, made, rods)
        return results if plan.batch else [result[0] for result in results]

    return program


# Arrays and rows ------------------------------------------------------------------


def _parts(
    layout: Layout, region: str, operands: Mapping[int, Any]
) -> list[list[tuple[Any, Entries]]]:
    """Operands that make up the arrays of a region."""
    parts: dict[str, list[tuple[Any, Entries]]] = {
        dtype: [] for dtype in layout.rows[region]
    }
    for which, (where, dtype, _) in layout.arrays.items():
        if where == region:
            parts[dtype].append((operands[which], layout.entries[which]))
    return list(parts.values())


def _typed(array: Any, entries: Entries) -> Any:
    return lax.convert_element_type(array, type_in_memory(entries.kind))


def _rows(arrays: Sequence[Any], columns: int) -> Any:
    """Entries of rods as rows; the last rod is repeated until the block is full."""
    rows = jnp.concatenate([a.reshape(a.shape[0], -1).T for a in arrays])
    missing = columns - rows.shape[1]
    if not missing:
        return rows
    last = jnp.broadcast_to(rows[:, -1:], (rows.shape[0], missing))
    return jnp.concatenate([rows, last], axis=1)


def _results(
    layout: Layout, plan: Plan, made: Mapping[str, Any], rods: int
) -> list[Any]:
    """Rows as entries of rods."""
    avals = plan.ends.made if plan.ends is not None else plan.cycle.avals
    results = []
    for aval, entries, (dtype, first) in zip(
        avals, layout.ends.made, layout.made, strict=True
    ):
        rows = (
            made[dtype][first : first + entries.size, :rods]
            if entries.size
            else jnp.zeros((0, rods), dtype)
        )
        array = from_memory(rows, entries.kind).T.reshape(rods, *aval.shape)
        results.append(array)
    return results


# Kernels --------------------------------------------------------------------------


def _derived(layout: Layout, numbers: Sequence[Any], interpret: bool) -> list[Any]:
    """What is worked out of numbers that all rods share."""
    names = layout.names("derived")
    if not names:
        return []
    inputs = layout.names("numbers")

    def kernel(*refs: Any) -> None:
        places = dict(zip([*inputs, *names], refs, strict=True))
        goals = [(node, _store(layout, places, node)) for node in layout.derived]
        Values(layout.step.graph, (), _load(layout, places)).work_out(goals, UNIFORM)

    shapes = [_shape(layout, name) for name in names]
    return list(_call(kernel, interpret, out_shape=shapes, grid=(1,))(*numbers))


def _run(
    layout: Layout, columns: int, interpret: bool
) -> Callable[..., Mapping[str, Any]]:
    """The kernel of all steps: rows to rows, by their type."""
    from jax.experimental import pallas as pl

    shared = [*layout.names("numbers"), *layout.names("derived")]
    given = [*layout.names("own"), *layout.names("given")]
    outputs = [name for r in ("fixed", "carry", "made") for name in layout.names(r)]

    def kernel(steps: Any, *refs: Any) -> None:
        places = dict(zip([*shared, *given, *outputs], refs, strict=True))
        _steps(layout, places, steps[0])

    def block(name: tuple[str, str]) -> Any:
        *rows, _ = _shape(layout, name, columns).shape
        return pl.BlockSpec((*rows, BLOCK), lambda i: (*(0 for _ in rows), i))

    def whole(size: int) -> Any:
        return pl.BlockSpec((size,), lambda i: (0,))

    call = _call(
        kernel,
        interpret,
        out_shape=[_shape(layout, name, columns) for name in outputs],
        grid=(columns // BLOCK,),
        in_specs=[
            whole(1),
            *[whole(_shape(layout, name).shape[0]) for name in shared],
            *[block(name) for name in given],
        ],
        out_specs=[block(name) for name in outputs],
    )

    def run(*arrays: Any) -> Mapping[str, Any]:
        made = dict(zip(outputs, call(*arrays), strict=True))
        return {dtype: made[region, dtype] for region, dtype in layout.names("made")}

    return run


def _steps(layout: Layout, refs: _Refs, steps: Any) -> None:
    """What one block does: what does not change, the first carry, steps, the end."""
    graph, step, ends = layout.step.graph, layout.step, layout.ends
    zero = jnp.int32(0)

    def work(goals: Iterable[Any], rate: int, now: Any) -> None:
        Values(graph, (BLOCK,), _load(layout, refs, now)).work_out(goals, rate)

    def to_carry(outputs: Sequence[Sequence[int]], then: Any) -> list[Any]:
        first = len(step.constants)
        return [
            (node, _store(layout, refs, node, _after(layout, first + i, k), then))
            for i, k, node in _neighbours_together(outputs)
        ]

    work([(n, _store(layout, refs, n)) for n in layout.fixed], FIXED, zero)
    work(to_carry(ends.begun, zero), VARYING, zero)

    def once(i: Any, nothing: tuple[()]) -> tuple[()]:
        now = lax.rem(i, jnp.int32(2))
        work(to_carry(step.outputs, 1 - now), VARYING, now)
        return nothing

    lax.fori_loop(zero, steps, once, ())
    # Of a negative count there is no step.
    last = lax.rem(lax.max(steps, zero), jnp.int32(2))
    goals = [
        (node, _store(layout, refs, node, ("made", dtype, first + k)))
        for i, k, node in _neighbours_together(ends.ended)
        for dtype, first in [layout.made[i]]
    ]
    work(goals, VARYING, last)


def _neighbours_together(
    outputs: Sequence[Sequence[int]],
) -> list[tuple[int, int, int]]:
    """Array, entry and node of all outputs, element after element of the rod."""
    ordered = [
        (k / len(nodes), i, k, node)
        for i, nodes in enumerate(outputs)
        for k, node in enumerate(nodes)
    ]
    return [place[1:] for place in sorted(ordered, key=lambda place: place[0])]


def _after(layout: Layout, which: int, entry: int) -> Place:
    region, dtype, first = layout.arrays[which]
    return region, dtype, first + entry


def _load(layout: Layout, refs: _Refs, now: Any = None) -> Callable[[int], Any]:
    """What brings a node from memory; the carry from one of its two sets of rows."""

    def load(node: int) -> Any:
        region, dtype, row = layout.where(node)
        ref = refs[region, dtype]
        if region in ("numbers", "derived"):
            found = ref[row]
        else:
            found = ref[now, row, :] if region == "carry" else ref[row, :]
        return from_memory(found, layout.step.graph.kinds[node])

    return load


def _store(
    layout: Layout,
    refs: _Refs,
    node: int,
    place: Place | None = None,
    then: Any = None,
) -> Callable[[Any], None]:
    """What takes the value of a node to its place, or to another."""
    region, dtype, row = place or layout.nodes[node]
    ref, kind = refs[region, dtype], layout.step.graph.kinds[node]

    def store(value: Any) -> None:
        value = to_memory(value, kind)
        if region == "derived":
            ref[row] = value
        elif region == "carry":
            ref[then, row, :] = value
        else:
            ref[row, :] = value

    return store


def _shape(
    layout: Layout, name: tuple[str, str], columns: int | None = None
) -> jax.ShapeDtypeStruct:
    """Of an array in memory."""
    region, dtype = name
    shape: tuple[int, ...] = (layout.rows[region][dtype],)
    if columns is not None:
        shape = (*((2,) if region == "carry" else ()), *shape, columns)
    return jax.ShapeDtypeStruct(shape, np.dtype(dtype))


def _call(kernel: Callable[..., None], interpret: bool, **how: Any) -> Any:
    from jax.experimental import pallas as pl

    if interpret:
        return pl.pallas_call(kernel, interpret=True, **how)
    from jax.experimental.pallas import triton

    # One stage: loads of a step must not be moved before the stores of the one before.
    params = triton.CompilerParams(num_warps=BLOCK // 32, num_stages=1)
    return pl.pallas_call(kernel, compiler_params=params, **how)
