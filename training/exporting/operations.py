"""Elementwise operations of exported programs, in one table for all writers.

A row gives the operation as a C expression in `a`, `b`, `c` and as an ONNX operator, or
as a function that makes it of several.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Operation:
    """An operation on single numbers."""

    c: str
    """Expression in C99."""
    onnx: str | Callable[..., str]
    """Operator, or a function of a node maker and the names of the operands."""
    kinds: str = "f"
    """Kinds of operands that it takes: floats, integers, booleans."""


def _negated(operator: str) -> Callable[..., str]:
    return lambda node, *names: node("Not", node(operator, *names))


def _expm1(node: Any, a: str) -> str:
    """Accurate for small numbers: tanh(x / 2) (exp(x) + 1)."""
    half = node("Tanh", node("Mul", a, node.number(0.5)))
    return node("Mul", half, node("Add", node("Exp", a), node.number(1)))


# A number that is not one makes both comparisons false, and the sum not a number.
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
"""All operations. Names of JAX primitives stand for these."""
