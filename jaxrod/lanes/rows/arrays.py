"""Arrays of jaxprs as rows: short axes are unrolled, each long axis is a loop.

An array has one graph node for every index along its unrolled axes. The other axes are
its *loops*: a node contains all numbers along them. So an array of shape `(3, 50)` is
three rows of 50 numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from jaxrod.lanes.rows.row_graph import Dims, Move, Piece, RowGraph, row_major

SHORTEST_LOOP = 5
"""Smallest length of an axis that is a loop; shorter axes are unrolled."""


@dataclass(frozen=True)
class Rows:
    """An array of a jaxpr, as graph nodes that are rows of numbers."""

    shape: Dims
    """Shape of the array."""
    loops: Dims
    """Axes along which a node has all numbers (loops), in ascending order."""
    nodes: np.ndarray
    """Graph nodes, in an array of the shape `shape`, but of length one along
    `loops`."""
    kind: str
    """Type of the numbers, such as `"f32"`."""

    @property
    def dims(self) -> Dims:
        """Lengths of the loops."""
        return tuple(self.shape[axis] for axis in self.loops)

    @property
    def scalar(self) -> int:
        """The only node of an array of one number."""
        return int(self.nodes.reshape(-1)[0])

    def entries(self) -> Iterator[tuple[Dims, int]]:
        """Yields each node and its index along all axes, which is 0 along the loops."""
        for index in np.ndindex(*self.nodes.shape):
            yield index, int(self.nodes[index])


class Layout:
    """Operations that slice, join and rearrange arrays of rows in one graph."""

    def __init__(self, graph: RowGraph) -> None:
        """Creates a layout, whose operations add nodes to a graph.

        Args:
            graph: Graph to which nodes are added.
        """
        self.graph = graph

    def from_memory(self, node: int, shape: Dims, kind: str) -> Rows:
        """Returns the array with the numbers of a stored node, in row-major order.

        `kind` is the type of the numbers, such as `"f32"`.
        """
        base = self.graph.flat(node)
        loops = long_axes(shape)
        return self.views(base, shape, loops, kind)

    def full(self, node: int, shape: Dims, kind: str) -> Rows:
        """Returns an array in which the number of one node is repeated.

        `kind` is the type of the number, such as `"f32"`.
        """
        loops = long_axes(shape)
        nodes = np.full(_unrolled(shape, loops), node, np.int64)
        return Rows(shape, loops, nodes, kind)

    def known(self, numbers: np.ndarray, kind: str) -> Rows:
        """Returns an array of known numbers.

        `kind` is the type of the numbers, such as `"f32"`.
        """
        if numbers.size and (numbers == numbers.reshape(-1)[0]).all():
            node = self.graph.constant(numbers.reshape(-1)[0], kind)
            return self.full(node, numbers.shape, kind)
        if not long_axes(numbers.shape):
            nodes = self.graph.constants(numbers)
            return Rows(numbers.shape, (), nodes, kind)
        node = self.graph.known_array(numbers, kind)
        return self.from_memory(node, numbers.shape, kind)

    def taken(
        self,
        array: Rows,
        shape: Dims,
        start: Sequence[int],
        moves: Sequence[Move],
    ) -> Rows:
        """Returns an array that reads another at regular indices.

        Its entry i along an axis with move (a, s) is read at index start[a] + s i of
        axis a.

        Args:
            array: The array that is read.
            shape: Shape of the result.
            start: First index along each axis of `array`.
            moves: Motion of each axis of the result through `array`.
        """
        graph = self.graph
        loops = tuple(
            axis
            for axis, (length, move) in enumerate(zip(shape, moves, strict=True))
            if _stays_loop(array, length, move)
        )
        own = {axis: place for place, axis in enumerate(array.loops)}
        nodes = np.empty(_unrolled(shape, loops), np.int64)
        dims = tuple(shape[axis] for axis in loops)
        inner = []
        for axis in loops:
            move = moves[axis]
            source = move.axis if move.axis in own else None
            inner.append(Move(None if source is None else own[source], move.step))
        for index in np.ndindex(*nodes.shape):
            at = list(start)
            for axis, move in enumerate(moves):
                if move.axis is not None:
                    at[move.axis] += index[axis] * move.step
            place = tuple(0 if axis in own else i for axis, i in enumerate(at))
            node = int(array.nodes[place])
            nodes[index] = graph.taken(
                node, [at[axis] for axis in array.loops], inner, dims
            )
        return Rows(shape, loops, nodes, array.kind)

    def looped(self, array: Rows, loops: Dims) -> Rows:
        """Returns an array whose loops are the axes `loops`, including unrolled ones.

        Raises:
            AssertionError: The array has a loop that is not among `loops`.
        """
        if array.loops == loops:
            return array
        if not set(array.loops) <= set(loops):
            raise AssertionError(f"loops {array.loops} are not among {loops}")
        shape, graph = array.shape, self.graph
        dims = tuple(shape[axis] for axis in loops)
        more = [axis for axis in loops if axis not in array.loops]
        strides = dict(zip(loops, row_major(dims), strict=True))
        kept = [1 if axis in loops else n for axis, n in enumerate(shape)]
        nodes = np.empty(kept, np.int64)
        own = tuple(strides[axis] for axis in array.loops)
        repeat = [
            Move(array.loops.index(axis) if axis in array.loops else None)
            for axis in loops
        ]
        for index in np.ndindex(*kept):
            sources, pieces = [], []
            for inner in np.ndindex(*(shape[axis] for axis in more)):
                at = list(index)
                for axis, i in zip(more, inner, strict=True):
                    at[axis] = i
                sources.append(int(array.nodes[tuple(at)]))
                base = sum(i * strides[a] for a, i in zip(more, inner, strict=True))
                pieces.append(Piece(base, own, array.dims))
            if len(set(sources)) == 1:
                zeros = [0] * len(array.loops)
                nodes[index] = graph.taken(sources[0], zeros, repeat, dims)
            else:
                nodes[index] = self._joined(sources, pieces, dims, array.kind)
        return Rows(shape, loops, nodes, array.kind)

    def aligned(self, *arrays: Rows) -> list[Rows]:
        """Returns arrays broadcast to one shape, with the same axes as loops.

        An array without axes is returned unchanged, because it fits any shape.
        """
        shapes = np.broadcast_shapes(*(array.shape for array in arrays))
        shape = tuple(map(int, shapes))
        whole = [self._spread(array, shape) for array in arrays]
        union = sorted({axis for array in whole for axis in array.loops})
        return [
            array if not array.shape else self.looped(array, tuple(union))
            for array in whole
        ]

    def _spread(self, array: Rows, shape: Dims) -> Rows:
        if not array.shape or array.shape == shape:
            return array
        moves = [
            Move(axis if own == n else None)
            for axis, (own, n) in enumerate(zip(array.shape, shape, strict=True))
        ]
        return self.taken(array, shape, [0] * len(shape), moves)

    def mapped(self, function: Callable[..., int], kind: str, *arrays: Rows) -> Rows:
        """Returns the nodes that a function returns for the entries of arrays.

        The arrays are broadcast; `kind` is the type of the results, such as `"f32"`.
        """
        same = self.aligned(*arrays)
        first = max(same, key=lambda array: len(array.shape))
        nodes = self.graph.mapped(function, *(array.nodes for array in same))
        return Rows(first.shape, first.loops, nodes, kind)

    def each(self, operation: str, kind: str, *arrays: Rows) -> Rows:
        """Returns an operation applied to arrays entry by entry, after broadcasting.

        `kind` is the type of the results, such as `"f32"`.
        """
        return self.mapped(
            lambda *entries: self.graph.add(operation, entries, kind), kind, *arrays
        )

    def reshaped(self, array: Rows, shape: Dims) -> Rows:
        """Returns an array with its numbers in the same order, in another shape."""
        if shape == array.shape:
            return array
        old_axes = [axis for axis, n in enumerate(array.shape) if n != 1]
        new_axes = [axis for axis, n in enumerate(shape) if n != 1]
        if [array.shape[a] for a in old_axes] == [shape[a] for a in new_axes]:
            again = dict(zip(new_axes, old_axes, strict=True))
            start = [0] * len(array.shape)
            moves = [Move(again.get(axis)) for axis in range(len(shape))]
            return self.taken(array, shape, start, moves)
        if 0 in shape:
            return self.full(self.graph.constant(0, array.kind), shape, array.kind)
        lead = 0
        while (
            lead < min(len(shape), len(array.shape))
            and shape[lead] == array.shape[lead]
            and lead not in array.loops
        ):
            lead += 1
        rest = shape[lead:]
        parts = [self._flat(array, index) for index in np.ndindex(*array.shape[:lead])]
        loops = tuple(lead + axis for axis in long_axes(rest))
        inner = tuple(axis - lead for axis in loops)
        rows = [self.views(part, rest, inner, array.kind).nodes for part in parts]
        nodes = np.array(rows, np.int64).reshape(_unrolled(shape, loops))
        return Rows(shape, loops, nodes, array.kind)

    def concatenated(self, arrays: Sequence[Rows], axis: int) -> Rows:
        """Joins arrays along an axis."""
        arrays = [array for array in arrays if array.shape[axis]] or list(arrays[:1])
        length = sum(array.shape[axis] for array in arrays)
        shape = list(arrays[0].shape)
        shape[axis] = length
        single = all(array.shape[axis] == 1 for array in arrays)
        if length < SHORTEST_LOOP or (single and len(shape) > 1):
            others = sorted({a for array in arrays for a in array.loops if a != axis})
            arrays = [self.looped(array, tuple(others)) for array in arrays]
            nodes = np.concatenate([array.nodes for array in arrays], axis=axis)
            return Rows(tuple(shape), tuple(others), nodes, arrays[0].kind)
        begins = np.cumsum([0, *(array.shape[axis] for array in arrays)])
        parts = [(array, int(b)) for array, b in zip(arrays, begins, strict=False)]
        return self._placed(parts, axis, 1, tuple(shape), None)

    def padded(
        self, array: Rows, axis: int, low: int, high: int, inner: int, fill: int
    ) -> Rows:
        """Pads an array along one axis, at both ends and between entries.

        Args:
            array: The array.
            axis: The axis.
            low: Count of numbers before the first; a negative count cuts off numbers.
            high: Count of numbers after the last; a negative count cuts off numbers.
            inner: Count of numbers between neighbouring entries.
            fill: Node of the inserted numbers.
        """
        n = array.shape[axis]
        low, high, inner = int(low), int(high), int(inner)
        spread = n + max(n - 1, 0) * inner
        if low < 0 or high < 0:
            if inner:
                whole = self.padded(array, axis, 0, 0, inner, fill)
                return self.padded(whole, axis, low, high, 0, fill)
            first, last = max(0, -low), n - max(0, -high)
            array = self.sliced(array, axis, first, max(last, first))
            low, high = max(low, 0), max(high, 0)
            return self.padded(array, axis, low, high, 0, fill)
        length = low + spread + high
        shape = list(array.shape)
        shape[axis] = length
        if not low and not high and not inner:
            return array
        if length < SHORTEST_LOOP or (axis not in array.loops and 0 in array.shape):
            nodes = np.full(
                [length if a == axis else k for a, k in enumerate(array.nodes.shape)],
                fill,
                np.int64,
            )
            where = [slice(None)] * nodes.ndim
            where[axis] = slice(low, low + spread, inner + 1)
            nodes[tuple(where)] = array.nodes
            loops = tuple(a for a in long_axes(tuple(shape)) if a in array.loops)
            return Rows(tuple(shape), loops, nodes, array.kind)
        return self._placed([(array, low)], axis, inner + 1, tuple(shape), fill)

    def sliced(
        self, array: Rows, axis: int, first: int, last: int, step: int = 1
    ) -> Rows:
        """Returns entries `first`, `first + step`, ... before `last` along an axis."""
        shape, start = list(array.shape), [0] * len(array.shape)
        shape[axis], start[axis] = len(range(first, last, step)), first
        moves = [Move(a, step if a == axis else 1) for a in range(len(array.shape))]
        return self.taken(array, tuple(shape), start, moves)

    def stored(self, array: Rows) -> tuple[int, int]:
        """Returns a stored node that has all numbers of an array in row-major order.

        Returns:
            The stored node, and the flat index in it at which the numbers begin.
        """
        return self._flat(array, ())

    def _placed(
        self,
        parts: Sequence[tuple[Rows, int]],
        axis: int,
        step: int,
        shape: Dims,
        fill: int | None,
    ) -> Rows:
        """Writes arrays into one array along an axis, which becomes a loop.

        Args:
            parts: Arrays, each with the index along the axis at which its numbers
                begin.
            axis: The axis.
            step: Distance along the axis between neighbouring entries of a part.
            shape: Shape of the result.
            fill: Node of the number at all other indices; `None` for 0.
        """
        others = {a for array, _ in parts for a in array.loops}
        loops = tuple(sorted(others | {axis}))
        dims = tuple(shape[a] for a in loops)
        strides = dict(zip(loops, row_major(dims), strict=True))
        kind = parts[0][0].kind
        nodes = np.empty(_unrolled(shape, loops), np.int64)
        for index in np.ndindex(*nodes.shape):
            sources, pieces = [], []
            for array, begin in parts:
                array = self.looped(
                    array, tuple(a for a in loops if a != axis or a in array.loops)
                )
                for i in range(array.nodes.shape[axis]):
                    at = list(index)
                    at[axis] = i
                    sources.append(int(array.nodes[tuple(at)]))
                    moved = tuple(
                        strides[a] * (step if a == axis else 1) for a in array.loops
                    )
                    base = (begin + i * step) * strides[axis]
                    pieces.append(Piece(base, moved, array.dims))
            nodes[index] = self._joined(sources, pieces, dims, kind, fill)
        return Rows(shape, loops, nodes, kind)

    def _joined(
        self,
        sources: Sequence[int],
        pieces: Sequence[Piece],
        dims: Dims,
        kind: str,
        fill: int | None = None,
    ) -> int:
        if fill is None:
            fill = self.graph.constant(0, kind)
        if set(sources) == {fill}:
            return fill
        kept = [
            (source, piece)
            for source, piece in zip(sources, pieces, strict=True)
            if source != fill
        ]
        if len(kept) == 1 and len(dims) == 1:
            (source, piece) = kept[0]
            margin = dims[0] - piece.base - sum(piece.dims)
            if (
                len(piece.dims) == 1
                and piece.strides == (1,)
                and (max(piece.base, margin) <= 2)
            ):
                return self._with_margins(source, piece, dims, fill)
        return self.graph.joined(
            [source for source, _ in kept], [piece for _, piece in kept], dims, fill
        )

    def _with_margins(self, source: int, piece: Piece, dims: Dims, fill: int) -> int:
        """Returns a row with at most two numbers of `fill` at each end, as a view.

        `source` is the row without these numbers, and `piece` its position in the
        result, which has the shape `dims`. All such rows with the same source and fill
        are views of one stored row, with two numbers of fill at each end.
        """
        (n,) = piece.dims
        wide = (n + 4,)
        whole = self.graph.joined([source], [Piece(2, (1,), (n,))], wide, fill)
        return self.graph.view(whole, dims, 2 - piece.base, (1,))

    def _flat(self, array: Rows, lead: Dims) -> tuple[int, int]:
        """Returns a stored node with the numbers of `array[lead]`, in row-major order.

        Returns:
            The stored node, and the flat index in it at which the numbers begin.
        """
        rest = array.shape[len(lead) :]
        loops = tuple(axis - len(lead) for axis in array.loops)
        nodes = array.nodes[lead]
        if loops == tuple(range(len(rest))):
            node = int(nodes.reshape(-1)[0])
            if self.graph.dims[node] == rest and rest:
                return self.graph.flat(node)
        strides = row_major(rest)
        size = int(np.prod(rest, dtype=int))
        dims = tuple(rest[axis] for axis in loops)
        own = tuple(strides[axis] for axis in loops)
        sources, pieces = [], []
        for index in np.ndindex(*nodes.shape):
            base = sum(i * s for i, s in zip(index, strides, strict=True))
            sources.append(int(nodes[index]))
            pieces.append(Piece(base, own, dims))
        fill = self.graph.constant(0, array.kind)
        node = self.graph.joined(sources, pieces, (size,), fill)
        if not self.graph.dims[node]:
            node = self.graph.place("joined", (node,), array.kind, (size,), ())
        return self.graph.flat(node)

    def views(
        self, stored: tuple[int, int], shape: Dims, loops: Dims, kind: str
    ) -> Rows:
        """Returns an array of shape `shape`, whose nodes are views of a stored node.

        `stored` is the node, and the flat index in it at which the numbers begin, in
        row-major order. The axes `loops` are loops, the others are unrolled.
        """
        node, base = stored
        strides = row_major(shape)
        nodes = np.empty(_unrolled(shape, loops), np.int64)
        dims = tuple(shape[axis] for axis in loops)
        own = tuple(strides[axis] for axis in loops)
        for index in np.ndindex(*nodes.shape):
            at = base + sum(i * s for i, s in zip(index, strides, strict=True))
            nodes[index] = self.graph.view(node, dims, at, own)
        return Rows(shape, loops, nodes, kind)


def long_axes(shape: Dims) -> Dims:
    """Returns the axes that are long enough to be loops."""
    return tuple(axis for axis, n in enumerate(shape) if n >= SHORTEST_LOOP)


def _stays_loop(array: Rows, length: int, move: Move) -> bool:
    if length < SHORTEST_LOOP:
        return False
    return move.axis is None or move.axis in array.loops


def _unrolled(shape: Dims, loops: Dims) -> list[int]:
    return [1 if axis in loops else n for axis, n in enumerate(shape)]
