"""Exported programs: lists of elementwise operations, matrix products and copies.

All data are in flat arrays (`Buffer`). A `Value` is an array of any shape whose entries
are entries of one buffer. The elementwise operations are in one table for all writers.
Each entry has a C expression in the operands `a`, `b`, `c`, and an ONNX operator or a
function that combines several ONNX operators.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

KINDS = {"float32": "f", "int32": "i", "bool": "b"}
"""Kinds of numbers, f float, i integer, b boolean, by name of the dtype."""


@dataclass(frozen=True, eq=False)
class Buffer:
    """Flat array of a program: an input, a constant, or the result of a step."""

    size: int
    dtype: Any
    data: np.ndarray | None = None
    """Entries of a constant; `None` for an input or the result of a step."""

    @property
    def kind(self) -> str:
        """Kind of the numbers, a value of `KINDS`.

        Raises:
            ValueError: The dtype cannot be exported.
        """
        if str(self.dtype) not in KINDS:
            raise ValueError(
                "the policy cannot be exported: it computes with numbers of type "
                f"{self.dtype}, and a controller has {', '.join(KINDS)}"
            )
        return KINDS[str(self.dtype)]


@dataclass(frozen=True, eq=False)
class Value:
    """Array of any shape whose entries are entries of one buffer."""

    buffer: Buffer
    places: np.ndarray
    """Index of each entry in the buffer, in an array of the shape of the value."""

    @property
    def known(self) -> bool:
        """Whether the buffer is a constant."""
        return self.buffer.data is not None

    @property
    def numbers(self) -> np.ndarray:
        """Entries of a constant, in the shape of the array."""
        assert self.buffer.data is not None
        return self.buffer.data[self.places]

    @property
    def uniform(self) -> bool:
        """Whether all entries are one and the same constant, bit by bit."""
        if not self.known or not self.places.size:
            return False
        numbers = self.numbers.ravel()
        bits = numbers.view(f"u{numbers.itemsize}")  # zeros have a sign
        return bool(np.all(bits == bits[0]))

    @property
    def whole(self) -> bool:
        """Whether the array has all entries of the buffer, in the buffer's order."""
        return self.places.size == self.buffer.size and self.stride == (0, 1)

    @property
    def stride(self) -> tuple[int, int] | None:
        """First index and index step, in flat order; None if the step varies."""
        places = self.places.ravel()
        apart = np.diff(places)
        if apart.size and np.any(apart != apart[0]):
            return None
        return int(places[0]), int(apart[0]) if apart.size else 1


class Writer(Protocol):
    """Writes the steps of a program in one format, such as C."""

    def each(self, step: Each) -> None:
        """Writes an elementwise operation."""

    def product(self, step: Product) -> None:
        """Writes a matrix product."""

    def join(self, step: Join) -> None:
        """Writes a concatenation of flat arrays."""


@dataclass(frozen=True, eq=False)
class Each:
    """Step: an elementwise operation on operands of equal shape."""

    out: Buffer
    operands: tuple[Value, ...]
    operation: str
    """Name of the operation in `jaxrod.training.exporting.program.OPERATIONS`."""

    def write(self, writer: Writer) -> None:
        """Passes this step to the matching method of a writer."""
        writer.each(self)


@dataclass(frozen=True, eq=False)
class Product:
    """Step: matrix products, (batch, m, k) times (batch, k, n).

    Each operand has all entries of its buffer, in order.
    """

    out: Buffer
    operands: tuple[Value, ...]
    sizes: tuple[int, int, int, int]
    """Sizes (batch, m, k, n) of the products."""

    def write(self, writer: Writer) -> None:
        """Passes this step to the matching method of a writer."""
        writer.product(self)


@dataclass(frozen=True, eq=False)
class Join:
    """Step: concatenation of the flattened operands."""

    out: Buffer
    operands: tuple[Value, ...]

    def write(self, writer: Writer) -> None:
        """Passes this step to the matching method of a writer."""
        writer.join(self)


Step = Each | Product | Join


@dataclass(frozen=True)
class Program:
    """Function from input buffers to result arrays, as a list of steps."""

    inputs: tuple[Buffer, ...]
    steps: tuple[Step, ...]
    results: tuple[Value, ...]

    def operands(self) -> Iterator[Value]:
        """Yields the operands of all steps, then the results."""
        for step in self.steps:
            yield from step.operands
        yield from self.results


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
