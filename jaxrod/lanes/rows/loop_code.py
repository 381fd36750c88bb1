"""LLVM IR of the loops of a schedule.

A loop processes a row in vectors. The last vector of a row ends with the row: it
begins early and computes some numbers again, so that no load or store is outside the
row. Outer axes are loops around it. Values that do not change in a loop are computed
before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxrod.lanes.graph import DTYPES
from jaxrod.lanes.llvm.vector_code import BYTES, TYPES, literal
from jaxrod.lanes.rows.loop_writer import LoopWriter
from jaxrod.lanes.rows.packed_loops import write_packed
from jaxrod.lanes.rows.packing import STORED
from jaxrod.lanes.rows.recurrences import write_recurrence
from jaxrod.lanes.rows.row_graph import Dims, RowGraph, identity, row_major
from jaxrod.lanes.rows.schedule import Fill, Loop, Place, Schedule

Lines = list[str]
WIDEST = 64
"""Size of the vector registers of processors with AVX-512 [bytes]."""
DEEPEST = 6
"""Number of operations on an index within which consecutive indices are recognised."""
SIZES = {TYPES[kind]: size for kind, size in BYTES.items()}
"""Sizes of single numbers in memory [bytes], by LLVM type."""


class RowWriter(LoopWriter):
    """Writer of an LLVM function that runs the loops of a schedule."""

    attributes = "noinline nounwind alignstack(64)"
    """LLVM attributes of the function."""
    given = ""
    """LLVM text of the first arguments in each call of a fill function, which writes
    one number to many entries; empty if there are no such arguments."""

    def __init__(self, graph: RowGraph, schedule: Schedule, vector_bytes: int) -> None:
        """Begins an LLVM function without lines.

        Args:
            graph: The graph of rows.
            schedule: Loops of the function.
            vector_bytes: Size of a vector register [bytes].
        """
        super().__init__(graph, schedule, 1)
        self.vector_bytes = vector_bytes
        self.spreads: dict[tuple[int, int], str] = {}
        """Names of vectors with one number in every lane, by node and width, in this
        loop."""
        self.nested: list[Any] = []
        """Loops that are functions of their own, which this function calls."""
        self.before: list[Lines] = [[]]
        """Lines before each loop of a nest, from the outermost loop on; then the body
        of the innermost."""

    def text(self, name: str, pointers: Sequence[str]) -> str:
        """Returns the LLVM function with all loops; `pointers` are its arguments."""
        whole: Lines = []
        for number, loop in enumerate(self.schedule.loops):
            whole += self._loop(number, loop)
        return self.function(name, pointers, whole)

    def function(self, name: str, pointers: Sequence[str], lines: Lines) -> str:
        """Returns an LLVM function with these lines; `pointers` are its arguments."""
        given = ", ".join(f"ptr noalias nocapture {p}" for p in pointers)
        head = f"define internal void @{name}({given}) {self.attributes} {{"
        return "\n".join([head, "entry:", *lines, "ret void", "}", ""])

    def synchronise(self) -> None:
        """Appends a barrier for all threads; nothing here, as there is one thread."""

    def one_by_one(self, name: str, write: Callable[[], None]) -> None:
        """Appends code that updates memory, which only one thread may run.

        Args:
            name: Beginning of the labels of the code.
            write: Function that appends the code.
        """
        del name
        write()

    def value(self, node: int) -> str:
        """Returns the name of a node's value (a vector) in the loop being written."""
        graph = self.graph
        known = graph.value(node)
        if known is not None:
            return self.literal(known, graph.kinds[node])
        dims = graph.dims[node]
        if not dims:
            return self._spread(node)
        name = self.names.get(node)
        if name is None:
            name = self._read(node)
            self.names[node] = name
        return name

    def _number(self, node: int) -> str:
        """Returns the name of a scalar, loading it first if it is in memory."""
        name = self.numbers.get(node)
        if name is not None:
            return name
        place = self.schedule.ready.get(node)
        if place is None:
            raise AssertionError(f"node {node} is used before it is computed")
        name = self._load_one(self._at(place), self.graph.kinds[node])
        self.numbers[node] = name
        return name

    def _spread(self, node: int) -> str:
        if self.width == 1 and not self.dims:
            return self._number(node)
        key = node, self.width
        name = self.spreads.get(key)
        if name is None:
            lines, self.lines = self.lines, self.before[0]
            name = self.spread(self._number(node), self.graph.kinds[node])
            self.lines = lines
            self.spreads[key] = name
        return name

    def _read(self, node: int) -> str:
        """Appends the load of a view or stored node, or an index; returns its name."""
        graph, schedule = self.graph, self.schedule
        operation = graph.operations[node]
        kind = graph.kinds[node]
        if operation == "iota":
            return self._iota(graph.extras[node], kind)
        place = None if operation == "view" else schedule.place(node)
        if place is not None:
            return self._load(place, 0, row_major(graph.dims[node]), kind)
        if operation != "view":
            raise AssertionError(f"node {node} is used before it is computed")
        (source,) = graph.arguments[node]
        place = schedule.place(source)
        assert place is not None, (source, graph.operations[source])
        base, strides = graph.extras[node]
        return self._load(place, base, strides, kind)

    def _iota(self, axis: int, kind: str) -> str:
        many = self.type(kind)
        depth = len(self.dims) - 1
        lines, self.lines = self.lines, self.before[axis + 1]
        index = self.indices[axis]
        first = (
            self.new(f"trunc i64 {index} to {TYPES[kind]}")
            if (kind not in ("i64", "u64", "f32", "f64"))
            else self.new(f"add i64 {index}, 0")
        )
        if kind[0] == "f":
            first = self.new(f"sitofp i64 {first} to {TYPES[kind]}")
        name = self.spread(first, kind)
        if axis == depth and self.width > 1:
            steps = ", ".join(
                f"{TYPES[kind]} {literal(i, kind)}" for i in range(self.width)
            )
            word = "fadd" if kind[0] == "f" else "add"
            name = self.new(f"{word} {many} {name}, <{steps}>")
        self.lines = lines
        return name

    def _at(self, place: Place) -> str:
        return self.new(f"getelementptr i8, ptr {place.pointer}, i64 {place.offset}")

    def address(self, place: Place, base: int, strides: Dims, kind: str) -> str:
        """Appends the address of an array's entry in the first lane; returns its name.

        The array is at `place` and has numbers of type `kind`. The flat index of the
        entry is `base`, plus loop index times stride, summed over the loops.
        """
        size = BYTES[kind]
        at = self.new(
            f"getelementptr i8, ptr {place.pointer}, i64 {place.offset + base * size}"
        )
        for index, stride in zip(self.indices, strides, strict=True):
            if stride == 0 or index == "0":
                continue
            if stride != 1:
                index = self.new(f"mul i64 {index}, {stride}")
            one = "i8" if kind == "b1" else TYPES[kind]
            at = self.new(f"getelementptr {one}, ptr {at}, i64 {index}")
        return at

    def _load_one(self, at: str, kind: str) -> str:
        one = "i8" if kind == "b1" else TYPES[kind]
        found = self.new(f"load {one}, ptr {at}, align {BYTES[kind]}")
        return self.new(f"icmp ne i8 {found}, 0") if kind == "b1" else found

    def _load(self, place: Place, base: int, strides: Dims, kind: str) -> str:
        """Appends the load of a vector, outside all loops whose index it does not need.

        Place, flat index and type are those of `address`.

        Returns:
            The name of the vector.
        """
        deepest = max(
            (axis for axis, stride in enumerate(strides) if stride), default=-1
        )
        lines, self.lines = self.lines, self.before[deepest + 1]
        at = self.address(place, base, strides, kind)
        inner = strides[-1] if strides else 0
        if inner == 0 or self.width == 1:
            name = self.spread(self._load_one(at, kind), kind)
        elif inner == 1:
            one = "i8" if kind == "b1" else TYPES[kind]
            many = f"<{self.width} x {one}>"
            name = self.new(f"load {many}, ptr {at}, align {BYTES[kind]}")
            if kind == "b1":
                name = self.new(f"icmp ne {many} {name}, zeroinitializer")
        else:
            name, one = "poison", TYPES[kind]
            for lane in range(self.width):
                beside = self.new(
                    f"getelementptr i8, ptr {at}, i64 {lane * inner * BYTES[kind]}"
                )
                number = self._load_one(beside, kind)
                name = self.new(
                    f"insertelement {self.type(kind)} {name}, {one} {number}, "
                    f"i64 {lane}"
                )
        self.lines = lines
        return name

    def _store(
        self, name: str, place: Place, base: int, strides: Dims, kind: str
    ) -> None:
        at = self.address(place, base, strides, kind)
        inner = strides[-1] if strides else 1
        many = self.type(kind)
        if kind == "b1":
            wide = "i8" if self.width == 1 else f"<{self.width} x i8>"
            name = self.new(f"zext {many} {name} to {wide}")
            many, kind = wide, "u8"
        if inner == 1 or self.width == 1:
            self.lines.append(f"store {many} {name}, ptr {at}, align {BYTES[kind]}")
            return
        for lane in range(self.width):
            number = self.new(f"extractelement {many} {name}, i64 {lane}")
            beside = self.new(
                f"getelementptr i8, ptr {at}, i64 {lane * inner * BYTES[kind]}"
            )
            self.lines.append(
                f"store {TYPES[kind]} {number}, ptr {beside}, align {BYTES[kind]}"
            )

    def operation(self, node: int) -> str:
        """Appends the lines of one node's operation; returns the name of its value."""
        kind = self.graph.kinds[node]
        whole = self.width * BYTES[kind] == self.vector_bytes == WIDEST
        if self.graph.operations[node] == "rsqrt" and whole:
            (given,) = self.graph.arguments[node]
            return self._reciprocal_root(self.value(given), kind)
        return super().operation(node)

    def _reciprocal_root(self, given: str, kind: str) -> str:
        """Appends 1 / sqrt of a whole AVX-512 register; returns the result's name.

        It is the processor's estimate of 14 bits, and two Newton steps (one in single
        precision): within 2 units in the last place, and three times as fast as a root
        and a division. At zero, at infinity and below zero it is the estimate, which is
        exact there; below the smallest normal number it has 14 bits.
        """
        many, letter = self.type(kind), "d" if kind == "f64" else "s"
        lanes = f"i{max(self.width, 8)}"
        name = f"@llvm.x86.avx512.rsqrt14.p{letter}.512"
        self.declared.add(f"declare {many} {name}({many}, {many}, {lanes})")
        first = self.new(
            f"call {many} {name}({many} {given}, {many} zeroinitializer, {lanes} -1)"
        )
        made = first
        one, half = self.literal(1, kind), self.literal(0.5, kind)
        for _ in range(2 if kind == "f64" else 1):
            scaled = self._float("mul", [given, made], kind)
            square = self._float("mul", [scaled, made], kind)
            error = self._float("sub", [one, square], kind)
            part = self._float("mul", [half, made], kind)
            change = self._float("mul", [part, error], kind)
            made = self._float("add", [made, change], kind)
        limits = np.finfo(DTYPES[kind])
        above = self._compare("ge", [given, self.literal(limits.tiny, kind)], kind)
        below = self._compare("le", [given, self.literal(limits.max, kind)], kind)
        usual = self._whole("and", [above, below], "b1")
        return self._select([usual, made, first], kind)

    def _gather(self, node: int) -> str:
        graph = self.graph
        table, index = graph.arguments[node]
        base, kind = graph.extras[node], graph.kinds[node]
        place = self.schedule.place(table)
        assert place is not None
        at = self._at(Place(place.pointer, place.offset + base * BYTES[kind]))
        places = self.value(index)
        if self.width > 1 and self._slope(index) == 1:
            return self._consecutive(at, places, kind)
        return self.gathered(at, places, kind)

    def _slope(self, node: int, depth: int = 0) -> int | None:
        """Difference of neighbouring numbers of a node along the row, if it is known.

        It is the same everywhere along the row, and `None` if it is not known. `depth`
        counts the operations between the index of a gather and the node.
        """
        graph = self.graph
        if graph.value(node) is not None or not graph.dims[node]:
            return 0
        operation = graph.operations[node]
        if operation == "iota":
            return int(graph.extras[node] == len(graph.dims[node]) - 1)
        if operation == "view":
            return None if graph.extras[node][1][-1] else 0
        if operation in STORED or operation == "gather" or depth == DEEPEST:
            return None
        slopes = [self._slope(one, depth + 1) for one in graph.arguments[node]]
        if None in slopes:
            return None
        if operation == "add":
            return sum(slope or 0 for slope in slopes)
        return None if any(slopes) else 0

    def _consecutive(self, at: str, places: str, kind: str) -> str:
        """Appends the load of consecutive numbers; returns the vector's name.

        Pointer, indices and type are those of `gathered`. Only the first index is used.
        """
        first = self.new(f"extractelement <{self.width} x i32> {places}, i64 0")
        one = "i8" if kind == "b1" else TYPES[kind]
        begin = self.new(f"getelementptr {one}, ptr {at}, i32 {first}")
        many = f"<{self.width} x {one}>"
        name = self.new(f"load {many}, ptr {begin}, align {BYTES[kind]}")
        if kind == "b1":
            name = self.new(f"icmp ne {many} {name}, zeroinitializer")
        return name

    def gathered(self, at: str, places: str, kind: str) -> str:
        """Appends the load of a number in each lane; returns the vector's name.

        Args:
            at: Name of the pointer to an array.
            places: Name of the indices in it, of type `i32`.
            kind: Type of the numbers, such as `"f32"`.
        """
        one = "i8" if kind == "b1" else TYPES[kind]
        if self.width == 1:
            at = self.new(f"getelementptr {one}, ptr {at}, i32 {places}")
            return self._load_one(at, kind)
        many = f"<{self.width} x i32>"
        return self.entries(
            self.new(f"getelementptr {one}, ptr {at}, {many} {places}"), kind
        )

    def _loop(self, number: int, loop: Loop) -> Lines:
        if loop.scatters:
            return self._scatters(number, loop)
        if loop.packed:
            return write_packed(self, number, loop)
        if loop.recurrence is not None:
            return write_recurrence(self, number, loop.recurrence)
        if loop.nested is not None:
            return self._function_call(number, loop.nested)
        if not loop.dims:
            return self._straight(loop)
        return self._nest(number, loop)

    def _function_call(self, number: int, node: int) -> Lines:
        """Returns the lines of a loop whose rounds are calls of a function.

        `number` distinguishes its labels; `node` is the node of the loop.
        """
        lines: Lines = []
        self.width, self.dims, self.indices = 1, (), []
        self.lines, self.before = lines, [lines]
        self.names, self.spreads = {}, {}
        made = self.graph.extras[node]
        made.write(self, f"n{number}", self.graph.arguments[node])
        return lines

    def _straight(self, loop: Loop) -> Lines:
        """Returns the lines of all operations on single numbers in one level.

        Levels are those of the schedule; `loop` has the operations.
        """
        self.width, self.dims, self.indices = 1, (), []
        lines: Lines = []
        self.lines = lines
        self.before = [lines]
        self.names, self.spreads = {}, {}
        graph, schedule = self.graph, self.schedule
        for fill in schedule.fills.get(loop.level, ()):
            self._fill(fill)
        for node in loop.nodes:
            self.numbers[node] = self._computed(node)
            if node in schedule.fresh:
                place = schedule.place(node)
                assert place is not None
                self._store(self.numbers[node], place, 0, (), graph.kinds[node])
        for goal in loop.goals:
            self._write(goal)
        return lines

    def _fill(self, fill: Fill) -> None:
        graph, node = self.graph, fill.node
        place = self.schedule.place(node)
        assert place is not None
        number = self.value(graph.arguments[node][-1])
        self.call_fill(number, place, graph.kinds[node], fill)

    def call_fill(self, number: str, place: Place, kind: str, fill: Fill) -> None:
        """Appends a call that writes one number, of type `kind`, to many entries."""
        one = TYPES[kind]
        if kind == "b1":
            number, one = self.new(f"zext i1 {number} to i8"), "i8"
        self.fills.add(one)
        self.lines.append(fill_call(number, place, kind, fill, self.given))

    def _width_of(self, loop: Loop) -> int:
        """Lanes of the vectors of a loop: as many as fit a register and the row."""
        kinds = {self.graph.kinds[node] for node in (*loop.nodes, *loop.reductions)}
        kinds |= {self.graph.kinds[goal.node] for goal in loop.goals}
        widest = max((BYTES[kind] for kind in kinds), default=4)
        lanes = self.vector_bytes // max(widest, 4)
        return min(lanes, 1 << (loop.dims[-1].bit_length() - 1))

    def _nest(self, number: int, loop: Loop) -> Lines:
        """Returns the lines of a loop over a row, and of the loops around it.

        `number` distinguishes its labels from those of other loops.
        """
        graph, schedule = self.graph, self.schedule
        dims = self.dims = loop.dims
        depth = len(dims)
        self.width = self._width_of(loop)
        rounds = -(-dims[-1] // self.width)
        marks = [f"g{number}_{axis}" for axis in range(depth)]
        self.indices = [f"%i_{mark}" for mark in marks]
        if rounds == 1:
            self.indices[-1] = "0"
        self.before = [[] for _ in range(depth + 1)]
        self.behind = [[] for _ in range(depth + 1)]
        self.names, self.spreads = {}, {}
        body = self.lines = self.before[depth]
        first_line = 0
        if loop.mask is not None:
            some = self._anywhere(self.value(loop.mask))
            first_line = len(body)
        for node in loop.nodes:
            self.names[node] = self._computed(node)
            if schedule.is_kept(node):
                place = schedule.place(node)
                assert place is not None
                strides = row_major(graph.dims[node])
                self._store(self.names[node], place, 0, strides, graph.kinds[node])
        for goal in loop.goals:
            self._write(goal)
        phis: Lines = []
        finish: list[Callable[[], None]] = []
        for node in loop.reductions:
            self._reduce(node, marks[-1], rounds, phis, finish)
        # The innermost loop.
        mark = latch = marks[-1]
        if loop.mask is not None:
            latch = f"{mark}_skip"
            body = [
                *body[:first_line],
                f"br i1 {some}, label %{mark}_go, label %{latch}",
                f"{mark}_go:",
                *body[first_line:],
                f"br label %{latch}",
                f"{latch}:",
            ]
        self.lines = self.behind[depth]
        for act in finish:
            act()
        if rounds == 1:
            inner = [*body, *self.behind[depth]]
        else:
            inner = [*self.innermost(mark, latch, dims[-1], phis, body)]
            inner += self.behind[depth]
        for axis in range(depth - 2, -1, -1):
            mark = marks[axis]
            inner = [
                f"br label %{mark}_pre",
                f"{mark}_pre:",
                f"br label %{mark}",
                f"{mark}:",
                f"%i_{mark} = phi i64 [0, %{mark}_pre], [%d_{mark}, %{mark}_end]",
                *self.before[axis + 1],
                *inner,
                f"br label %{mark}_end",
                f"{mark}_end:",
                *self.behind[axis + 1],
                f"%d_{mark} = add i64 %i_{mark}, 1",
                f"%m_{mark} = icmp slt i64 %d_{mark}, {dims[axis]}",
                f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
                f"{mark}_done:",
            ]
        return [*self.before[0], *inner, *self.behind[0]]

    def innermost(
        self, mark: str, latch: str, length: int, phis: Lines, body: Lines
    ) -> Lines:
        """Returns the lines of a loop over a row, in vectors.

        Args:
            mark: Label of the loop.
            latch: Label of the last block of its body.
            length: Length of the row.
            phis: LLVM `phi` lines, at the beginning of each round.
            body: Other lines of a round.
        """
        return [
            f"br label %{mark}_pre",
            f"{mark}_pre:",
            f"br label %{mark}",
            f"{mark}:",
            f"%c_{mark} = phi i64 [0, %{mark}_pre], [%d_{mark}, %{latch}]",
            *phis,
            f"%i_{mark} = call i64 @llvm.smin.i64(i64 %c_{mark}, "
            f"i64 {length - self.width})"
            if length % self.width
            else f"%i_{mark} = add i64 %c_{mark}, 0",
            *body,
            f"%d_{mark} = add i64 %c_{mark}, {self.width}",
            f"%m_{mark} = icmp slt i64 %d_{mark}, {length}",
            f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
            f"{mark}_done:",
        ]

    def latch(self, mark: str) -> str:
        """Returns the label of the last block in the body of a loop with reductions.

        `mark` is the label of the loop.
        """
        return mark

    def after_loop(self, before: str, after: str) -> str:
        """Returns the name of a reduction's total after the loop over a row.

        Args:
            before: Name of the total at the beginning of a round.
            after: Name of the total at the end of a round.
        """
        del before
        return after

    def _anywhere(self, mask: str) -> str:
        """Appends a test whether a mask is true in some lane; returns its name."""
        if self.width == 1:
            return mask
        many = self.type("b1")
        name = f"@llvm.vector.reduce.or.v{self.width}i1"
        self.declared.add(f"declare i1 {name}({many})")
        return self.new(f"call i1 {name}({many} {mask})")

    def _reduce(
        self,
        node: int,
        mark: str,
        rounds: int,
        phis: Lines,
        finish: list[Callable[[], None]],
    ) -> None:
        """Appends a reduction: along the row in registers, along outer axes in memory.

        Args:
            node: Node of the reduction.
            mark: Label of the loop over the row.
            rounds: Number of vectors in the row.
            phis: List to which the loop's `phi` line is added.
            finish: List to which a function is added that appends the lines after the
                loop.
        """
        graph, schedule, dims = self.graph, self.schedule, self.dims
        operation, axes = graph.extras[node]
        (source,) = graph.arguments[node]
        kind, depth = graph.kinds[node], len(dims)
        kept = [axis for axis in range(depth) if axis not in axes]
        own = dict(zip(kept, row_major(graph.dims[node]), strict=True))
        strides = tuple(own.get(axis, 0) for axis in range(depth))
        value = self.value(source)
        if rounds > 1 and dims[-1] % self.width and operation in ("add", "mul", "xor"):
            value = self._without_repeats(value, mark, operation, kind)
        outer = [axis for axis in axes if axis != depth - 1]
        place = schedule.place(node)
        none = identity(operation, kind)
        if outer:
            assert place is not None
            size = math.prod(graph.dims[node])
            lines, self.lines = self.lines, self.before[0]
            self.call_fill(literal(none, kind), place, kind, Fill(node, 0, size))
            self.synchronise()
            self.lines = lines
        if depth - 1 not in axes:
            assert place is not None
            at = self.address(place, 0, strides, kind)
            many = self._memory_type(kind)
            old = self._from_memory(
                self.new(f"load {many}, ptr {at}, align {BYTES[kind]}"), kind
            )
            made = self._combined(operation, old, value, kind)
            self._store(made, place, 0, strides, kind)
            return
        if rounds > 1:
            start = self.literal(none, kind)
            self.count += 1
            old = f"%a{self.count}"
            made = self._combined(operation, old, value, kind)
            phis.append(
                f"{old} = phi {self.type(kind)} [{start}, %{mark}_pre], "
                f"[{made}, %{self.latch(mark)}]"
            )
            made = self.after_loop(old, made)
        else:
            made = value

        def ending() -> None:
            total = self.across(operation, made, kind, rounds)
            if depth == 1:
                self.numbers[node] = total
                if node in schedule.fresh:
                    self._one_lane_store(total, schedule.place(node), (), kind)
                return
            outside = strides[:-1]
            assert place is not None
            if outer:
                self.one_by_one(f"{mark}_{node}", lambda: add(total))
            else:
                self._one_lane_store(total, place, outside, kind)
            if not graph.dims[node]:
                lines, self.lines = self.lines, self.behind[0]
                self.synchronise()
                self.numbers[node] = self._load_one(self._at(place), kind)
                self.lines = lines

        def add(total: str) -> None:
            assert place is not None
            outside = strides[:-1]
            width, self.width = self.width, 1
            indices, self.indices = self.indices, self.indices[:-1]
            at = self.address(place, 0, outside, kind)
            before = self._load_one(at, kind)
            total = self._combined(operation, before, total, kind)
            self.width, self.indices = width, indices
            self._one_lane_store(total, place, outside, kind)

        finish.append(ending)

    def _memory_type(self, kind: str) -> str:
        one = "i8" if kind == "b1" else TYPES[kind]
        return one if self.width == 1 else f"<{self.width} x {one}>"

    def _from_memory(self, name: str, kind: str) -> str:
        if kind != "b1":
            return name
        many = self._memory_type(kind)
        zero = "0" if self.width == 1 else "zeroinitializer"
        return self.new(f"icmp ne {many} {name}, {zero}")

    def _one_lane_store(
        self, name: str, place: Place | None, strides: Dims, kind: str
    ) -> None:
        assert place is not None
        width, self.width = self.width, 1
        indices, self.indices = self.indices, self.indices[: len(strides)]
        at = self.address(place, 0, strides, kind)
        if kind == "b1":
            name = self.new(f"zext i1 {name} to i8")
        one = "i8" if kind == "b1" else TYPES[kind]
        self.lines.append(f"store {one} {name}, ptr {at}, align {BYTES[kind]}")
        self.width, self.indices = width, indices

    def _without_repeats(self, value: str, mark: str, operation: str, kind: str) -> str:
        """Replaces repeated lanes of a row's last vector by the identity element.

        The last vector of a row overlaps with the one before if the width does not
        divide the length of the row. `value` is the name of the vector, `mark` the
        label of the loop. Returns the name of the result.
        """
        many = f"<{self.width} x i64>"
        over = self.new(f"sub i64 %c_{mark}, %i_{mark}")
        first = self.new(f"insertelement {many} poison, i64 {over}, i64 0")
        zeros = f"<{self.width} x i32> zeroinitializer"
        first = self.new(f"shufflevector {many} {first}, {many} poison, {zeros}")
        lanes = "<" + ", ".join(f"i64 {i}" for i in range(self.width)) + ">"
        fresh = self.new(f"icmp sge {many} {lanes}, {first}")
        none = self.literal(identity(operation, kind), kind)
        return self._select([fresh, value, none], kind)

    def across(self, operation: str, value: str, kind: str, rounds: int) -> str:
        """Appends the reduction of a vector to one number; returns its name.

        Halves of the vector are combined, then halves of the result, and so on.

        Args:
            operation: Operation that combines two numbers.
            value: Name of the vector.
            kind: Type of the numbers, such as `"f32"`.
            rounds: Number of vectors in the row.
        """
        del rounds
        width = self.width
        while self.width > 1:
            many, half = self.type(kind), self.width // 2
            parts = []
            for begin in (0, half):
                lanes = ", ".join(f"i32 {begin + i}" for i in range(half))
                parts.append(
                    self.new(
                        f"shufflevector {many} {value}, {many} poison, "
                        f"<{half} x i32> <{lanes}>"
                    )
                )
            self.width = half
            if half == 1:
                one = TYPES[kind]
                parts = [
                    self.new(f"extractelement <1 x {one}> {part}, i64 0")
                    for part in parts
                ]
            value = self._combined(operation, parts[0], parts[1], kind)
        self.width = width
        return value

    def _scatters(self, number: int, loop: Loop) -> Lines:
        """Returns the lines of scatters with the same indices, number by number.

        `number` distinguishes the labels of their loop from those of other loops.
        """
        graph, schedule = self.graph, self.schedule
        self.width, self.dims = 1, ()
        self.names, self.spreads, self.indices = {}, {}, []
        lines: Lines = []
        self.lines = lines
        self.before = [lines]
        for node in loop.scatters:
            self.begin_scatter(node)
        index = graph.arguments[loop.scatters[0]][1]
        rounds = graph.extras[loop.scatters[0]][1]
        mark = f"g{number}"
        body: Lines = []
        numbers = dict(self.numbers)
        self.synchronise()
        self.lines, self.before = body, [lines, body]
        self.dims, self.indices = (rounds,), [f"%i_{mark}"]
        mask = graph.arguments[loop.scatters[0]][3:]
        if mask:
            there = self.stored_number(mask[0])
            body.append(f"br i1 {there}, label %{mark}_go, label %{mark}_skip")
            body.append(f"{mark}_go:")
        at = self.stored_number(index)
        for node in loop.scatters:
            kind, operation = graph.kinds[node], graph.extras[node][0]
            update = graph.arguments[node][2]
            number_ = self.stored_number(update)
            place = schedule.place(node)
            assert place is not None
            one = "i8" if kind == "b1" else TYPES[kind]
            base = self._at(place)
            target = self.new(f"getelementptr {one}, ptr {base}, i32 {at}")
            if operation != "set":
                old = self._load_one(target, kind)
                number_ = self._combined(operation, old, number_, kind)
            if kind == "b1":
                number_ = self.new(f"zext i1 {number_} to i8")
            self.lines.append(
                f"store {one} {number_}, ptr {target}, align {BYTES[kind]}"
            )
        # Numbers loaded in a round that may be skipped are undefined after it.
        self.numbers = numbers
        self.lines = lines
        self.one_by_one(
            mark,
            lambda: lines.extend(
                [
                    f"br label %{mark}_pre",
                    f"{mark}_pre:",
                    f"br label %{mark}",
                    f"{mark}:",
                    f"%i_{mark} = phi i64 [0, %{mark}_pre], [%d_{mark}, %{mark}_skip]",
                    *body,
                    f"br label %{mark}_skip",
                    f"{mark}_skip:",
                    f"%d_{mark} = add i64 %i_{mark}, 1",
                    f"%m_{mark} = icmp slt i64 %d_{mark}, {rounds}",
                    f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
                    f"{mark}_done:",
                ]
            ),
        )
        return lines

    def begin_scatter(self, node: int) -> None:
        """Appends a copy of the row of a scatter before it to the row of its result."""
        graph, schedule = self.graph, self.schedule
        into, kind = graph.arguments[node][0], graph.kinds[node]
        (count,) = graph.dims[node]
        place = schedule.place(node)
        assert place is not None
        known = graph.value(into)
        if known is not None:
            self.call_fill(literal(known, kind), place, kind, Fill(node, 0, count))
            return
        if graph.operations[into] == "view":
            (stored,) = graph.arguments[into]
            begin = graph.extras[into][0]
        else:
            stored, begin = into, 0
        source = schedule.place(stored)
        assert source is not None
        source = Place(source.pointer, source.offset + begin * BYTES[kind])
        self.copy(self._at(place), self._at(source), count, kind)

    def copy(self, to: str, source: str, count: int, kind: str) -> None:
        """Appends a copy of numbers from memory to memory.

        Args:
            to: Name of the pointer to which they are copied.
            source: Name of the pointer from which they are copied.
            count: Count of numbers.
            kind: Type of the numbers, such as `"f32"`.
        """
        size = count * BYTES[kind]
        self.declared.add("declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
        self.lines.append(
            f"call void @llvm.memcpy.p0.p0.i64(ptr {to}, ptr {source}, i64 {size}, "
            "i1 false)"
        )

    def stored_number(self, node: int) -> str:
        """Returns the name of the variable that holds a node's value at the loop index.

        It returns the literal if the node is constant.
        """
        graph = self.graph
        known = graph.value(node)
        if known is not None:
            return self.literal(known, graph.kinds[node])
        return self._read(node) if graph.dims[node] else self._number(node)


def fill_call(number: str, place: Place, kind: str, fill: Fill, given: str = "") -> str:
    """Returns LLVM IR of a call that writes one number to many entries of an array.

    Args:
        number: Name of the number, or its text; booleans are bytes.
        place: Memory location of the array.
        kind: Type of the number, such as `"f32"`.
        fill: Entries that are written.
        given: LLVM text of the first arguments of the call.
    """
    one, size = ("i8", 1) if kind == "b1" else (TYPES[kind], BYTES[kind])
    at = place.offset + fill.first * size
    return (
        f"call void @fill_{one}({given}ptr {place.pointer}, i64 {at}, {one} {number}, "
        f"i64 {fill.count}, i64 {fill.runs}, i64 {fill.stride})"
    )


def fill_text(one: str) -> str:
    """Returns LLVM IR of a function that writes one number to runs of entries.

    Run j begins at entry j times `%stride` and has `%count` entries. They are written a
    vector at a time, and those that do not fill a vector one after another. `one` is
    the LLVM type of the number.
    """
    size = SIZES[one]
    width = WIDEST // size
    many = f"<{width} x {one}>"
    return f"""
define internal void @fill_{one}(ptr %to, i64 %offset, {one} %number, i64 %count,
    i64 %runs, i64 %stride) nounwind {{
entry:
%start = getelementptr i8, ptr %to, i64 %offset
%first = insertelement {many} poison, {one} %number, i32 0
%vector = shufflevector {many} %first, {many} poison, <{width} x i32> zeroinitializer
%whole = and i64 %count, {-width}
br label %outer
outer:
%j = phi i64 [0, %entry], [%j1, %outer_end]
%begin = mul i64 %j, %stride
%row = getelementptr {one}, ptr %start, i64 %begin
%some = icmp sgt i64 %whole, 0
br i1 %some, label %vectors, label %rest
vectors:
%k = phi i64 [0, %outer], [%k1, %vectors]
%there = getelementptr {one}, ptr %row, i64 %k
store {many} %vector, ptr %there, align {size}
%k1 = add i64 %k, {width}
%further = icmp slt i64 %k1, %whole
br i1 %further, label %vectors, label %rest
rest:
%done = phi i64 [0, %outer], [%whole, %vectors]
%left = icmp slt i64 %done, %count
br i1 %left, label %loop, label %outer_end
loop:
%i = phi i64 [%done, %rest], [%next, %loop]
%at = getelementptr {one}, ptr %row, i64 %i
store {one} %number, ptr %at
%next = add i64 %i, 1
%more = icmp slt i64 %next, %count
br i1 %more, label %loop, label %outer_end
outer_end:
%j1 = add i64 %j, 1
%again = icmp slt i64 %j1, %runs
br i1 %again, label %outer, label %end
end:
ret void
}}
"""
