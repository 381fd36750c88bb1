"""LLVM IR of the loops of a schedule with a scene in each lane of a vector.

Entry k of a stored row is a vector: the numbers of all lanes lie beside each other.
Values that all scenes share are stored as single numbers instead, and copied to all
lanes when they are read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from jaxrod.lanes.llvm.vector_code import BYTES, TYPES, Writer, literal
from jaxrod.lanes.looped.streams import Member, Stream, flows, reads_of
from jaxrod.lanes.rows.loop_writer import LoopWriter
from jaxrod.lanes.rows.recurrences import Recurrence
from jaxrod.lanes.rows.row_graph import Dims, RowGraph, identity, row_major
from jaxrod.lanes.rows.schedule import Fill, Loop, Place, Schedule

Lines = list[str]
SINGLE = ("%uniform", "@data")
"""Beginnings of the names of pointers to memory in which all scenes share numbers."""


class LaneWriter(LoopWriter):
    """Writer of an LLVM function that runs the loops of a schedule for many scenes."""

    def __init__(self, graph: RowGraph, schedule: Schedule, lanes: int) -> None:
        """Begins an LLVM function without lines.

        Args:
            graph: The graph of rows.
            schedule: Loops of the function.
            lanes: Number of lanes of a vector, one for each scene.
        """
        super().__init__(graph, schedule, lanes)
        self.lanes = lanes
        self.head: Lines = []
        """Lines before the next loop."""
        self.before: list[Lines] = [self.head]
        """Lines before each loop of a nest, from the outermost loop on; then the body
        of the innermost."""

    def text(self, name: str, pointers: Sequence[str]) -> str:
        """Returns the LLVM function with all loops; `pointers` are its arguments."""
        whole: Lines = []
        stream = Stream()
        for number, loop in enumerate(self.schedule.loops):
            reads = reads_of(self.graph, self.schedule, loop)
            if not stream.admits(loop, reads):
                whole += self._flowing(stream)
                stream = Stream()
            if flows(loop):
                mark = f"g{number}"
                self._flow(stream.add(self.schedule, loop, reads, mark), loop, mark)
            elif not loop.dims and not loop.scatters and loop.recurrence is None:
                self._straight(loop)
            else:
                whole += self._flowing(stream)
                stream = Stream()
                whole += self._apart(number, loop)
        whole += self._flowing(stream)
        given = ", ".join(f"ptr noalias nocapture {p}" for p in pointers)
        words = "noinline nounwind alignstack(64)"
        head = f"define internal void @{name}({given}) {words} {{"
        return "\n".join([head, "entry:", *whole, "ret void", "}", ""])

    def value(self, node: int) -> str:
        """Returns the name of a node's vector in the loop being written."""
        graph = self.graph
        known = graph.value(node)
        if known is not None:
            return self.literal(known, graph.kinds[node])
        if not graph.dims[node]:
            return self._number(node)
        name = self.names.get(node)
        if name is None:
            name = self.names[node] = self._read(node)
        return name

    def _number(self, node: int) -> str:
        """Returns the name of a node without rows, which is loaded before all loops."""
        name = self.numbers.get(node)
        if name is None:
            place = self.schedule.ready.get(node)
            if place is None:
                raise AssertionError(f"node {node} is used before it is computed")
            name = self._load(place, 0, (), self.graph.kinds[node])
            self.numbers[node] = name
        return name

    def _stored(self, node: int) -> tuple[Place, int, Dims] | None:
        """Returns the place, base and strides of a view or stored node, or `None`."""
        graph, schedule = self.graph, self.schedule
        if graph.operations[node] == "view":
            (source,) = graph.arguments[node]
            place = schedule.place(source)
            assert place is not None, (source, graph.operations[source])
            base, strides = graph.extras[node]
            return place, base, strides
        place = schedule.place(node)
        if place is None:
            return None
        return place, 0, row_major(graph.dims[node])

    def _read(self, node: int) -> str:
        """Appends the load of a view or stored node, or an index; returns its name."""
        graph = self.graph
        kind = graph.kinds[node]
        if graph.operations[node] == "iota":
            lines, self.lines = self.lines, self.before[graph.extras[node] + 1]
            name = self.spread(self._index(graph.extras[node], kind), kind)
            self.lines = lines
            return name
        found = self._stored(node)
        if found is None:
            raise AssertionError(f"node {node} is used before it is computed")
        return self._load(*found, kind)

    def _index(self, axis: int, kind: str) -> str:
        """Appends the conversion of a loop's index to a number; returns its name."""
        index = self.indices[axis]
        if kind[0] == "f":
            return self.new(f"sitofp i64 {index} to {TYPES[kind]}")
        if BYTES[kind] == 8:
            return index
        return self.new(f"trunc i64 {index} to {TYPES[kind]}")

    def _of_all(self, node: int) -> str | None:
        """Returns the name of a single number that all scenes share.

        It returns `None` for a node that differs between scenes.
        """
        graph = self.graph
        kind, known = graph.kinds[node], graph.value(node)
        if known is not None:
            return literal(known, kind)
        if graph.operations[node] == "iota":
            return self._index(graph.extras[node], kind)
        if node in self.names or node in self.numbers:
            return None
        found = self._stored(node)
        if found is None or not is_single(found[0]):
            return None
        self.width = 1
        name = self._load(*found, kind)
        self.width = self.lanes
        return name

    def address(self, place: Place, base: int, strides: Dims, kind: str) -> str:
        """Appends the address of an entry of an array; returns its name.

        The array is at `place` and has numbers of type `kind`. The flat index of the
        entry is `base`, plus loop index times stride, summed over the loops.
        """
        beside = 1 if is_single(place) else self.lanes
        size, one = BYTES[kind], memory_type(kind)
        offset = (place.offset + base * size) * beside
        at = self.new(f"getelementptr i8, ptr {place.pointer}, i64 {offset}")
        for index, stride in zip(self.indices, strides, strict=False):
            if stride == 0:
                continue
            if stride * beside != 1:
                index = self.new(f"mul nsw i64 {index}, {stride * beside}")
            at = self.new(f"getelementptr {one}, ptr {at}, i64 {index}")
        return at

    def _align(self, kind: str) -> int:
        return min(64, BYTES[kind] * self.width)

    def _load_at(self, at: str, kind: str) -> str:
        """Appends the load of a vector, or of one number; returns its name."""
        many = memory_type(kind, self.width)
        name = self.new(f"load {many}, ptr {at}, align {self._align(kind)}")
        if kind != "b1":
            return name
        zero = "0" if self.width == 1 else "zeroinitializer"
        return self.new(f"icmp ne {many} {name}, {zero}")

    def _store_at(self, name: str, at: str, kind: str) -> None:
        many = memory_type(kind, self.width)
        if kind == "b1":
            name = self.new(f"zext {self.type(kind)} {name} to {many}")
        self.lines.append(f"store {many} {name}, ptr {at}, align {self._align(kind)}")

    def _load(self, place: Place, base: int, strides: Dims, kind: str) -> str:
        """Appends the load of a vector, outside all loops whose index it does not need.

        Place, flat index and type are those of `address`.

        Returns:
            The name of the vector; of one number, if the width is 1.
        """
        deepest = max(
            (axis for axis, stride in enumerate(strides) if stride), default=-1
        )
        lines, self.lines = self.lines, self.before[deepest + 1]
        at = self.address(place, base, strides, kind)
        if is_single(place):
            width, self.width = self.width, 1
            name = self._load_at(at, kind)
            self.width = width
            name = self.spread(name, kind)
        else:
            name = self._load_at(at, kind)
        self.lines = lines
        return name

    def _store(
        self, name: str, place: Place, base: int, strides: Dims, kind: str
    ) -> None:
        self._store_at(name, self.address(place, base, strides, kind), kind)

    def _gather(self, node: int) -> str:
        """Appends the read of a stored node at computed indices; returns its name."""
        graph = self.graph
        table, index = graph.arguments[node]
        base, kind = graph.extras[node], graph.kinds[node]
        place = self.schedule.place(table)
        assert place is not None
        same = self._of_all(index)
        at = self.address(place, base, (), kind)
        one, beside = memory_type(kind), 1 if is_single(place) else self.lanes
        if same is not None:
            whole = self.new(f"sext i32 {same} to i64")
            whole = self.new(f"mul nsw i64 {whole}, {beside}")
            at = self.new(f"getelementptr {one}, ptr {at}, i64 {whole}")
            if beside > 1:
                return self._load_at(at, kind)
            self.width = 1
            name = self._load_at(at, kind)
            self.width = self.lanes
            return self.spread(name, kind)
        ats = self._pointers(at, self.value(index), one, beside)
        return self.entries(ats, kind)

    def _pointers(self, at: str, index: str, one: str, beside: int) -> str:
        """Appends the addresses of each lane's entry; returns the vector's name.

        Args:
            at: Pointer to the first number.
            index: Vector of indices.
            one: LLVM type of a number.
            beside: Number of scenes whose numbers lie beside each other.
        """
        w = self.lanes
        if beside > 1:
            many = f"<{w} x i32>"
            times = ", ".join([f"i32 {w}"] * w)
            own = ", ".join(f"i32 {lane}" for lane in range(w))
            index = self.new(f"mul nsw {many} {index}, <{times}>")
            index = self.new(f"add nsw {many} {index}, <{own}>")
        return self.new(f"getelementptr {one}, ptr {at}, <{w} x i32> {index}")

    def _flow(self, member: Member, loop: Loop, mark: str) -> None:
        """Writes a loop as a member of a stream; its labels begin with `mark`."""
        self.dims, self.indices = loop.dims, [f"%i_{member.mark}"]
        self.names, self.lines = {}, member.body
        self.before = [self.head, member.body]
        self._body(loop, mark)

    def _body(self, loop: Loop, mark: str) -> str:
        """Appends the body of a loop; returns the label of its last block."""
        graph, schedule, label = self.graph, self.schedule, mark
        if loop.mask is not None:
            some = self._anywhere(self.value(loop.mask))
            label = f"{mark}_skip"
            self.lines.append(f"br i1 {some}, label %{mark}_some, label %{label}")
            self.lines.append(f"{mark}_some:")
            names = dict(self.names)
        for node in loop.nodes:
            self.names[node] = self._computed(node)
            if schedule.is_kept(node):
                place = schedule.place(node)
                assert place is not None
                strides = row_major(graph.dims[node])
                self._store(self.names[node], place, 0, strides, graph.kinds[node])
        for goal in loop.goals:
            self._write(goal)
        if loop.mask is not None:
            self.names = names
            self.lines += [f"br label %{label}", f"{label}:"]
        return label

    def _flowing(self, stream: Stream) -> Lines:
        """Returns the lines before a stream and the loop over its members."""
        head, self.head = self.head, []
        self.lines, self.before = self.head, [self.head]
        return [*head, *stream.lines()]

    def _straight(self, loop: Loop) -> None:
        """Appends all operations without rows of one level to the lines before a loop.

        Levels are those of the schedule; `loop` has the operations.
        """
        self.dims, self.indices = (), []
        self.lines, self.before, self.names = self.head, [self.head], {}
        graph, schedule = self.graph, self.schedule
        for fill in schedule.fills.get(loop.level, ()):
            node = fill.node
            place = schedule.place(node)
            assert place is not None
            number = self.value(graph.arguments[node][-1])
            self._call_fill(number, place, graph.kinds[node], fill)
        for node in loop.nodes:
            self.numbers[node] = self._computed(node)
            if node in schedule.fresh:
                place = schedule.place(node)
                assert place is not None
                self._store(self.numbers[node], place, 0, (), graph.kinds[node])
        for goal in loop.goals:
            self._write(goal)

    def _call_fill(self, number: str, place: Place, kind: str, fill: Fill) -> None:
        if kind == "b1":
            many = memory_type(kind, self.lanes)
            number = self.new(f"zext {self.type(kind)} {number} to {many}")
        self.fills.add(kind)
        self.lines.append(lane_fill_call(number, place, kind, fill, self.lanes))

    def _anywhere(self, mask: str) -> str:
        """Appends a test whether a mask is true in some lane; returns its name."""
        many = self.type("b1")
        name = f"@llvm.vector.reduce.or.v{self.lanes}i1"
        self.declared.add(f"declare i1 {name}({many})")
        return self.new(f"call i1 {name}({many} {mask})")

    def _apart(self, number: int, loop: Loop) -> Lines:
        """Returns the lines of a loop that runs alone; `number` is for its labels."""
        if loop.scatters:
            made = self._scatters(number, loop)
        elif loop.recurrence is not None:
            made = self._recurrence(number, loop.recurrence)
        else:
            made = self._nest(number, loop)
        head, self.head = self.head, []
        return [*head, *made]

    def _nest(self, number: int, loop: Loop) -> Lines:
        """Returns the lines of a nest of loops; `number` is for its labels."""
        dims = self.dims = loop.dims
        depth = len(dims)
        marks = [f"g{number}_{axis}" for axis in range(depth)]
        self.indices = [f"%i_{mark}" for mark in marks]
        self.before = [self.head, *([] for _ in range(depth))]
        self.behind = [[] for _ in range(depth + 1)]
        self.names, self.lines = {}, self.before[depth]
        mark, phis = marks[-1], list[str]()
        finish: list[Callable[[], None]] = []
        masks = masks_of_sums(self.graph, self.schedule, loop)
        skip: Lines | None = None
        if masks:
            for node in self._ahead(loop, masks):
                self.names[node] = self._computed(node)
            some = self.value(masks[0])
            for mask in masks[1:]:
                some = self.new(f"or {self.type('b1')} {some}, {self.value(mask)}")
            some = self._anywhere(some)
            label, skip = f"{mark}_skip", []
            self.lines.append(f"br i1 {some}, label %{mark}_some, label %{label}")
            self.lines.append(f"{mark}_some:")
            for node in loop.nodes:
                if node not in self.names:
                    self.names[node] = self._computed(node)
        else:
            label = self._body(loop, mark)
        for node in loop.reductions:
            self._reduce(node, mark, label, phis, finish, skip)
        if skip is not None:
            self.lines += [f"br label %{label}", f"{label}:", *skip]
        self.lines = self.behind[depth - 1]
        for act in finish:
            act()
        inner = self.before[depth]
        for axis in range(depth - 1, -1, -1):
            mark = marks[axis]
            last = label if axis == depth - 1 else f"{marks[axis + 1]}_done"
            inner = [
                f"br label %{mark}_pre",
                f"{mark}_pre:",
                f"br label %{mark}",
                f"{mark}:",
                f"%i_{mark} = phi i64 [0, %{mark}_pre], [%d_{mark}, %{last}]",
                *(phis if axis == depth - 1 else []),
                *inner,
                f"%d_{mark} = add i64 %i_{mark}, 1",
                f"%m_{mark} = icmp slt i64 %d_{mark}, {dims[axis]}",
                f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
                f"{mark}_done:",
                *self.behind[axis],
            ]
            if axis:
                inner = [*self.before[axis], *inner]
        return inner

    def _ahead(self, loop: Loop, masks: Sequence[int]) -> list[int]:
        """Returns the nodes of a loop that its masks need, in their order."""
        graph, own = self.graph, set(loop.nodes)
        needed, stack = set(masks), list(masks)
        while stack:
            for argument in graph.arguments[stack.pop()]:
                if argument in own and argument not in needed:
                    needed.add(argument)
                    stack.append(argument)
        return [node for node in loop.nodes if node in needed]

    def _reduce(
        self,
        node: int,
        mark: str,
        label: str,
        phis: Lines,
        finish: list[Callable[[], None]],
        skip: Lines | None,
    ) -> None:
        """Appends a reduction: along the row in registers, along outer axes in memory.

        Args:
            node: Node of the reduction.
            mark: Label of the innermost loop.
            label: Label of the last block of its body.
            phis: List to which the loop's `phi` line is added.
            finish: List to which a function is added that appends the lines after the
                loop.
            skip: `phi` lines of the last block, if rounds may be skipped; the first
                block of the body then has the label of the loop.
        """
        graph, schedule, depth = self.graph, self.schedule, len(self.dims)
        operation, axes = graph.extras[node]
        (source,) = graph.arguments[node]
        kind = graph.kinds[node]
        kept = [axis for axis in range(depth) if axis not in axes]
        own = dict(zip(kept, row_major(graph.dims[node]), strict=True))
        strides = tuple(own.get(axis, 0) for axis in range(depth))
        value = self.value(source)
        outer = [axis for axis in axes if axis != depth - 1]
        place, none = schedule.place(node), identity(operation, kind)
        if outer:
            assert place is not None
            size = 1
            for axis in kept:
                size *= self.dims[axis]
            lines, self.lines = self.lines, self.head
            start = vector_literal(none, kind, self.lanes)
            self.fills.add(kind)
            fill = Fill(node, 0, size)
            self.lines.append(lane_fill_call(start, place, kind, fill, self.lanes))
            self.lines = lines
        if depth - 1 not in axes:
            assert place is not None
            at = self.address(place, 0, strides, kind)
            made = self._combined(operation, self._load_at(at, kind), value, kind)
            self._store_at(made, at, kind)
            if not graph.dims[node]:
                raise AssertionError("a sum over all axes has the last one")
            return
        self.count += 1
        old = f"%a{self.count}"
        made = self._combined(operation, old, value, kind)
        if skip is not None:
            some = made
            self.count += 1
            made = f"%a{self.count}"
            skip.append(
                f"{made} = phi {self.type(kind)} [{old}, %{mark}], "
                f"[{some}, %{mark}_some]"
            )
        phis.append(
            f"{old} = phi {self.type(kind)} [{self.literal(none, kind)}, %{mark}_pre], "
            f"[{made}, %{label}]"
        )

        def ending() -> None:
            if depth == 1:
                self.numbers[node] = made
                if node in schedule.fresh:
                    assert place is not None
                    self._store(made, place, 0, (), kind)
                return
            assert place is not None
            at = self.address(place, 0, strides[:-1], kind)
            total = made
            if outer:
                old = self._load_at(at, kind)
                total = self._combined(operation, old, made, kind)
            self._store_at(total, at, kind)
            if not graph.dims[node]:
                lines, self.lines = self.lines, self.behind[0]
                at = self.address(place, 0, (), kind)
                self.numbers[node] = self._load_at(at, kind)
                self.lines = lines

        finish.append(ending)

    def _scatters(self, number: int, loop: Loop) -> Lines:
        """Returns the lines of scatters with the same indices, entry by entry.

        The lanes have different addresses, so all are updated at once. `number` is for
        the labels of their loop.
        """
        graph, schedule = self.graph, self.schedule
        self.dims, self.indices, self.names = (), [], {}
        self.lines, self.before = self.head, [self.head]
        for node in loop.scatters:
            self._begin_scatter(node)
        first = graph.arguments[loop.scatters[0]]
        rounds = graph.extras[loop.scatters[0]][1]
        mark = f"g{number}"
        body: Lines = []
        numbers = dict(self.numbers)
        self.lines, self.before = body, [self.head, body]
        self.dims, self.indices = (rounds,), [f"%i_{mark}"]
        index, mask = first[1], first[3:]
        there = None
        if mask:
            there = self.value(mask[0])
            some = self._anywhere(there)
            body.append(f"br i1 {some}, label %{mark}_some, label %{mark}_skip")
            body.append(f"{mark}_some:")
        same = self._of_all(index)
        places = None if same is not None else self.value(index)
        for node in loop.scatters:
            kind, operation = graph.kinds[node], graph.extras[node][0]
            update = self.value(graph.arguments[node][2])
            place = schedule.place(node)
            assert place is not None
            one, at = memory_type(kind), self.address(place, 0, (), kind)
            if same is not None:
                whole = self.new(f"sext i32 {same} to i64")
                whole = self.new(f"mul nsw i64 {whole}, {self.lanes}")
                at = self.new(f"getelementptr {one}, ptr {at}, i64 {whole}")
                made = update
                if operation != "set":
                    old = self._load_at(at, kind)
                    made = self._combined(operation, old, update, kind)
                    if there is not None:
                        made = self._select([there, made, old], kind)
                self._store_at(made, at, kind)
                continue
            assert places is not None
            ats = self._pointers(at, places, one, self.lanes)
            made = update
            if operation != "set":
                old = self.entries(ats, kind)
                made = self._combined(operation, old, update, kind)
            self._scattered(made, ats, kind, there)
        # Numbers loaded in a round that may be skipped are undefined after it.
        self.numbers = {k: v for k, v in self.numbers.items() if k in numbers}
        return [
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

    def _scattered(self, name: str, ats: str, kind: str, there: str | None) -> None:
        w, one = self.lanes, memory_type(kind)
        many, truth = f"<{w} x {one}>", f"<{w} x i1>"
        if kind == "b1":
            name = self.new(f"zext {truth} {name} to {many}")
        suffix = {"f32": "f32", "f64": "f64"}.get(kind, f"i{8 * BYTES[kind]}")
        call = f"@llvm.masked.scatter.v{w}{suffix}.v{w}p0"
        self.declared.add(f"declare void {call}({many}, <{w} x ptr>, i32, {truth})")
        every = there or "<" + ", ".join(["i1 true"] * w) + ">"
        self.lines.append(
            f"call void {call}({many} {name}, <{w} x ptr> {ats}, i32 {BYTES[kind]}, "
            f"{truth} {every})"
        )

    def _begin_scatter(self, node: int) -> None:
        """Appends the copy of the row to which a scatter adds."""
        graph, schedule = self.graph, self.schedule
        into, kind = graph.arguments[node][0], graph.kinds[node]
        (count,) = graph.dims[node]
        place = schedule.place(node)
        assert place is not None
        known = graph.value(into)
        if known is not None:
            number = vector_literal(known, kind, self.lanes)
            self.fills.add(kind)
            fill = Fill(node, 0, count)
            self.lines.append(lane_fill_call(number, place, kind, fill, self.lanes))
            return
        found = self._stored(into)
        assert found is not None
        source, begin, _ = found
        to = self.address(place, 0, (), kind)
        at = self.address(source, begin, (), kind)
        if not is_single(source):
            size = count * BYTES[kind] * self.lanes
            self.declared.add("declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
            self.lines.append(
                f"call void @llvm.memcpy.p0.p0.i64(ptr {to}, ptr {at}, i64 {size}, "
                "i1 false)"
            )
            return
        self.fills.add(kind)
        one = memory_type(kind)
        self.lines.append(
            f"call void @lane_copies_{one}(ptr {to}, ptr {at}, i64 {count})"
        )

    def _recurrence(self, number: int, node: int) -> Lines:
        """Returns the lines of the loop of a recurrence; `number` is for its labels."""
        graph, schedule = self.graph, self.schedule
        made: Recurrence = graph.extras[node]
        given, entries = graph.arguments[node], made.lanes
        place, mark = schedule.place(node), f"g{number}"
        body: Lines = []
        assert place is not None
        self.names, self.dims = {}, (made.length,)
        self.before, self.indices = [self.head, body], [f"%i_{mark}"]
        first_row = made.n_constants + made.n_carry
        phis: Lines = []
        results: list[tuple[str, int]] = []
        order = made.graph.needed(made.outputs)
        for entry in range(entries):
            inside = _RoundWriter(made.graph, self)
            begun: dict[int, str] = {}
            for i, inner in enumerate(made.inputs):
                self.lines = body if i >= first_row else self.head
                name = self.value(given[i * entries + entry])
                if made.n_constants <= i < first_row:
                    begun[i] = name
                    name = f"%a_{mark}_{i}_{entry}"
                inside.names[inner] = name
            self.lines = inside.lines = body
            inside.write(order, lambda node: None)
            for output in range(made.n_carry, len(made.outputs)):
                name = inside.value(made.outputs[output])
                base = made.stored_at(output) + entry
                self._store(name, place, base, (entries,), made.kind)
            for output in range(made.n_carry):
                later = inside.value(made.outputs[output])
                i = made.n_constants + output
                phis.append(
                    f"%a_{mark}_{i}_{entry} = phi {self.type(made.kind)} "
                    f"[{begun[i]}, %{mark}_pre], [{later}, %{mark}]"
                )
                results.append((later, made.stored_at(output) + entry))
        after: Lines = []
        self.lines, self.indices = after, []
        for name, base in results:
            self._store(name, place, base, (), made.kind)
        first = f"add i64 %c_{mark}, 0"
        if made.backwards:
            first = f"sub i64 {made.length - 1}, %c_{mark}"
        return [
            f"br label %{mark}_pre",
            f"{mark}_pre:",
            f"br label %{mark}",
            f"{mark}:",
            f"%c_{mark} = phi i64 [0, %{mark}_pre], [%d_{mark}, %{mark}]",
            *phis,
            f"%i_{mark} = {first}",
            *body,
            f"%d_{mark} = add i64 %c_{mark}, 1",
            f"%m_{mark} = icmp slt i64 %d_{mark}, {made.length}",
            f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
            f"{mark}_done:",
            *after,
        ]


class _RoundWriter(Writer):
    """Writer of one round of a recurrence, which appends to another writer's lines."""

    def __init__(self, graph: RowGraph, outer: LaneWriter) -> None:
        super().__init__(graph, outer.lanes, lambda writer, node: None)
        self.outer, self.lines = outer, outer.lines
        self.needs, self.declared = outer.needs, outer.declared

    def new(self, text: str) -> str:
        return self.outer.new(text)


def masks_of_sums(graph: RowGraph, schedule: Schedule, loop: Loop) -> list[int]:
    """Returns masks of a loop that does nothing but sums.

    All terms of the sums are zero where none of the masks is true. Contact between all
    pairs of elements is an example: few pairs touch. The list is empty if there are no
    such masks.
    """
    own = set(loop.nodes)
    if loop.mask is not None or loop.goals or any(map(schedule.is_kept, own)):
        return []
    known: dict[int, frozenset[int] | None] = {}

    def masks(node: int) -> frozenset[int] | None:
        """Masks without which a node is zero; `None` if it need not be zero."""
        if node not in known:
            known[node] = found(node)
        return known[node]

    def found(node: int) -> frozenset[int] | None:
        if graph.value(node) == 0:
            return frozenset()
        if node not in own:
            return None
        operation, arguments = graph.operations[node], graph.arguments[node]
        if operation == "select":
            mask, yes, no = arguments
            if graph.value(no) == 0:
                return frozenset([mask])
            return _joined(masks(yes), masks(no))
        if operation == "mul":
            first = masks(arguments[0])
            return masks(arguments[1]) if first is None else first
        if operation in ("add", "sub"):
            return _joined(*map(masks, arguments))
        return masks(arguments[0]) if operation == "neg" else None

    whole: frozenset[int] | None = frozenset()
    for node in loop.reductions:
        if graph.extras[node][0] != "add":
            return []
        whole = _joined(whole, masks(graph.arguments[node][0]))
    return sorted(whole or ())


def _joined(
    a: frozenset[int] | None, b: frozenset[int] | None
) -> frozenset[int] | None:
    return None if a is None or b is None else a | b


def is_single(place: Place) -> bool:
    """Whether all scenes share the numbers at a place, which are stored once."""
    return place.pointer.startswith(SINGLE)


def memory_type(kind: str, lanes: int = 1) -> str:
    """Returns the LLVM type of a number, or of a vector, in memory."""
    one = "i8" if kind == "b1" else TYPES[kind]
    return one if lanes == 1 else f"<{lanes} x {one}>"


def vector_literal(number: object, kind: str, lanes: int) -> str:
    """Returns a number as an LLVM vector in memory, with the number in every lane."""
    text = str(int(bool(number))) if kind == "b1" else literal(number, kind)
    return "<" + ", ".join([f"{memory_type(kind)} {text}"] * lanes) + ">"


def lane_fill_call(number: str, place: Place, kind: str, fill: Fill, lanes: int) -> str:
    """Returns LLVM IR of a call that writes one vector to many entries of an array.

    Args:
        number: Name of the vector, or its text; booleans are bytes.
        place: Memory location of the array.
        kind: Type of the numbers, such as `"f32"`.
        fill: Entries that are written.
        lanes: Number of lanes.
    """
    at = (place.offset + fill.first * BYTES[kind]) * lanes
    return (
        f"call void @lane_fill_{memory_type(kind)}(ptr {place.pointer}, i64 {at}, "
        f"{memory_type(kind, lanes)} {number}, i64 {fill.count}, i64 {fill.runs}, "
        f"i64 {fill.stride})"
    )


def lane_fill_text(kind: str, lanes: int) -> str:
    """Returns LLVM IR of functions that fill arrays of vectors.

    `@lane_fill_T` writes one vector to runs of entries: run j begins at entry j times
    `%stride` and has `%count` entries. `@lane_copies_T` writes single numbers, each to
    all lanes. T is the LLVM type of numbers of type `kind` in memory.
    """
    one, many = memory_type(kind), memory_type(kind, lanes)
    align, size = min(64, BYTES[kind] * lanes), BYTES[kind]
    return f"""
define internal void @lane_fill_{one}(ptr %to, i64 %offset, {many} %number, i64 %count,
    i64 %runs, i64 %stride) nounwind {{
entry:
%start = getelementptr i8, ptr %to, i64 %offset
br label %outer
outer:
%j = phi i64 [0, %entry], [%j1, %outer_end]
%first = mul i64 %j, %stride
%begin = mul i64 %first, {lanes}
%row = getelementptr {one}, ptr %start, i64 %begin
br label %loop
loop:
%i = phi i64 [0, %outer], [%next, %loop]
%beside = mul i64 %i, {lanes}
%at = getelementptr {one}, ptr %row, i64 %beside
store {many} %number, ptr %at, align {align}
%next = add i64 %i, 1
%more = icmp slt i64 %next, %count
br i1 %more, label %loop, label %outer_end
outer_end:
%j1 = add i64 %j, 1
%again = icmp slt i64 %j1, %runs
br i1 %again, label %outer, label %done
done:
ret void
}}
define internal void @lane_copies_{one}(ptr %to, ptr %from, i64 %count) nounwind {{
entry:
br label %loop
loop:
%i = phi i64 [0, %entry], [%next, %loop]
%source = getelementptr {one}, ptr %from, i64 %i
%found = load {one}, ptr %source, align {size}
%first = insertelement {many} poison, {one} %found, i64 0
%all = shufflevector {many} %first, {many} poison, <{lanes} x i32> zeroinitializer
%beside = mul i64 %i, {lanes}
%at = getelementptr {one}, ptr %to, i64 %beside
store {many} %all, ptr %at, align {align}
%next = add i64 %i, 1
%more = icmp slt i64 %next, %count
br i1 %more, label %loop, label %done
done:
ret void
}}
"""
