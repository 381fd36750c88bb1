"""Rules by which reductions and matrix products become single operations."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxrod.lanes.jaxpr.arithmetic import as_kind
from jaxrod.lanes.jaxpr.unroll import NotUnrolled, Unroller, kind_of, rule

REDUCTIONS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "reduce_xor": "xor",
}
"""Operation of the graph that combines two numbers, by name of the reduction."""
CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
"""Operation of the graph that combines two numbers, by name of the cumulative
primitive."""
_OF_NOTHING = {"add": 0, "mul": 1, "max": -np.inf, "min": np.inf, "and": 1, "or": 0}


@rule(*REDUCTIONS)
def reduced(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates a reduction along axes by combining halves with halves.

    So round-off grows only with the logarithm of the number of entries, and there is no
    long chain of dependent operations.
    """
    graph, kind = unroller.graph, kind_of(equation.outvars[0].aval)
    operation = REDUCTIONS[equation.primitive.name]
    axes = tuple(equation.params["axes"])
    kept = [axis for axis in range(array.ndim) if axis not in axes]
    rows = np.transpose(array, (*axes, *kept))
    rows = rows.reshape(-1, *[array.shape[axis] for axis in kept])
    if not len(rows):
        if kind[0] != "f" and operation in ("max", "min"):
            raise NotUnrolled(f"lanes have no {equation.primitive.name} of nothing")
        none = graph.constant(_OF_NOTHING[operation], kind)
        return np.full(rows.shape[1:], none, np.int64)
    while len(rows) > 1:
        half = len(rows) // 2
        joined = graph.each(operation, kind, rows[:half], rows[half : 2 * half])
        rows = np.concatenate([joined, rows[2 * half :]])
    return rows[0]


@rule(*CUMULATIVE)
def accumulated(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates a cumulative operation such as `cumsum`, from either end."""
    kind = kind_of(equation.outvars[0].aval)
    operation = CUMULATIVE[equation.primitive.name]
    rows = np.moveaxis(array, equation.params["axis"], 0)
    backwards = equation.params["reverse"]
    rows = rows[::-1] if backwards else rows
    made: list[Any] = []
    for row in rows:
        last = made[-1] if made else None
        joined = (
            row if last is None else unroller.graph.each(operation, kind, last, row)
        )
        made.append(joined)
    result = np.stack(made) if made else rows
    result = result[::-1] if backwards else result
    return np.moveaxis(result, 0, equation.params["axis"])


@rule("argmax", "argmin")
def place_of_extreme(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `argmax` or `argmin`: index of the first largest or smallest entry.

    The first NaN counts as largest and smallest, as in JAX.
    """
    graph = unroller.graph
    kind, index_kind = (
        kind_of(equation.invars[0].aval),
        kind_of(equation.outvars[0].aval),
    )
    (axis,) = equation.params["axes"]
    better = "gt" if equation.primitive.name == "argmax" else "lt"
    rows = np.moveaxis(array, axis, 0)
    best = rows[0]
    place = np.full(best.shape, graph.constant(0, index_kind), np.int64)
    for i, row in enumerate(rows[1:], 1):
        beats = graph.each(better, "b1", row, best)
        if kind[0] == "f":
            # The first NaN wins, as in JAX.
            odd = graph.each("ne", "b1", row, row)
            fine = graph.each("eq", "b1", best, best)
            beats = graph.each("or", "b1", beats, graph.each("and", "b1", odd, fine))
        number = np.full(best.shape, graph.constant(i, index_kind), np.int64)
        place = graph.each("select", index_kind, beats, number, place)
        best = graph.each("select", kind, beats, row, best)
    return place


@rule("dot_general")
def product(unroller: Unroller, equation: Any, left: Any, right: Any) -> Any:
    """Translates `dot_general`: sums of products, such as matrix products."""
    graph = unroller.graph
    kind = kind_of(equation.outvars[0].aval)
    (sum_left, sum_right), (batch_left, batch_right) = equation.params[
        "dimension_numbers"
    ]
    left = as_kind(unroller, left, kind_of(equation.invars[0].aval), kind)
    right = as_kind(unroller, right, kind_of(equation.invars[1].aval), kind)

    def arranged(array: Any, batch: Any, summed: Any) -> tuple[Any, tuple[int, ...]]:
        free = [i for i in range(array.ndim) if i not in (*batch, *summed)]
        ordered = np.transpose(array, (*batch, *free, *summed))
        lead = [array.shape[i] for i in batch]
        shape = tuple(array.shape[i] for i in free)
        size = int(np.prod(shape, dtype=int))
        return ordered.reshape(int(np.prod(lead, dtype=int)), size, -1), shape

    a, free_left = arranged(left, batch_left, sum_left)
    b, free_right = arranged(right, batch_right, sum_right)
    terms = graph.each("mul", kind, a[:, :, None, :], b[:, None, :, :])
    total = np.full(terms.shape[:-1], graph.constant(0, kind), np.int64)
    for i in range(terms.shape[-1]):
        total = graph.each("add", kind, total, terms[..., i])
    lead = tuple(left.shape[i] for i in batch_left)
    return total.reshape(*lead, *free_left, *free_right)
