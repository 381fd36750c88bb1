"""Graphs of rows: each node is a number, a row of numbers or a table.

The *dims* of a node are the lengths of the loops that compute it: none for a single
number, one for a row, two for a table. A single number can take the place of a row in
any operation. A *stored* node is an array in memory. Nodes that move numbers are

- `view`: reads a stored node at positions that are affine in the loop indices;
- `joined`: a stored node, put together from pieces;
- `gather`: reads a stored node at computed indices;
- `scatter`: a stored node into which numbers are combined at computed indices;
- `recurrence`: a stored node with the results of a loop along rows;
- `reduce`: a node reduced along some of its axes;
- `iota`: the index along an axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxrod.lanes.graph import Graph

Dims = tuple[int, ...]


@dataclass(frozen=True)
class Piece:
    """Flat indices in a stored node at which another node is written."""

    base: int
    """Flat index of the first position."""
    strides: Dims
    """Distance in the flat index between neighbours along each axis of the written
    node."""
    dims: Dims
    """Shape of the written node, the lengths of the loops that write it."""

    def places(self) -> np.ndarray:
        """Flat indices of all positions, in the order of the written node."""
        at = np.full(self.dims, self.base, np.int64)
        for axis, (length, stride) in enumerate(
            zip(self.dims, self.strides, strict=True)
        ):
            shape = [1] * len(self.dims)
            shape[axis] = length
            at = at + (np.arange(length) * stride).reshape(shape)
        return at.reshape(-1)


@dataclass(frozen=True)
class Move:
    """Path of one axis of a view through the array that the view reads."""

    axis: int | None
    """Axis of the array that is read; `None` if the view repeats its numbers."""
    step: int = 1
    """Increment of the index along that axis for each number of the view."""


class RowGraph(Graph):
    """Operations on numbers and rows, as numbered nodes in the order of creation."""

    def __init__(self) -> None:
        """Creates an empty graph."""
        super().__init__()
        self.dims: list[Dims] = []
        self.extras: dict[int, Any] = {}
        """Parameters of an operation by node, such as axes, pieces or strides."""
        self.data: dict[int, np.ndarray] = {}
        """Known numbers of arrays of constants, by node."""

    def _new(
        self, operation: str, arguments: tuple[int, ...], kind: str, rate: int
    ) -> int:
        dims: Dims = ()
        for argument in arguments:
            own = self.dims[argument]
            if own and dims and own != dims:
                raise AssertionError(f"{operation} of rows of {own} and {dims} numbers")
            dims = own or dims
        self.dims.append(dims)
        return super()._new(operation, arguments, kind, rate)

    def place(
        self,
        operation: str,
        arguments: tuple[int, ...],
        kind: str,
        dims: Dims,
        extra: Any,
        rate: int | None = None,
    ) -> int:
        """Returns the node of an operation that moves numbers, which may exist already.

        `dims` is the shape of its result, `kind` the type of the numbers, and `extra`
        has the parameters of the operation. The default rate of change is the highest
        rate among the arguments.
        """
        key = (operation, arguments, kind, dims, extra)
        node = self._known.get(key)
        if node is None:
            if rate is None:
                rate = max(1, *(self.rates[a] for a in arguments))
            node = super()._new(operation, arguments, kind, rate)
            self.dims.append(dims)
            self.extras[node] = extra
            self._known[key] = node
        return node

    def array(self, which: int, size: int, kind: str, rate: int) -> int:
        """Returns the node of input array number `which`, a row of numbers in memory.

        `kind` is the type of its numbers, such as `"f32"`, and `rate` its rate of
        change: `UNIFORM`, `FIXED` or `VARYING`.
        """
        node = self.place("input", (), kind, (size,), which, rate)
        self.places[node] = (which, 0)
        return node

    def known_array(self, numbers: np.ndarray, kind: str) -> int:
        """Returns the node of an array of known numbers, a row in memory.

        `kind` is the type of the numbers, such as `"f32"`.
        """
        flat = np.ascontiguousarray(numbers).reshape(-1)
        node = self.place("data", (), kind, (flat.size,), flat.tobytes(), 1)
        self.data[node] = flat
        return node

    def view(self, node: int, dims: Dims, base: int, strides: Dims) -> int:
        """Returns a node of shape `dims` that reads a stored node at regular positions.

        Entry (i, j, ...) is read at flat index base + i strides[0] + j strides[1] + ...
        """
        own = self.dims[node]
        if dims == own and base == 0 and strides == row_major(own):
            return node
        return self.place("view", (node,), self.kinds[node], dims, (base, strides))

    def taken(
        self, node: int, start: Sequence[int], moves: Sequence[Move], dims: Dims
    ) -> int:
        """Returns a node that reads another at regular indices along its axes.

        Its entry i along an axis with move (a, s) is read at index start[a] + s i of
        axis a.

        Args:
            node: Any node.
            start: First index along each axis of the node.
            moves: Path of each axis of the result through the node.
            dims: Lengths of the axes of the result.
        """
        own = self.dims[node]
        if not own:
            return node
        if self.operations[node] == "iota":
            return self._taken_index(node, start, moves, dims)
        if self.operations[node] == "view":
            (source,) = self.arguments[node]
            base, strides = self.extras[node]
        else:
            source, base, strides = node, 0, row_major(own)
        base += sum(s * stride for s, stride in zip(start, strides, strict=True))
        new = tuple(
            0 if move.axis is None else move.step * strides[move.axis] for move in moves
        )
        return self.view(source, dims, base, new)

    def _taken_index(
        self, node: int, start: Sequence[int], moves: Sequence[Move], dims: Dims
    ) -> int:
        axis, kind = self.extras[node], self.kinds[node]
        made = self.constant(start[axis], kind)
        for along, move in enumerate(moves):
            if move.axis == axis:
                index = self.iota(dims, along, kind)
                step = self.constant(move.step, kind)
                index = self.add("mul", (index, step), kind)
                made = self.add("add", (made, index), kind)
        return made

    def flat(self, node: int) -> tuple[int, int]:
        """Returns a stored node that has all numbers of a node in order, without gaps.

        Returns:
            The stored node, and the flat index in it at which the numbers begin.
        """
        if self.operations[node] == "view":
            base, strides = self.extras[node]
            if strides == row_major(self.dims[node]):
                return self.arguments[node][0], base
        if self.operations[node] in ("view", "iota"):
            kind, dims = self.kinds[node], self.dims[node]
            whole = (Piece(0, row_major(dims), dims),)
            given = (node, self.constant(0, kind))
            return self.place("joined", given, kind, dims, whole), 0
        return node, 0

    def joined(
        self, sources: Sequence[int], pieces: Sequence[Piece], dims: Dims, fill: int
    ) -> int:
        """Returns a stored node put together from sources, with `fill` elsewhere.

        Each piece has the positions at which one source is written; pieces do not
        overlap.
        """
        if len(sources) == 1:
            (source,), (piece,) = sources, pieces
            whole = piece.base == 0 and piece.strides == row_major(dims)
            if whole and piece.dims == dims:
                return source
        return self.place(
            "joined",
            (*sources, fill),
            self.kinds[fill],
            dims,
            tuple(pieces),
        )

    def reduced(self, node: int, operation: str, axes: Dims) -> int:
        """Returns a node reduced along axes by an operation such as `"add"`."""
        own = self.dims[node]
        dims = tuple(n for axis, n in enumerate(own) if axis not in axes)
        kind = self.kinds[node]
        return self.place("reduce", (node,), kind, dims, (operation, axes))

    def gathered(self, table: int, base: int, index: int) -> int:
        """Returns the numbers of the stored node `table` at computed flat indices.

        They are `base` plus the numbers of the node `index`; the result has its shape.
        """
        dims = self.dims[index]
        known = self.value(index)
        if known is not None:
            return self.view(table, (), base + int(known), ())
        return self.place("gather", (table, index), self.kinds[table], dims, base)

    def scattered(
        self,
        into: int,
        index: int,
        updates: int,
        operation: str,
        size: int,
        rounds: int,
    ) -> int:
        """Returns a stored row into which numbers are combined, one after another.

        Args:
            into: Node of the row before.
            index: Node of the indices; a number whose index is `size` is dropped.
            updates: Node of the numbers.
            operation: Operation that combines them with the row, or `"set"`.
            size: Length of the row.
            rounds: Number of indices and of numbers.
        """
        kind = self.kinds[into]
        if self.operations[into] == "view" and self.extras[into][1] not in ((1,), ()):
            fill = self.constant(0, kind)
            whole = (Piece(0, (1,), (size,)),)
            into = self.place("joined", (into, fill), kind, (size,), whole)
        elif not self.dims[into] and self.value(into) is None:
            fill = into
            into = self.place("joined", (fill,), kind, (size,), ())
        given: tuple[int, ...] = into, index, updates
        if operation == "add" and self.operations[updates] == "select":
            mask, number, nothing = self.arguments[updates]
            if self.value(nothing) == 0 and self.dims[mask] == (rounds,):
                # Where the mask is false nothing is added, so nothing need be computed.
                given = into, index, number, mask
        extra = operation, rounds
        return self.place("scatter", given, kind, (size,), extra)

    def iota(self, dims: Dims, axis: int, kind: str) -> int:
        """Returns a node whose entries are their own index along an axis.

        `kind` is the type of the numbers, such as `"f32"`.
        """
        return self.place("iota", (), kind, dims, axis, 0)


def row_major(dims: Dims) -> Dims:
    """Returns the strides of an array in row-major order, in numbers."""
    return tuple(math.prod(dims[axis + 1 :]) for axis in range(len(dims)))


_IDENTITY = {
    "add": 0,
    "mul": 1,
    "max": -np.inf,
    "min": np.inf,
    "and": True,
    "or": False,
    "xor": False,
}


def identity(operation: str, kind: str) -> object:
    """Returns the identity element of an operation on numbers of type `kind`.

    It is 0 for `"add"` and 1 for `"mul"`.
    """
    none = _IDENTITY[operation]
    if kind == "b1":
        return bool(none) if operation in ("and", "or", "xor") else operation == "min"
    if kind[0] != "f" and operation in ("min", "max"):
        info = np.iinfo(np.dtype(f"{'int' if kind[0] == 'i' else 'uint'}{kind[1:]}"))
        return info.max if operation == "min" else info.min
    if kind[0] != "f" and operation == "and":
        return -1 if kind[0] == "i" else 2 ** int(kind[1:]) - 1
    return none if kind[0] == "f" else int(none)
