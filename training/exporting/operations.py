"""Elementwise operations of exported programs, in one table for all writers.

Each entry has a C expression in the operands `a`, `b`, `c`, and an ONNX operator or a
function that combines several ONNX operators.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Operation:
    """An elementwise operation, in each of the exported formats."""

    c: str
    """C99 expression of one result number, in the operands `a`, `b`, `c`."""
    onnx: str | Callable[..., str]
    """Name of the ONNX operator, or a function `(graph, *operand names) -> result name`
    that adds several nodes."""
    kinds: str = "f"
    """Kinds of operands that are allowed: f floats, i integers, b booleans."""


def _negated(operator: str) -> Callable[..., str]:
    return lambda node, *names: node("Not", node(operator, *names))


def _expm1(node: Any, a: str) -> str:
    """Adds ONNX nodes for exp(a) - 1 as tanh(a / 2) (exp(a) + 1), accurate near 0."""
    half = node("Tanh", node("Mul", a, node.number(0.5)))
    return node("Mul", half, node("Add", node("Exp", a), node.number(1)))


# If a or b is NaN, both comparisons are false, and a + b is NaN.
_LARGER = "a >= b ? a : a < b ? b : a + b"
_SMALLER = "a <= b ? a : a > b ? b : a + b"

OPERATIONS = {
    "add": Operation("a + b", "Add", "fi"),
    "sub": Operation("a - b", "Sub", "fi"),
    "mul": Operation("a * b", "Mul", "fi"),
    "div": Operation("a / b", "Div"),
    "max": Operation(_LARGER, "Max", "fi"),
    "min": Operation(_SMALLER, "Min", "fi"),
    "neg": Operation("-a", "Neg", "fi"),
    "abs": Operation("a < 0 ? -a : a", "Abs", "fi"),
    "floor": Operation("floorf(a)", "Floor"),
    "ceil": Operation("ceilf(a)", "Ceil"),
    "sqrt": Operation("sqrtf(a)", "Sqrt"),
    "exp": Operation("expf(a)", "Exp"),
    "expm1": Operation("expm1f(a)", _expm1),
    "log": Operation("logf(a)", "Log"),
    "log1p": Operation(
        "log1pf(a)", lambda node, a: node("Log", node("Add", a, node.number(1)))
    ),
    "pow": Operation("powf(a, b)", "Pow"),
    "erf": Operation("erff(a)", "Erf"),
    "erfc": Operation(
        "erfcf(a)", lambda node, a: node("Sub", node.number(1), node("Erf", a))
    ),
    **{
        name: Operation(f"{name}f(a)", name.capitalize())
        for name in (
            *("sin", "cos", "tan", "asin", "acos", "atan"),
            *("sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
        )
    },
    "eq": Operation("a == b", "Equal", "fib"),
    "ne": Operation("a != b", _negated("Equal"), "fib"),
    "lt": Operation("a < b", "Less", "fi"),
    "le": Operation("a <= b", "LessOrEqual", "fi"),
    "gt": Operation("a > b", "Greater", "fi"),
    "ge": Operation("a >= b", "GreaterOrEqual", "fi"),
    "and": Operation("a && b", "And", "b"),
    "or": Operation("a || b", "Or", "b"),
    "not": Operation("!a", "Not", "b"),
    "select": Operation("a ? b : c", "Where", "fib"),
    "to float": Operation("(float)a", lambda node, a: node.cast(a, "f"), "fib"),
    "to integer": Operation("(long)a", lambda node, a: node.cast(a, "i"), "fib"),
    "to boolean": Operation("a != 0", lambda node, a: node.cast(a, "b"), "fib"),
}
"""All operations by name; those named like a JAX primitive compute that primitive."""
