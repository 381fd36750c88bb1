"""LLVM IR of packed loops: sums over the entries alone where a mask is true.

First the indices of these entries are listed. Then a loop over the list computes a
vector of entries at a time. Rows that are read at the same indices are first written
beside each other, so that the numbers of an entry are adjacent: a vector is loaded for
each entry, and vectors of entries are transposed to vectors of numbers in registers.
Numbers that are added at the same index are added as a vector too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from jaxrod.lanes.llvm.vector_code import BYTES, TYPES, literal
from jaxrod.lanes.rows.packing import entry_strides
from jaxrod.lanes.rows.row_graph import Dims, row_major
from jaxrod.lanes.rows.schedule import Fill, Loop, Place

Lines = list[str]
At = tuple[str, ...]
"""Names of vectors of indices, one for each axis of a node."""
CHUNK = 64
"""Entries of a mask that are tested together: the bits of a word."""
ROOM = 16
"""Entries of a list beyond those of its mask: a whole vector."""
SPARSE = 8
"""Smallest ratio of the entries of a mask to the length of rows for which the rows are
written beside each other."""
LEAST_BESIDE = 3
"""Smallest number of rows that are written beside each other."""


@dataclass
class _Beside:
    """Rows of equal length in memory, written beside each other: a column for each."""

    length: int
    """Length of the rows."""
    width: int
    """Numbers of a vector."""
    columns: list[Any] = field(default_factory=list)
    """Node of each column: a gather that reads it, or a sum that is in it."""
    place: Place | None = None

    @property
    def blocks(self) -> int:
        """Vectors in which all columns fit."""
        return -(-len(self.columns) // self.width)

    @property
    def row(self) -> int:
        """Numbers from one row to the next."""
        return self.blocks * self.width


def write_packed(writer: Any, number: int, loop: Loop) -> Lines:
    """Returns LLVM IR of a packed loop.

    Args:
        writer: Writer of the function.
        number: Number of the loop, for its labels.
        loop: The loop.
    """
    return _PackedLoop(writer, number, loop).text()


class _PackedLoop:
    """Writer of one packed loop, which appends to another writer's lines."""

    def __init__(self, writer: Any, number: int, loop: Loop) -> None:
        self.writer, self.loop = writer, loop
        self.graph, self.schedule = writer.graph, writer.schedule
        self.packing, self.dims = self.schedule.packing, loop.dims
        self.mark = f"g{number}"
        assert loop.mask is not None
        self.mask: int = loop.mask
        self.names: dict[tuple[int, At], str] = {}
        """Names of vectors, by node and the indices at which it is computed."""
        self.entries: At = ()
        """Names of the vectors of indices from the list."""
        sums = self.packing.sums
        inside = {node: None for one in loop.packed for node in sums[one].inside}
        kinds = {self.graph.kinds[node] for node in (*loop.packed, *inside)}
        widest = max(BYTES[kind] for kind in kinds)
        self.width = min(writer.vector_bytes // max(widest, 4), ROOM)
        floats = {kind for kind in kinds if kind[0] == "f"}
        self.kind = max(floats, key=BYTES.__getitem__)
        entries = math.prod(self.dims) + ROOM
        self.lists = [self.schedule.room(4 * entries) for _ in self.dims]
        self.spare = self.schedule.room(4 * ROOM)
        """Memory through which a vector of indices becomes single numbers."""
        self.read = self._read_beside(list(inside))
        self.added = self._added_beside()

    def _beside(self, groups: dict[Any, list[int]], length: Any) -> list[_Beside]:
        """Returns the groups of rows that are worth writing beside each other.

        `length` is a function from a node to the length of its row.
        """
        made = []
        for nodes in groups.values():
            rows = min(map(length, nodes))
            few = rows * SPARSE <= math.prod(self.dims)
            if len(nodes) < LEAST_BESIDE or rows < self.width or not few:
                continue
            one = _Beside(rows, self.width, nodes)
            size = one.length * one.row * BYTES[self.kind]
            one.place = self.schedule.room(size)
            made.append(one)
        return made if self.width > 1 else []

    def _read_beside(self, inside: Sequence[int]) -> list[_Beside]:
        graph = self.graph
        groups: dict[Any, list[int]] = {}
        for node in inside:
            if graph.operations[node] != "gather" or graph.kinds[node] != self.kind:
                continue
            table, index = graph.arguments[node]
            known = self.schedule.is_stored_before(node, self.loop.level)
            if not known and len(graph.dims[table]) == 1:
                groups.setdefault(index, []).append(node)

        def length(node: int) -> int:
            # The index is inside all rows, so inside the shortest.
            (size,) = graph.dims[graph.arguments[node][0]]
            return int(size - graph.extras[node])

        return self._beside(groups, length)

    def _added_beside(self) -> list[_Beside]:
        graph, sums = self.graph, self.packing.sums
        groups: dict[Any, list[int]] = {}
        for node in self.loop.packed:
            if graph.kinds[node] != self.kind or len(graph.dims[node]) != 1:
                continue
            key: Any = sums[node].index
            if key is None:
                key = entry_strides(graph, node, self.dims)
            elif graph.value(graph.arguments[node][0]) != 0:
                continue
            groups.setdefault(key, []).append(node)
        return self._beside(groups, lambda node: graph.dims[node][0])

    def text(self) -> Lines:
        """Returns the lines: zero sums, the list of entries, the loop over it."""
        writer, graph, mark = self.writer, self.graph, self.mark
        before: Lines = []
        writer.width, writer.dims, writer.indices = 1, (), []
        writer.names, writer.spreads = {}, {}
        writer.lines, writer.before = before, [before]
        apart = {node for group in self.added for node in group.columns}
        for node in self.loop.packed:
            if node not in apart:
                self._begin(node)
        for group in self.added:
            self._clear(group)
        self._list_entries()
        writer.width = self.width
        for i, group in enumerate(self.read):
            self._in_blocks(group, f"{mark}_r{i}", self._put_beside)
        body: Lines = []
        writer.dims = self.dims
        writer.names, writer.spreads = {}, {}
        writer.lines, writer.before = body, [before, body]
        self.entries = tuple(map(self._loaded_entry, self.lists))
        self._add_up()
        after: Lines = []
        writer.lines, writer.before = after, [after]
        for i, group in enumerate(self.added):
            self._in_blocks(group, f"{mark}_s{i}", self._take_apart)
        writer.width, writer.dims = 1, ()
        for node in self.loop.packed:
            if not graph.dims[node]:
                at = self._pointer(self.schedule.place(node))
                one = TYPES[graph.kinds[node]]
                writer.numbers[node] = writer.new(f"load {one}, ptr {at}")
        return [
            *before,
            f"%some_{mark} = icmp sgt i64 %n_{mark}, 0",
            f"br label %{mark}_pre",
            f"{mark}_pre:",
            f"br i1 %some_{mark}, label %{mark}, label %{mark}_done",
            f"{mark}:",
            f"%i_{mark} = phi i64 [0, %{mark}_pre], [%d_{mark}, %{mark}]",
            *body,
            f"%d_{mark} = add i64 %i_{mark}, {self.width}",
            f"%m_{mark} = icmp slt i64 %d_{mark}, %n_{mark}",
            f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
            f"{mark}_done:",
            *after,
        ]

    def _begin(self, node: int) -> None:
        """Appends the sum before all entries: zero, or the row before a scatter."""
        graph = self.graph
        if graph.operations[node] == "scatter":
            self.writer.begin_scatter(node)
            return
        kind, count = graph.kinds[node], math.prod(graph.dims[node])
        place = self.schedule.place(node)
        self.writer.call_fill(literal(0, kind), place, kind, Fill(node, 0, count))

    def _clear(self, group: _Beside) -> None:
        """Appends zeros in all columns of a group."""
        fill = Fill(0, 0, group.length * group.row)
        zero = literal(0, self.kind)
        self.writer.call_fill(zero, group.place, self.kind, fill)

    def _pointer(self, place: Place | None, more: int = 0) -> str:
        assert place is not None
        at = place.offset + more
        return str(self.writer.new(f"getelementptr i8, ptr {place.pointer}, i64 {at}"))

    def _in_blocks(
        self, group: _Beside, mark: str, write: Callable[[_Beside, str], None]
    ) -> None:
        """Appends a loop over the rows of a group, a vector of rows at a time.

        The last vector ends with the rows. `write` appends the lines of one vector, for
        the group and the name of the first row; `mark` is the label of the loop.
        """
        lines: Lines = self.writer.lines
        body: Lines = []
        self.writer.lines = body
        write(group, f"%i_{mark}")
        self.writer.lines = lines
        self.writer.declared.add("declare i64 @llvm.smin.i64(i64, i64)")
        last = group.length - self.width
        lines += [
            f"br label %{mark}_pre",
            f"{mark}_pre:",
            f"br label %{mark}",
            f"{mark}:",
            f"%c_{mark} = phi i64 [0, %{mark}_pre], [%d_{mark}, %{mark}]",
            f"%i_{mark} = call i64 @llvm.smin.i64(i64 %c_{mark}, i64 {last})",
            *body,
            f"%d_{mark} = add i64 %c_{mark}, {self.width}",
            f"%m_{mark} = icmp slt i64 %d_{mark}, {group.length}",
            f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
            f"{mark}_done:",
        ]

    def _row_of(self, group: _Beside, first: str, row: int, block: int) -> str:
        """Appends the address of a block of columns, `row` rows after row `first`."""
        size = BYTES[self.kind]
        more = (row * group.row + block * self.width) * size
        start = self._pointer(group.place, more)
        offset = self.writer.new(f"mul i64 {first}, {group.row * size}")
        return str(self.writer.new(f"getelementptr i8, ptr {start}, i64 {offset}"))

    def _number_of_row(self, place: Place, first: str) -> str:
        start = self._pointer(place)
        one = TYPES[self.kind]
        return str(self.writer.new(f"getelementptr {one}, ptr {start}, i64 {first}"))

    def _put_beside(self, group: _Beside, first: str) -> None:
        """Appends the copy of a vector of rows to the columns of a group."""
        writer, graph = self.writer, self.graph
        many, size = writer.type(self.kind), BYTES[self.kind]
        for block in range(group.blocks):
            begin = block * self.width
            columns = []
            for node in group.columns[begin : begin + self.width]:
                place = self.schedule.place(graph.arguments[node][0])
                place = Place(place.pointer, place.offset + graph.extras[node] * size)
                at = self._number_of_row(place, first)
                columns.append(writer.new(f"load {many}, ptr {at}, align {size}"))
            columns += ["poison"] * (self.width - len(columns))
            for row, name in enumerate(self._transposed(columns)):
                at = self._row_of(group, first, row, block)
                writer.lines.append(f"store {many} {name}, ptr {at}, align {size}")

    def _take_apart(self, group: _Beside, first: str) -> None:
        """Appends the copy of a vector of rows from the columns of a group."""
        writer = self.writer
        many, size = writer.type(self.kind), BYTES[self.kind]
        for block in range(group.blocks):
            rows = [
                writer.new(
                    f"load {many}, ptr {self._row_of(group, first, row, block)}, "
                    f"align {size}"
                )
                for row in range(self.width)
            ]
            begin = block * self.width
            nodes = group.columns[begin : begin + self.width]
            for node, name in zip(nodes, self._transposed(rows), strict=False):
                at = self._number_of_row(self.schedule.place(node), first)
                writer.lines.append(f"store {many} {name}, ptr {at}, align {size}")

    def _transposed(self, names: Sequence[str]) -> list[str]:
        """Appends the transposition of vectors; returns the names of the results.

        There are as many vectors as a vector has numbers. Number i of vector j becomes
        number j of vector i.
        """
        writer, made = self.writer, list(names)
        many, width = writer.type(self.kind), len(names)
        step = 1
        while step < width:
            old = list(made)
            for i in range(width):
                if i & step:
                    continue
                a, b = old[i], old[i + step]
                for to, high in ((i, 0), (i + step, step)):
                    from_b = width - step
                    lanes = ", ".join(
                        f"i32 {lane + high + (from_b if lane & step else 0)}"
                        for lane in range(width)
                    )
                    made[to] = writer.new(
                        f"shufflevector {many} {a}, {many} {b}, "
                        f"<{width} x i32> <{lanes}>"
                    )
            step *= 2
        return made

    def _list_entries(self) -> None:
        """Appends the loops that list the indices at which the mask is true."""
        writer, graph, mark = self.writer, self.graph, self.mark
        base, strides = 0, row_major(self.dims)
        place = self.schedule.place(self.mask)
        if place is None:
            (source,) = graph.arguments[self.mask]
            base, strides = graph.extras[self.mask]
            place = self.schedule.place(source)
        length = self.dims[-1]
        width = min(CHUNK, 1 << (length.bit_length() - 1))
        lists = [self._pointer(place) for place in self.lists]
        start = self._pointer(place, base)
        outer = len(self.dims) == 2
        lines = writer.lines
        lines += [f"br label %{mark}_a", f"{mark}_a:"]
        if outer:
            lines += [
                f"br label %{mark}_o",
                f"{mark}_o:",
                f"%o_{mark} = phi i64 [0, %{mark}_a], [%oo_{mark}, %{mark}_oend]",
                f"%no_{mark} = phi i64 [0, %{mark}_a], [%nc_{mark}, %{mark}_oend]",
                f"%ro_{mark} = mul i64 %o_{mark}, {strides[0]}",
                f"%row_{mark} = getelementptr i8, ptr {start}, i64 %ro_{mark}",
                f"%ot_{mark} = trunc i64 %o_{mark} to i32",
            ]
        row = f"%row_{mark}" if outer else start
        origin, first = (f"{mark}_o", f"%no_{mark}") if outer else (f"{mark}_a", "0")
        word = f"i{width}"
        widened = f"%b_{mark} = zext {word} %w_{mark} to i64"
        if width == 64:
            widened = f"%b_{mark} = or i64 %w_{mark}, 0"
        writer.declared |= {
            "declare i64 @llvm.cttz.i64(i64, i1)",
            "declare i64 @llvm.smin.i64(i64, i64)",
        }
        lines += [
            f"br label %{mark}_c",
            f"{mark}_c:",
            f"%c_{mark} = phi i64 [0, %{origin}], [%cc_{mark}, %{mark}_cend]",
            f"%na_{mark} = phi i64 [{first}, %{origin}], [%nc_{mark}, %{mark}_cend]",
            # The last chunk ends with the row: entries that were already in the chunk
            # before are shifted out.
            f"%e_{mark} = call i64 @llvm.smin.i64(i64 %c_{mark}, i64 {length - width})",
            f"%at_{mark} = getelementptr i8, ptr {row}, i64 %e_{mark}",
            f"%y_{mark} = load <{width} x i8>, ptr %at_{mark}, align 1",
            f"%t_{mark} = icmp ne <{width} x i8> %y_{mark}, zeroinitializer",
            f"%w_{mark} = bitcast <{width} x i1> %t_{mark} to {word}",
            widened,
            f"%over_{mark} = sub i64 %c_{mark}, %e_{mark}",
            f"%bs_{mark} = lshr i64 %b_{mark}, %over_{mark}",
            f"%any_{mark} = icmp ne i64 %bs_{mark}, 0",
            f"br i1 %any_{mark}, label %{mark}_b, label %{mark}_cend",
            f"{mark}_b:",
            f"%bits_{mark} = phi i64 [%bs_{mark}, %{mark}_c], "
            f"[%less_{mark}, %{mark}_b]",
            f"%nb_{mark} = phi i64 [%na_{mark}, %{mark}_c], [%nn_{mark}, %{mark}_b]",
            f"%z_{mark} = call i64 @llvm.cttz.i64(i64 %bits_{mark}, i1 true)",
            f"%j_{mark} = add i64 %c_{mark}, %z_{mark}",
            f"%jt_{mark} = trunc i64 %j_{mark} to i32",
            f"%p_{mark} = getelementptr i32, ptr {lists[-1]}, i64 %nb_{mark}",
            f"store i32 %jt_{mark}, ptr %p_{mark}, align 4",
        ]
        if outer:
            lines += [
                f"%po_{mark} = getelementptr i32, ptr {lists[0]}, i64 %nb_{mark}",
                f"store i32 %ot_{mark}, ptr %po_{mark}, align 4",
            ]
        lines += [
            f"%nn_{mark} = add i64 %nb_{mark}, 1",
            f"%minus_{mark} = sub i64 %bits_{mark}, 1",
            f"%less_{mark} = and i64 %bits_{mark}, %minus_{mark}",
            f"%more_{mark} = icmp ne i64 %less_{mark}, 0",
            f"br i1 %more_{mark}, label %{mark}_b, label %{mark}_cend",
            f"{mark}_cend:",
            f"%nc_{mark} = phi i64 [%na_{mark}, %{mark}_c], [%nn_{mark}, %{mark}_b]",
            f"%cc_{mark} = add i64 %c_{mark}, {width}",
            f"%cm_{mark} = icmp slt i64 %cc_{mark}, {length}",
        ]
        if outer:
            lines += [
                f"br i1 %cm_{mark}, label %{mark}_c, label %{mark}_oend",
                f"{mark}_oend:",
                f"%oo_{mark} = add i64 %o_{mark}, 1",
                f"%om_{mark} = icmp slt i64 %oo_{mark}, {self.dims[0]}",
                f"br i1 %om_{mark}, label %{mark}_o, label %{mark}_listed",
            ]
        else:
            lines.append(f"br i1 %cm_{mark}, label %{mark}_c, label %{mark}_listed")
        lines += [f"{mark}_listed:", f"%n_{mark} = add i64 %nc_{mark}, 0"]
        for pointer in lists:
            # The last vector of entries may go beyond the list.
            at = writer.new(f"getelementptr i32, ptr {pointer}, i64 %n_{mark}")
            lines.append(f"store <{ROOM} x i32> zeroinitializer, ptr {at}, align 4")

    def _loaded_entry(self, place: Place) -> str:
        writer, start = self.writer, self._pointer(place)
        at = writer.new(f"getelementptr i32, ptr {start}, i64 %i_{self.mark}")
        return str(writer.new(f"load {writer.type('i32')}, ptr {at}, align 4"))

    def _there(self) -> str:
        """Appends the mask of the lanes that are in the list; returns its name."""
        writer, width = self.writer, self.width
        left = writer.new(f"sub i64 %n_{self.mark}, %i_{self.mark}")
        spread = writer.spread(left, "i64")
        lanes = ", ".join(f"i64 {lane}" for lane in range(width))
        lanes = f"<{lanes}>" if width > 1 else "0"
        return str(writer.new(f"icmp slt {writer.type('i64')} {lanes}, {spread}"))

    def _add_up(self) -> None:
        """Appends the addition of a vector of entries to all sums."""
        there = self._there()
        numbers = {node: self._term(node, there) for node in self.loop.packed}
        apart: dict[str, list[int]] = {}
        beside = {node for group in self.added for node in group.columns}
        for node in self.loop.packed:
            if node not in beside:
                apart.setdefault(self._target(node), []).append(node)
        for group in self.added:
            indices = self._singles(self._target(group.columns[0]))
            self._add_beside(group, indices, numbers)
        for target, nodes in apart.items():
            indices = self._singles(target)
            for lane, index in enumerate(indices):
                for node in nodes:
                    self._add_one(node, numbers[node], lane, index)

    def _term(self, node: int, there: str) -> str:
        """Appends the numbers that entries add to a sum, zero where no entry is."""
        writer, kind = self.writer, self.graph.kinds[node]
        many, total = writer.type(kind), ""
        for sign, term in self.packing.sums[node].terms:
            name = self.value(term, self.entries)
            if sign < 0:
                name = writer.new(f"fneg {many} {name}")
            total = writer.new(f"fadd {many} {total}, {name}") if total else name
        zero = writer.literal(0, kind)
        truth = writer.type("b1")
        return str(writer.new(f"select {truth} {there}, {many} {total}, {many} {zero}"))

    def _target(self, node: int) -> str:
        """Appends the indices in a sum at which the entries are added."""
        index = self.packing.sums[node].index
        if index is None:
            strides = entry_strides(self.graph, node, self.dims)
            return self._flat(self.entries, 0, strides)
        return self.value(index, self.entries[-1:])

    def _singles(self, vector: str) -> list[str]:
        """Appends the indices of a vector as single numbers; returns their names."""
        writer = self.writer
        if self.width == 1:
            return [vector]
        at = self._pointer(self.spare)
        writer.lines.append(f"store {writer.type('i32')} {vector}, ptr {at}, align 4")
        ats = [self._pointer(self.spare, 4 * lane) for lane in range(self.width)]
        return [writer.new(f"load i32, ptr {at}, align 4") for at in ats]

    def _add_one(self, node: int, name: str, lane: int, index: str) -> None:
        """Appends the addition of one lane of a vector to a sum at an index."""
        writer, kind = self.writer, self.graph.kinds[node]
        one, size = TYPES[kind], BYTES[kind]
        if self.width > 1:
            many = writer.type(kind)
            name = writer.new(f"extractelement {many} {name}, i64 {lane}")
        start = self._pointer(self.schedule.place(node))
        at = writer.new(f"getelementptr {one}, ptr {start}, i32 {index}")
        old = writer.new(f"load {one}, ptr {at}, align {size}")
        new = writer.new(f"fadd {one} {old}, {name}")
        writer.lines.append(f"store {one} {new}, ptr {at}, align {size}")

    def _add_beside(
        self, group: _Beside, indices: Sequence[str], numbers: dict[int, str]
    ) -> None:
        """Appends the addition of vectors to the columns of a group.

        Args:
            group: The group, whose columns are sums.
            indices: Row of each lane.
            numbers: Vector of numbers for each sum.
        """
        writer = self.writer
        many, size = writer.type(self.kind), BYTES[self.kind]
        wide = [writer.new(f"sext i32 {index} to i64") for index in indices]
        for block in range(group.blocks):
            begin = block * self.width
            nodes = group.columns[begin : begin + self.width]
            names = [numbers[node] for node in nodes]
            names += [writer.literal(0, self.kind)] * (self.width - len(names))
            for index, name in zip(wide, self._transposed(names), strict=True):
                at = self._row_of(group, index, 0, block)
                old = writer.new(f"load {many}, ptr {at}, align {size}")
                new = writer.new(f"fadd {many} {old}, {name}")
                writer.lines.append(f"store {many} {new}, ptr {at}, align {size}")

    def value(self, node: int, at: At) -> str:
        """Returns the name of a node's numbers at the indices `at` along its axes."""
        graph = self.graph
        if graph.value(node) is not None or not graph.dims[node]:
            return str(self.writer.value(node))
        key = node, at
        if key not in self.names:
            self.names[key] = self._computed(node, at)
        return self.names[key]

    def _computed(self, node: int, at: At) -> str:
        writer, graph, schedule = self.writer, self.graph, self.schedule
        operation, kind = graph.operations[node], graph.kinds[node]
        if operation == "iota":
            return self._converted(at[graph.extras[node]], kind)
        if operation == "view":
            return self._of_view(node, at)
        if schedule.is_stored_before(node, self.loop.level):
            flat = self._flat(at, 0, row_major(graph.dims[node]))
            return self._gathered(schedule.place(node), 0, flat, kind)
        if operation == "gather":
            for group in self.read:
                if node in group.columns:
                    self._load_group(group, at)
                    return self.names[node, at]
            table, index = graph.arguments[node]
            place = schedule.place(table)
            return self._gathered(
                place, graph.extras[node], self.value(index, at), kind
            )
        if at == self.entries and self.packing.is_chosen(node, self.mask):
            return self.value(graph.arguments[node][1], at)
        names = {a: self.value(a, at) for a in graph.arguments[node]}
        writer.names = names
        made = str(writer.operation(node))
        writer.names = {}
        return made

    def _of_view(self, node: int, at: At) -> str:
        graph, schedule = self.graph, self.schedule
        (source,) = graph.arguments[node]
        base, strides = graph.extras[node]
        known = schedule.is_stored_before(source, self.loop.level)
        if self.packing.is_followed(node) and not known:
            return self.value(source, (self._flat(at, base, strides),))
        flat = self._flat(at, 0, strides)
        return self._gathered(schedule.place(source), base, flat, graph.kinds[node])

    def _load_group(self, group: _Beside, at: At) -> None:
        """Appends the loads of all columns of a group, at the indices `at`."""
        writer, graph = self.writer, self.graph
        many, size = writer.type(self.kind), BYTES[self.kind]
        index = self.value(graph.arguments[group.columns[0]][1], at)
        singles = self._singles(index)
        wide = [writer.new(f"sext i32 {one} to i64") for one in singles]
        for block in range(group.blocks):
            rows = [
                writer.new(
                    f"load {many}, ptr {self._row_of(group, one, 0, block)}, "
                    f"align {size}"
                )
                for one in wide
            ]
            begin = block * self.width
            nodes = group.columns[begin : begin + self.width]
            for node, name in zip(nodes, self._transposed(rows), strict=False):
                self.names[node, at] = name

    def _converted(self, index: str, kind: str) -> str:
        writer = self.writer
        before, after = writer.type("i32"), writer.type(kind)
        if kind[0] == "f":
            return str(writer.new(f"sitofp {before} {index} to {after}"))
        if BYTES[kind] == 4:
            return index
        word = "sext" if BYTES[kind] > 4 else "trunc"
        return str(writer.new(f"{word} {before} {index} to {after}"))

    def _flat(self, at: At, base: int, strides: Dims) -> str:
        """Appends the flat index `base` plus indices times strides; returns it."""
        writer = self.writer
        many, total = writer.type("i32"), ""
        for index, stride in zip(at, strides, strict=True):
            if not stride:
                continue
            term = index
            if stride != 1:
                by = writer.literal(stride, "i32")
                term = writer.new(f"mul {many} {index}, {by}")
            total = writer.new(f"add {many} {total}, {term}") if total else term
        if not total:
            return str(writer.literal(base, "i32"))
        if base:
            by = writer.literal(base, "i32")
            total = writer.new(f"add {many} {total}, {by}")
        return total

    def _gathered(self, place: Place | None, base: int, index: str, kind: str) -> str:
        """Appends the load of numbers of an array at flat indices; returns its name."""
        start = self._pointer(place, base * BYTES[kind])
        return str(self.writer.gathered(start, index, kind))
