"""Exported programs: lists of elementwise operations, matrix products and copies.

All data lie in flat arrays (`Buffer`). A `Value` is an array of any shape whose entries
are entries of one buffer.
"""

from __future__ import annotations

from collections.abc import Iterator
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
    """Content of a constant; `None` for an input or the result of a step."""

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
    """Index into the buffer of every entry; its shape is the shape of the array."""

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
    """Name of the operation in `jaxrod.training.exporting.operations.OPERATIONS`."""

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
    """Sizes (batch, m, k, n)."""

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
