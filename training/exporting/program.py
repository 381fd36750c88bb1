"""Programs of three kinds of steps on flat arrays, which every writer understands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

KINDS = {"float32": "f", "int32": "i", "bool": "b"}
"""Kinds of numbers by name of their dtype."""


@dataclass(frozen=True, eq=False)
class Buffer:
    """A flat array: an input, a constant, or the result of a step."""

    size: int
    dtype: Any
    data: np.ndarray | None = None
    """Numbers of a constant; `None` for what is only known at run time."""

    @property
    def kind(self) -> str:
        """Kind of the numbers, a value of `KINDS`.

        Raises:
            ValueError: There are no such numbers in an exported program.
        """
        if str(self.dtype) not in KINDS:
            raise ValueError(
                "the policy cannot be exported: it computes with numbers of type "
                f"{self.dtype}, and a controller has {', '.join(KINDS)}"
            )
        return KINDS[str(self.dtype)]


@dataclass(frozen=True, eq=False)
class Value:
    """An array of any shape whose numbers lie somewhere in a buffer."""

    buffer: Buffer
    places: np.ndarray
    """Index into the buffer, for every number of the array."""

    @property
    def known(self) -> bool:
        """Whether the numbers are constants."""
        return self.buffer.data is not None

    @property
    def numbers(self) -> np.ndarray:
        """The numbers of a constant."""
        assert self.buffer.data is not None
        return self.buffer.data[self.places]

    @property
    def uniform(self) -> bool:
        """Whether all numbers are one constant."""
        if not self.known or not self.places.size:
            return False
        numbers = self.numbers.ravel()
        bits = numbers.view(f"u{numbers.itemsize}")  # zeros have a sign
        return bool(np.all(bits == bits[0]))

    @property
    def whole(self) -> bool:
        """Whether these are all numbers of the buffer, in their order."""
        return self.places.size == self.buffer.size and self.stride == (0, 1)

    @property
    def stride(self) -> tuple[int, int] | None:
        """First place and distance of neighbours, if the distance is constant."""
        places = self.places.ravel()
        apart = np.diff(places)
        if apart.size and np.any(apart != apart[0]):
            return None
        return int(places[0]), int(apart[0]) if apart.size else 1


class Writer(Protocol):
    """Writes the steps of a program in one format."""

    def each(self, step: Each) -> None:
        """Writes an operation on every number."""

    def product(self, step: Product) -> None:
        """Writes a product of matrices."""

    def join(self, step: Join) -> None:
        """Writes the copy of several arrays into one."""


@dataclass(frozen=True, eq=False)
class Each:
    """An operation on the numbers of its operands, one by one."""

    out: Buffer
    operands: tuple[Value, ...]
    operation: str
    """Name in `jaxrod.training.exporting.operations.OPERATIONS`."""

    def write(self, writer: Writer) -> None:
        """Has itself written."""
        writer.each(self)


@dataclass(frozen=True, eq=False)
class Product:
    """Products of matrices, (batch, m, k) times (batch, k, n).

    Both operands are whole buffers.
    """

    out: Buffer
    operands: tuple[Value, ...]
    sizes: tuple[int, int, int, int]
    """Batch, m, k, n."""

    def write(self, writer: Writer) -> None:
        """Has itself written."""
        writer.product(self)


@dataclass(frozen=True, eq=False)
class Join:
    """A copy of the numbers of its operands, one operand after the other."""

    out: Buffer
    operands: tuple[Value, ...]

    def write(self, writer: Writer) -> None:
        """Has itself written."""
        writer.join(self)


Step = Each | Product | Join


@dataclass(frozen=True)
class Program:
    """A function from arrays to arrays."""

    inputs: tuple[Buffer, ...]
    steps: tuple[Step, ...]
    results: tuple[Value, ...]

    def operands(self) -> Iterator[Value]:
        """Yields everything that is read."""
        for step in self.steps:
            yield from step.operands
        yield from self.results
