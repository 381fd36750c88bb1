"""Runs on GPUs: all steps of a block of rods in one launch, a rod in each thread.

A value is a vector with a number for every rod of the block. The carry passes from step
to step as such vectors, and the compiler decides which of them stay in registers.
Values that all rods share are computed before by a separate kernel, and read as single
numbers.

The time of Triton's compiler grows as the number of loaded and stored vectors times the
square of the program's length. So the numbers of rods are loaded and stored in tiles of
many numbers, which are split into vectors and joined from them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from jaxrod.lanes.cycle import Plan
from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING
from jaxrod.lanes.pallas_code import Values, refused_on_gpu, to_memory
from jaxrod.lanes.pallas_layout import Layout, layout_of_plan
from jaxrod.lanes.pallas_memory import (
    BLOCK,
    Refs,
    given_columns,
    numbers_of,
    results_of,
    rows_of,
    shape_of,
    shared_numbers,
    store_columns,
)


def pallas_program(plan: Plan, rods: int, *, interpret: bool) -> Callable[..., Any]:
    """Makes the program of a run, or of cycles, as a kernel for GPUs.

    Args:
        plan: Structure of the operation, without checkpoints.
        rods: Number of rods in the batch.
        interpret: Whether JAX interprets the kernel instead of compiling it.

    Returns:
        A function of the number of steps and of the operands of the operation.

    Raises:
        NotUnrolled: The program cannot be unrolled, or not for a GPU.
    """
    n, layout = plan.cycle.n_constants, layout_of_plan(plan)
    if not interpret:
        refused_on_gpu(layout.step.graph, layout.used)
    padded = -(-rods // BLOCK) * BLOCK
    first_given = n + len(layout.step.carry)

    def program(steps: Any, *arrays: Any) -> list[Any]:
        constants, given = arrays[:n], arrays[n:]
        if plan.batch is None:
            given = tuple(array[None] for array in given)
        operands = {**dict(enumerate(constants)), **dict(enumerate(given, first_given))}
        numbers = numbers_of(layout, operands)
        rows = rows_of(layout, operands, padded)
        derived = _derived(layout, numbers, interpret)
        count = jnp.asarray(steps, jnp.int32).reshape(1)
        made = _run(layout, padded, interpret)(count, *numbers, *derived, *rows)
        results = results_of(layout, plan, made, rods)
        return results if plan.batch else [result[0] for result in results]

    return program


def _derived(layout: Layout, numbers: Sequence[Any], interpret: bool) -> list[Any]:
    """Computes the loop-invariant values that all rods share, by a kernel."""
    names, inputs = layout.names("derived"), layout.names("numbers")
    if not names:
        return []

    def kernel(*arrays: Any) -> None:
        refs = dict(zip([*inputs, *names], arrays, strict=True))

        def store(node: int, value: Any) -> None:
            region, dtype, which = layout.nodes[node]
            refs[region, dtype][which] = to_memory(value, layout.step.graph.kinds[node])

        values = Values(layout.step.graph, (), shared_numbers(layout, refs))
        values.work_out(layout.derived, UNIFORM, store)

    shapes = [shape_of(layout, name) for name in names]
    return list(_call(kernel, interpret, out_shape=shapes, grid=(1,))(*numbers))


def _run(
    layout: Layout, padded: int, interpret: bool
) -> Callable[..., Mapping[str, Any]]:
    """Returns the kernel of all steps; its results are rows by dtype."""
    shared = [*layout.names("numbers"), *layout.names("derived")]
    given = [*layout.names("own"), *layout.names("given")]
    made = layout.names("made")

    def kernel(steps: Any, *arrays: Any) -> None:
        refs = dict(zip([*shared, *given, *made], arrays, strict=True))
        _steps(layout, refs, steps[0])

    def block(name: tuple[str, str]) -> Any:
        return pl.BlockSpec(
            (BLOCK, shape_of(layout, name, padded).shape[1]), lambda i: (i, 0)
        )

    def whole(size: int) -> Any:
        return pl.BlockSpec((size,), lambda i: (0,))

    call = _call(
        kernel,
        interpret,
        out_shape=[shape_of(layout, name, padded) for name in made],
        grid=(padded // BLOCK,),
        in_specs=[
            whole(1),
            *[whole(shape_of(layout, name).shape[0]) for name in shared],
            *[block(name) for name in given],
        ],
        out_specs=[block(name) for name in made],
    )

    def run(*arrays: Any) -> Mapping[str, Any]:
        rows = call(*arrays)
        return {dtype: r for (_, dtype), r in zip(made, rows, strict=True)}

    return run


def _steps(layout: Layout, refs: Refs, steps: Any) -> None:
    """Computes one block: loop-invariant values, the first carry, steps, the end."""
    graph, step, ends = layout.step.graph, layout.step, layout.ends
    numbers = shared_numbers(layout, refs)
    known = given_columns(layout, refs)

    def worked_out(nodes: Sequence[int], rate: int, more: dict[int, Any]) -> list[Any]:
        values = Values(graph, (BLOCK,), numbers, {**known, **more})
        found: dict[int, Any] = {}
        values.work_out(nodes, rate, found.__setitem__)
        return [found[node] for node in nodes]

    known.update(zip(layout.fixed, worked_out(layout.fixed, FIXED, {}), strict=True))
    carried = _nodes_of_carry(layout)
    order = [(i, k) for i, k, _ in _neighbours_together(step.outputs)]
    inputs = [carried.get(place) for place in order]

    def taken(outputs: Sequence[Sequence[int]], now: dict[int, Any]) -> tuple[Any, ...]:
        return tuple(worked_out([outputs[i][k] for i, k in order], VARYING, now))

    def now(carry: tuple[Any, ...]) -> dict[int, Any]:
        pairs = zip(inputs, carry, strict=True)
        return {node: value for node, value in pairs if node is not None}

    last = lax.fori_loop(
        jnp.int32(0),
        steps,
        lambda _, carry: taken(step.outputs, now(carry)),
        taken(ends.begun, {}),
    )
    results = [(i, k, node) for i, k, node in _neighbours_together(ends.ended)]
    found = worked_out([node for _, _, node in results], VARYING, now(last))
    columns: dict[str, dict[int, Any]] = {dtype: {} for dtype in layout.sizes["made"]}
    for (i, k, node), value in zip(results, found, strict=True):
        dtype, first = layout.made[i]
        columns[dtype][first + k] = to_memory(value, graph.kinds[node])
    for dtype, values in columns.items():
        store_columns(refs["made", dtype], [values[k] for k in range(len(values))])


def _nodes_of_carry(layout: Layout) -> dict[tuple[int, int], int]:
    """Returns the used nodes of the carry, by array and entry."""
    graph, first = layout.step.graph, len(layout.step.constants)
    places = ((node, graph.places.get(node)) for node in layout.used)
    return {
        (place[0] - first, place[1]): node
        for node, place in places
        if place is not None and 0 <= place[0] - first < len(layout.step.carry)
    }


def _neighbours_together(
    outputs: Sequence[Sequence[int]],
) -> list[tuple[int, int, int]]:
    """Lists array, entry and node of all outputs, ordered along the rod."""
    ordered = [
        (k / len(nodes), i, k, node)
        for i, nodes in enumerate(outputs)
        for k, node in enumerate(nodes)
    ]
    return [place[1:] for place in sorted(ordered, key=lambda place: place[0])]


def _call(kernel: Callable[..., None], interpret: bool, **how: Any) -> Any:
    if interpret:
        return pl.pallas_call(kernel, interpret=True, **how)
    params = triton.CompilerParams(num_warps=BLOCK // 32, num_stages=1)
    return pl.pallas_call(kernel, compiler_params=params, **how)
