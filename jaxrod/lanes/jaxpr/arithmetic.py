"""Rules by which elementwise primitives become operations on single numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxrod.lanes.graph import DTYPES, OPERATIONS
from jaxrod.lanes.jaxpr.unroll import NotUnrolled, Unroller, kind_of, rule


@rule(*(name for name, operation in OPERATIONS.items() if operation.primitive))
def same(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates a primitive such as `add` to the operation of the same name.

    It is applied entry by entry.
    """
    name, kind = equation.primitive.name, kind_of(equation.outvars[0].aval)
    if kind[0] not in OPERATIONS[name].kinds:
        raise NotUnrolled(f"lanes have no '{name}' of numbers of type {DTYPES[kind]}")
    return unroller.each(name, kind, *arrays)


@rule("add_any")
def added(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates `add_any`, the sum of two cotangents."""
    return unroller.each("add", kind_of(equation.outvars[0].aval), *arrays)


@rule(*(name for name, operation in OPERATIONS.items() if operation.compares))
def compared(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates a comparison of two arrays of one type; the results are booleans."""
    return unroller.each(equation.primitive.name, "b1", *arrays)


@rule("square")
def squared(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates a square, as the product of each number with itself."""
    return unroller.each("mul", kind_of(equation.outvars[0].aval), array, array)


@rule("one_minus_square")
def one_minus_squared(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `(1 + x) (1 - x)`, which derivatives contain since JAX 0.12."""
    kind = kind_of(equation.outvars[0].aval)
    one = unroller.full(1, array.shape, kind)
    above = unroller.each("add", kind, one, array)
    return unroller.each("mul", kind, above, unroller.each("sub", kind, one, array))


@rule("integer_pow")
def powered(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates an integer power, by repeated squaring."""
    kind = kind_of(equation.outvars[0].aval)
    exponent = equation.params["y"]
    result = None
    square, left = array, abs(exponent)
    while left:
        if left & 1:
            result = (
                square if result is None else unroller.each("mul", kind, result, square)
            )
        left >>= 1
        if left:
            square = unroller.each("mul", kind, square, square)
    one = unroller.full(1, array.shape, kind)
    if result is None:
        return one
    return result if exponent > 0 else unroller.each("div", kind, one, result)


@rule("sign")
def sign(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `sign`: -1, 0 or 1; a zero and NaN are returned unchanged."""
    graph, kind = unroller.graph, kind_of(equation.outvars[0].aval)
    zero = graph.constant(0, kind)
    if kind[0] not in "fi":
        raise NotUnrolled(f"lanes have no sign of numbers of type {DTYPES[kind]}")

    def of(number: int) -> int:
        above = graph.add("gt", (number, zero), "b1")
        below = graph.add("lt", (number, zero), "b1")
        least = graph.constant(-1, kind)
        rest = graph.add("select", (below, least, number), kind)
        return graph.add("select", (above, graph.constant(1, kind), rest), kind)

    return unroller.mapped(of, kind, array)


@rule("logistic")
def logistic(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates the logistic function, 1 / (1 + exp(-x))."""
    graph, kind = unroller.graph, kind_of(equation.outvars[0].aval)
    one = graph.constant(1, kind)

    def of(number: int) -> int:
        decay = graph.add("exp", (graph.add("neg", (number,), kind),), kind)
        return graph.add("div", (one, graph.add("add", (one, decay), kind)), kind)

    return unroller.mapped(of, kind, array)


@rule("round")
def rounded(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `round`: to the nearest integer, halves to even or away from zero."""
    to_even = equation.params["rounding_method"].value == 1
    operation = "round_even" if to_even else "round_away"
    return unroller.each(operation, kind_of(equation.outvars[0].aval), array)


@rule("is_finite")
def is_finite(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `is_finite`: true for numbers that are neither infinite nor NaN."""
    kind = kind_of(equation.invars[0].aval)
    size = unroller.each("abs", kind, array)
    return unroller.each("lt", "b1", size, unroller.full(np.inf, array.shape, kind))


@rule("clamp")
def clamped(unroller: Unroller, equation: Any, low: Any, array: Any, high: Any) -> Any:
    """Translates `clamp`: min(max(low, x), high)."""
    kind = kind_of(equation.outvars[0].aval)
    return unroller.each("min", kind, unroller.each("max", kind, low, array), high)


@rule("select_n")
def selected(unroller: Unroller, equation: Any, which: Any, *cases: Any) -> Any:
    """Translates `select_n`, which takes case number `which` for each entry."""
    kind = kind_of(equation.outvars[0].aval)
    if kind_of(equation.invars[0].aval) == "b1":
        return unroller.each("select", kind, which, cases[1], cases[0])
    index_kind = kind_of(equation.invars[0].aval)
    result = cases[0]
    for i, case in enumerate(cases[1:], 1):
        number = unroller.full(i, (), index_kind)
        chosen = unroller.each("eq", "b1", which, number)
        result = unroller.each("select", kind, chosen, case, result)
    return result


@rule("convert_element_type")
def converted(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates the conversion of numbers to another type."""
    before = kind_of(equation.invars[0].aval)
    return as_kind(unroller, array, before, kind_of(equation.outvars[0].aval))


def as_kind(unroller: Unroller, array: Any, before: str, after: str) -> Any:
    """Converts numbers of type `before`, such as `"f32"`, to type `after`.

    If `after` is boolean (`"b1"`), nonzero numbers become true.
    """
    if before == after:
        return array
    if after == "b1":
        zero = unroller.full(0, array.shape, before)
        return unroller.each("ne", "b1", array, zero)
    return unroller.each("convert", after, array)


@rule("copy", "stop_gradient", "optimization_barrier", "pvary", "reshard")
def unchanged(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Returns the operands of a primitive that does not change numbers."""
    return list(arrays)
