"""Loops within a step that are LLVM functions of their own.

Such a loop has its own graph of rows. Its rounds are calls of one function, from one
carry in memory to the next. The number of rounds is known (`scan`), or another function
of the carry tells whether another round follows (`while`). Values that do not change in
the loop are computed before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from jaxrod.jax_internals.equations import operand_types, result_types
from jaxrod.lanes.graph import FIXED, VARYING
from jaxrod.lanes.jaxpr.unroll import NotUnrolled, kind_of
from jaxrod.lanes.llvm.vector_code import BYTES
from jaxrod.lanes.rows.arrays import Rows, long_axes
from jaxrod.lanes.rows.functions import ALIGNMENT, RowFunctions
from jaxrod.lanes.rows.row_graph import Piece, RowGraph
from jaxrod.lanes.rows.row_unroller import Nested
from jaxrod.lanes.rows.schedule import Goal, Place


def nested_loop(
    outer: RowFunctions, program: Nested, arrays: Sequence[Rows]
) -> list[Rows]:
    """Adds a loop that is a function of its own to a graph, and returns its results.

    Args:
        outer: Functions of the graph.
        program: The loop.
        arrays: Operands of the loop, in the order of `Nested`.

    Raises:
        NotUnrolled: An operand has no numbers.
    """
    if any(0 in array.shape for array in arrays):
        raise NotUnrolled("rows have no loop with an operand without numbers")
    graph, layout = outer.graph, outer.unroller.layout
    outer.n_nested += 1
    made = NestedLoop(f"{outer.prefix}loop{outer.n_nested}_", graph, program, arrays)
    stored = [
        layout.stored(array)
        for array, value in zip(arrays, made.known, strict=True)
        if value is None
    ]
    made.bases = [base for _, base in stored]
    given = tuple(node for node, _ in stored)
    rate = max([FIXED, *(graph.rates[node] for node in given)])
    loop = graph.place("nested", given, "i32", (), made, rate)
    results = []
    for k, (aval, shape) in enumerate(made.made):
        kind = kind_of(aval)
        if 0 in shape:
            results.append(outer.unroller.full(0, shape, kind))
            made.results.append(None)
            continue
        node = graph.place("result", (loop,), kind, (math.prod(shape),), k)
        made.results.append(node)
        results.append(layout.views((node, 0), shape, long_axes(shape), kind))
    return results


class NestedLoop(RowFunctions):
    """A loop as LLVM functions: constant values, one round, and the condition."""

    def __init__(
        self, prefix: str, outside: RowGraph, program: Nested, arrays: Sequence[Rows]
    ) -> None:
        """Translates a loop to a graph of its own.

        Args:
            prefix: Beginning of the names of its functions.
            outside: Graph of the operands.
            program: The loop.
            arrays: Operands of the loop.
        """
        super().__init__(prefix)
        self.unroller.nest = partial(nested_loop, self)
        self.program = program
        n_tests, n = program.n_condition, program.n_constants
        types = operand_types(program.body)
        avals = types
        if program.condition is not None:
            avals = [*operand_types(program.condition)[:n_tests], *types]
        n_fixed = n_tests + n
        first_row = n_fixed + program.n_carry
        self.known = [
            _known(outside, array) if i < n_fixed else None
            for i, array in enumerate(arrays)
        ]
        """Number of each operand that repeats one known number, otherwise `None`."""
        self.now = self.storage("%now")
        self.carry = avals[n_fixed:first_row]
        self.carry_places = self.now.all(self.carry)
        self.constant_names = [
            f"%c{i}" for i in range(n_fixed) if self.known[i] is None
        ]
        self.row_names = [f"%x{i}" for i in range(len(avals) - first_row)]
        self.row_sizes = [_bytes(aval) for aval in avals[first_row:]]
        places = [
            *(Place(f"%c{i}", 0) for i in range(n_fixed)),
            *self.carry_places,
            *(Place(name, 0) for name in self.row_names),
        ]
        inputs = []
        for i, (aval, value) in enumerate(zip(avals, self.known, strict=True)):
            if value is None:
                rate = FIXED if i < n_fixed else VARYING
                inputs.append(self.input(i, aval, rate))
            else:
                shape = tuple(map(int, aval.shape))
                inputs.append(self.unroller.full(value, shape, kind_of(aval)))
        self.stand(0, places)
        made = self.unroller.run(program.body, inputs[n_tests:])
        then = [Place("%then", place.offset) for place in self.carry_places]
        outputs = result_types(program.body)
        self.result_names = [f"%y{k}" for k in range(len(made) - program.n_carry)]
        ends = [Place(name, 0) for name in self.result_names]
        self.round = self.goals(made, [*then, *ends])
        self.result_sizes = [_bytes(aval) for aval in outputs[program.n_carry :]]
        length = program.length or 0
        self.made = [
            (aval, tuple(map(int, aval.shape)))
            if k < program.n_carry
            else (aval, (length, *map(int, aval.shape)))
            for k, aval in enumerate(outputs)
        ]
        """Type of each result, and its shape after all rounds."""
        self.test: list[Goal] = []
        if program.condition is not None:
            tests, carry = inputs[:n_tests], inputs[n_fixed:]
            (answer,) = self.unroller.run(program.condition, [*tests, *carry])
            self.test = [Goal(answer.scalar, Place("%flag", 0), Piece(0, (), ()))]
        self.bases: list[int] = []
        """Flat index in its stored node at which each operand begins."""
        self.results: list[int | None] = []
        """Node of each result in the graph outside."""
        self.written = False

    @property
    def room(self) -> int:
        """Size of the memory that the functions use [bytes]."""
        dump = sum(_rounded(size) for size in self.result_sizes)
        return self.scratch + self.fixed.size + 2 * self.now.size + ALIGNMENT + dump

    def compile(self) -> None:
        """Writes the functions, if they are not written yet."""
        if self.written:
            return
        self.written = True
        constants = self.constant_names
        self.hoist([*self.round, *self.test])
        rows = [*self.row_names, *self.result_names]
        own = ["%fixed", *constants, "%now", "%then", *rows]
        self.function("round", self.round, own)
        if self.test:
            self.function("test", self.test, ["%fixed", *constants, "%now", "%flag"])
        self.texts.append(self.lasting_fills())

    def write(self, writer: Any, mark: str, arguments: Sequence[int]) -> None:
        """Appends the loop to the lines of a writer.

        Args:
            writer: Writer of the function that has the loop.
            mark: Beginning of the labels of the loop.
            arguments: Stored nodes of the operands that are not known numbers.
        """
        self.compile()
        writer.nested.append(self)
        schedule, graph = writer.schedule, writer.graph
        room = schedule.room(self.room)

        def at(place: Place, base: int = 0) -> str:
            where = place.offset + base
            return str(
                writer.new(f"getelementptr i8, ptr {place.pointer}, i64 {where}")
            )

        begin = 0
        regions = []
        sizes = [self.scratch, self.fixed.size, self.now.size, self.now.size, ALIGNMENT]
        for size in [*sizes, *map(_rounded, self.result_sizes)]:
            regions.append(at(room, begin))
            begin += size
        scratch, fixed, now, then, flag, *dumps = regions
        given = [
            at(schedule.place(node), base * BYTES[graph.kinds[node]])
            for node, base in zip(arguments, self.bases, strict=True)
        ]
        n_fixed = len(self.constant_names)
        constants = given[:n_fixed]
        carry = given[n_fixed : n_fixed + len(self.carry)]
        rows = given[n_fixed + len(self.carry) :]
        for pointer, aval, place in zip(
            carry, self.carry, self.carry_places, strict=True
        ):
            _copy(writer, at(Place(now, place.offset)), pointer, _bytes(aval))
        self._call(writer, "fixed", [scratch, fixed, *constants])
        writer.lines.append(f"call void @{self.prefix}fills(ptr {fixed})")
        n_carry = len(self.carry)
        ends = [None if node is None else schedule.place(node) for node in self.results]
        stacks = [
            (dump, 0) if place is None else (at(place), size)
            for place, size, dump in zip(
                ends[n_carry:], self.result_sizes, dumps, strict=True
            )
        ]
        streams = [*zip(rows, self.row_sizes, strict=True), *stacks]
        regions = [scratch, fixed, *constants]
        if self.program.condition is not None:
            last = self._while(writer, mark, regions, now, then, flag)
        else:
            last = self._scan(writer, mark, regions, now, then, streams)
        for aval, place, end in zip(
            self.carry, self.carry_places, ends[:n_carry], strict=True
        ):
            if end is not None:
                _copy(writer, at(end), at(Place(last, place.offset)), _bytes(aval))

    def _call(self, writer: Any, name: str, pointers: Sequence[str]) -> None:
        given = ", ".join(f"ptr {pointer}" for pointer in pointers)
        writer.lines.append(f"call void @{self.prefix}{name}({given})")

    def _while(
        self,
        writer: Any,
        mark: str,
        regions: Sequence[str],
        now: str,
        then: str,
        flag: str,
    ) -> str:
        """Appends a loop with a condition; returns the pointer to its last carry."""
        writer.lines += [
            f"br label %{mark}_pre",
            f"{mark}_pre:",
            f"br label %{mark}",
            f"{mark}:",
            f"%a_{mark} = phi ptr [{now}, %{mark}_pre], [%b_{mark}, %{mark}_go]",
            f"%b_{mark} = phi ptr [{then}, %{mark}_pre], [%a_{mark}, %{mark}_go]",
        ]
        self._call(writer, "test", [*regions, f"%a_{mark}", flag])
        writer.lines += [
            f"%f_{mark} = load i8, ptr {flag}",
            f"%m_{mark} = icmp ne i8 %f_{mark}, 0",
            f"br i1 %m_{mark}, label %{mark}_go, label %{mark}_done",
            f"{mark}_go:",
        ]
        self._call(writer, "round", [*regions, f"%a_{mark}", f"%b_{mark}"])
        writer.lines += [f"br label %{mark}", f"{mark}_done:"]
        return f"%a_{mark}"

    def _scan(
        self,
        writer: Any,
        mark: str,
        regions: Sequence[str],
        now: str,
        then: str,
        streams: Sequence[tuple[str, int]],
    ) -> str:
        """Appends a loop of known length; returns the pointer to its last carry.

        `streams` are pointers to the scanned arrays and to the results of all rounds,
        each with the size of its entries [bytes].
        """
        length = self.program.length
        assert length is not None
        index = f"add i64 %c_{mark}, 0"
        if self.program.backwards:
            index = f"sub i64 {length - 1}, %c_{mark}"
        writer.lines += [
            f"br label %{mark}_pre",
            f"{mark}_pre:",
            f"br label %{mark}",
            f"{mark}:",
            f"%c_{mark} = phi i64 [0, %{mark}_pre], [%d_{mark}, %{mark}]",
            f"%a_{mark} = phi ptr [{now}, %{mark}_pre], [%b_{mark}, %{mark}]",
            f"%b_{mark} = phi ptr [{then}, %{mark}_pre], [%a_{mark}, %{mark}]",
            f"%i_{mark} = {index}",
        ]
        entries = []
        for pointer, size in streams:
            offset = writer.new(f"mul i64 %i_{mark}, {size}")
            entries.append(writer.new(f"getelementptr i8, ptr {pointer}, i64 {offset}"))
        self._call(writer, "round", [*regions, f"%a_{mark}", f"%b_{mark}", *entries])
        writer.lines += [
            f"%d_{mark} = add i64 %c_{mark}, 1",
            f"%m_{mark} = icmp slt i64 %d_{mark}, {length}",
            f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
            f"{mark}_done:",
        ]
        return f"%b_{mark}"


def _known(graph: RowGraph, array: Rows) -> Any:
    """The number that an array repeats, if it is known, otherwise `None`."""
    nodes = np.unique(array.nodes)
    return graph.value(int(nodes[0])) if nodes.size == 1 else None


def _bytes(aval: Any) -> int:
    """Size of an array of type `aval` [bytes]."""
    return math.prod(aval.shape) * BYTES[kind_of(aval)]


def _rounded(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT


def _copy(writer: Any, to: str, source: str, size: int) -> None:
    """Appends a copy of `size` bytes."""
    writer.lines.append(
        f"call void @llvm.memcpy.p0.p0.i64(ptr {to}, ptr {source}, i64 {size}, "
        "i1 false)"
    )
