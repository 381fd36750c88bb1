"""Memory and LLVM functions of a kernel with a rod in each vector lane.

A function runs once, once for each block of rods, or at every step.

A kernel's memory has one region that all rods share (single numbers), one for the
loop-invariant values of a block of rods (a vector for every number), and buffers of
vectors for values that change. Every number has a fixed offset, known when the kernel
is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING, Entries, Graph, Step
from jaxrod.lanes.llvm.elementary import elementary_texts
from jaxrod.lanes.llvm.transpose import is_tiled, room_for, transpose_text
from jaxrod.lanes.llvm.vector_code import BYTES, TYPES, Writer

ALIGNMENT = 64
"""Alignment of vectors in memory [bytes]."""
_ATTRIBUTES = f"noinline nounwind alignstack({ALIGNMENT})"
"""LLVM attributes of functions. The stack alignment is needed: by default LLVM spills
vectors to addresses that straddle two cache lines."""


@dataclass
class Region:
    """A region of the workspace, in which arrays are allocated one after another."""

    pointer: str
    """Name of the pointer to the region in the functions of a kernel."""
    lanes: int
    """Number of lanes of the vectors in the region; 1 for single numbers."""
    size: int = 0
    """Allocated size [bytes]."""

    def place(self, kind: str, count: int = 1) -> int:
        """Allocates `count` numbers of type `kind`; returns their offset [bytes]."""
        step = BYTES[kind] * self.lanes
        aligned = min(ALIGNMENT, max(step, 1))
        start = -(-self.size // aligned) * aligned
        self.size = start + room_for(kind, count, self.lanes) * step
        return start

    def room(self) -> int:
        """Returns the size, rounded up so that the next region is aligned [bytes]."""
        return -(-self.size // ALIGNMENT) * ALIGNMENT


@dataclass
class Memory:
    """Regions and offsets of a kernel's numbers: inputs by array, others by node."""

    graph: Graph
    width: int
    shared: Region = field(init=False)
    own: Region = field(init=False)
    arrays: dict[int, tuple[Region, int]] = field(default_factory=dict)
    nodes: dict[int, tuple[Region, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Creates empty regions for values shared by all rods and those of each rod."""
        self.shared = Region("%shared", 1)
        self.own = Region("%own", self.width)

    def give(self, which: int, region: Region, kind: str, count: int) -> int:
        """Allocates input array number `which` in a region; returns its offset [bytes].

        The array has `count` numbers of type `kind`, such as `"f32"`.
        """
        offset = region.place(kind, count)
        self.arrays[which] = region, offset
        return offset

    def keep(self, used: Sequence[int]) -> tuple[list[int], list[int]]:
        """Allocates memory for loop-invariant values that later code reads.

        They are the operands of nodes that change more often. Each is the same for all
        rods, or fixed for each rod.

        Args:
            used: All nodes that the kernel computes, each after its arguments.

        Returns:
            The nodes that all rods share, and the nodes fixed for each rod.
        """
        graph = self.graph
        kept: dict[int, None] = {}
        for node in used:
            for source in graph.arguments[node]:
                if graph.rates[source] < graph.rates[node]:
                    kept[source] = None
        return self._placed(kept, UNIFORM, self.shared), self._placed(
            kept, FIXED, self.own
        )

    def keep_outputs(self, outputs: Sequence[int]) -> None:
        """Allocates memory for those outputs of a kernel that are loop-invariant."""
        for node in outputs:
            rate = self.graph.rates[node]
            if rate in (UNIFORM, FIXED):
                region = self.shared if rate == UNIFORM else self.own
                self._placed({node: None}, rate, region)

    def where(self, node: int) -> tuple[Region, int] | None:
        """Returns region and offset of a node [bytes]; `None` if it is not stored."""
        place = self.graph.places.get(node)
        if place is None:
            return self.nodes.get(node)
        region, offset = self.arrays[place[0]]
        return region, offset + place[1] * BYTES[self.graph.kinds[node]] * region.lanes

    def _placed(self, kept: dict[int, None], rate: int, region: Region) -> list[int]:
        graph = self.graph
        chosen = [
            node
            for node in kept
            if graph.rates[node] == rate and graph.operations[node] != "input"
        ]
        for node in chosen:
            if node not in self.nodes:
                self.nodes[node] = region, region.place(graph.kinds[node])
        return chosen


def function_text(
    name: str,
    memory: Memory,
    width: int,
    rate: int,
    outputs: Sequence[tuple[int, Region, int]],
    pointers: Sequence[str],
) -> tuple[str, Writer]:
    """Returns LLVM IR of a function that computes nodes and stores them.

    Args:
        name: Name of the function.
        memory: Locations of all stored numbers.
        width: Lanes of the function's values.
        rate: Rate of the nodes that it computes; nodes of a lower rate are read from
            memory.
        outputs: Nodes to compute, each with the region and offset of its value.
        pointers: Names of the function's arguments, the pointers to the regions.

    Returns:
        The text of the function, and its writer.
    """
    graph = memory.graph
    writer = Writer(graph, width, _reader(memory, rate), _table(memory))
    goals: dict[int, list[tuple[Region, int]]] = {}
    for node, region, offset in outputs:
        goals.setdefault(node, []).append((region, offset))

    def store(node: int) -> None:
        for region, offset in goals.pop(node, ()):
            _store(writer, writer.value(node), graph.kinds[node], region, offset)

    order = graph.needed([node for node, _, _ in outputs])
    writer.write([node for node in order if graph.rates[node] == rate], store)
    for node in list(goals):
        store(node)
    given = ", ".join(f"ptr noalias nocapture {p}" for p in pointers)
    text = f"define internal void @{name}({given}) {_ATTRIBUTES} {{\n"
    return text + "\n".join([*writer.lines, "ret void"]) + "\n}\n", writer


def _reader(memory: Memory, rate: int) -> Callable[[Writer, int], str | None]:
    graph = memory.graph

    def load(writer: Writer, node: int) -> str | None:
        if graph.operations[node] != "input" and graph.rates[node] >= rate:
            return None
        place = memory.where(node)
        if place is None:
            return None
        region, offset = place
        kind = graph.kinds[node]
        return _load(writer, kind, region, offset)

    return load


def _table(memory: Memory) -> Callable[[Writer, int], str]:
    """Returns a function that writes the address of an input that all rods share."""

    def address(writer: Writer, node: int) -> str:
        place = memory.where(node)
        assert place is not None and place[0].lanes == 1
        region, offset = place
        return writer.new(f"getelementptr i8, ptr {region.pointer}, i64 {offset}")

    return address


def _load(writer: Writer, kind: str, region: Region, offset: int) -> str:
    at = writer.new(f"getelementptr i8, ptr {region.pointer}, i64 {offset}")
    one = "i8" if kind == "b1" else TYPES[kind]
    if region.lanes == 1:
        found = writer.new(f"load {one}, ptr {at}, align {BYTES[kind]}")
        if kind == "b1":
            found = writer.new(f"icmp ne i8 {found}, 0")
        return writer.spread(found, kind)
    many = f"<{region.lanes} x {one}>"
    align = min(ALIGNMENT, BYTES[kind] * region.lanes)
    found = writer.new(f"load {many}, ptr {at}, align {align}")
    if kind == "b1":
        found = writer.new(f"icmp ne {many} {found}, zeroinitializer")
    return found


def _store(writer: Writer, name: str, kind: str, region: Region, offset: int) -> None:
    at = writer.new(f"getelementptr i8, ptr {region.pointer}, i64 {offset}")
    many = writer.type(kind)
    if kind == "b1":
        wide = "i8" if writer.width == 1 else f"<{writer.width} x i8>"
        name = writer.new(f"zext {many} {name} to {wide}")
        many = wide
    align = min(ALIGNMENT, BYTES[kind] * region.lanes)
    writer.lines.append(f"store {many} {name}, ptr {at}, align {align}")


class KernelPlan:
    """Kernel with a rod in each lane, under construction: memory and LLVM functions."""

    def __init__(self, step: Step, width: int) -> None:
        """Allocates memory for the constants of a step.

        Args:
            step: The step.
            width: Lanes of a vector.
        """
        self.step, self.width = step, width
        self.memory = Memory(step.graph, width)
        self.functions: list[str] = []
        self.n_transposes = 0
        self.transposed: set[str] = set()
        self.operations = 0
        self.writers: list[Writer] = []
        self.declared: set[str] = {"declare i64 @llvm.smin.i64(i64, i64)"}
        self.constant_places = []
        for i, entries in enumerate(step.constants):
            shared = entries.rate == UNIFORM
            region = self.memory.shared if shared else self.memory.own
            place = self.memory.give(i, region, entries.kind, entries.size)
            self.constant_places.append(place)

    def carry_buffers(self) -> tuple[Region, Region, list[int]]:
        """Allocates buffers for the carry before (`%now`) and after a step (`%then`).

        Returns:
            Both buffers, and the offset of each array of the carry in either buffer
            [bytes].
        """
        now, then = Region("%now", self.width), Region("%then", self.width)
        places = [now.place(e.kind, e.size) for e in self.step.carry]
        then.size = now.size
        for i, place in enumerate(places):
            self.memory.arrays[len(self.step.constants) + i] = now, place
        return now, then, places

    def pointers(self, start: int, **regions: Region) -> str:
        """Returns LLVM IR of pointers to regions that are consecutive in the workspace.

        The keywords are the names of the pointers. The first region begins at byte
        `start`.
        """
        lines = []
        for name, region in regions.items():
            lines.append(f"%{name} = getelementptr i8, ptr %room, i64 {start}\n")
            start += region.room()
        return "".join(lines)

    def fetch_all(
        self,
        arrays: Sequence[Entries],
        places: Sequence[int],
        first: int,
        region: str,
    ) -> str:
        """Returns LLVM IR that loads operands into vectors with a rod in each lane.

        Operand number `first` is the first of `arrays`. The vectors are stored in the
        region with pointer `region`, those of each array at its offset in `places`
        [bytes].
        """
        return "".join(
            self.transpose("fetch", entries, f"%in{first + i}", region, place)
            for i, (entries, place) in enumerate(zip(arrays, places, strict=True))
        )

    def bring_all(
        self, arrays: Sequence[Entries], places: Sequence[int], region: str
    ) -> str:
        """Returns LLVM IR that stores vectors as results with a row for each rod.

        The results are `arrays`, numbered from 0. The vectors are read from the region
        with pointer `region`, those of each array at its offset in `places` [bytes].
        """
        return "".join(
            self.transpose("bring", entries, f"%out{i}", region, place)
            for i, (entries, place) in enumerate(zip(arrays, places, strict=True))
        )

    def prepare(self, outputs: Sequence[int]) -> None:
        """Writes `@shared` and `@fixed`, which compute loop-invariant values.

        `@shared` computes the values that all rods share, `@fixed` those of each rod.
        Only values that the outputs of the kernel need are computed.
        """
        used = self.step.graph.needed(outputs)
        self.operations = len(used)
        self.memory.keep_outputs(outputs)
        shared, own = self.memory.keep(used)
        graph = self.step.graph
        for node in set(outputs):
            if graph.rates[node] == UNIFORM and node not in shared:
                shared.append(node)
            if graph.rates[node] == FIXED and node not in own:
                own.append(node)
        for name, rate, nodes, lanes in (
            ("shared", UNIFORM, shared, 1),
            ("fixed", FIXED, own, self.width),
        ):
            goals = [
                (node, *self.memory.nodes[node])
                for node in nodes
                if graph.operations[node] != "input"
            ]
            pointers = ["%shared", "%own"]
            text, writer = function_text(
                name, self.memory, lanes, rate, goals, pointers
            )
            self.functions.append(text)
            self.writers.append(writer)

    def write_function(
        self,
        name: str,
        goals: Sequence[tuple[int, Region, int]],
        regions: Sequence[Region],
    ) -> None:
        """Writes an LLVM function that computes varying values in vectors.

        It runs once for each block of rods, or at every step. Each goal is a node, with
        the region and the offset where it is stored [bytes].
        """
        names = ["%shared", "%own", *[region.pointer for region in regions]]
        text, writer = function_text(
            name, self.memory, self.width, VARYING, goals, names
        )
        self.functions.append(text)
        self.writers.append(writer)

    def regions(self) -> int:
        """Size of the loop-invariant values at the start of the workspace [bytes]."""
        return self.memory.shared.room() + self.memory.own.room()

    def fetch_shared(self) -> str:
        """Returns LLVM IR that copies constants shared by all rods to the workspace."""
        lines = []
        for i, entries in enumerate(self.step.constants):
            if entries.rate == UNIFORM:
                size, place = (
                    BYTES[entries.kind] * entries.size,
                    self.constant_places[i],
                )
                lines.append(
                    f"%copy{i} = getelementptr i8, ptr %shared, i64 {place}\n"
                    f"call void @llvm.memcpy.p0.p0.i64(ptr %copy{i}, ptr %in{1 + i}, "
                    f"i64 {size}, i1 false)\n"
                )
        self.declared.add("declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
        return "".join(lines)

    def fetch_own(self) -> str:
        """Returns LLVM IR that loads constants that differ between rods."""
        return "".join(
            self.transpose("fetch", entries, f"%in{1 + i}", "%own", place)
            for i, (entries, place) in enumerate(
                zip(self.step.constants, self.constant_places, strict=True)
            )
            if entries.rate == FIXED
        )

    def transpose(
        self,
        word: str,
        entries: Entries,
        array: str,
        region: str,
        place: int,
        rows: str | None = None,
        row: str = "",
    ) -> str:
        """Returns LLVM IR that copies an array between rows of rods and vectors.

        Args:
            word: `"fetch"` to load an operand, `"bring"` to store a result.
            entries: Type and size of the array, for one rod.
            array: Name of the pointer to the operand or result.
            region: Name of the pointer to the region with the vectors.
            place: Offset in the region [bytes].
            rows: Number of copies that each rod has, such as checkpoints; `None` for
                one.
            row: Index of the copy to move.
        """
        self.n_transposes += 1
        self.transposed.add(entries.kind)
        mark = f"%t{self.n_transposes}"
        size = entries.size
        lines = f"{mark} = getelementptr i8, ptr {region}, i64 {place}\n"
        stride, offset = str(size), "0"
        if rows is not None:
            lines += f"{mark}s = mul i64 {rows}, {size}\n"
            lines += f"{mark}o = mul i64 {row}, {size}\n"
            stride, offset = f"{mark}s", f"{mark}o"
        squares = is_tiled(entries.kind, size, self.width)
        name = f"{word}_squares" if squares else word
        return lines + (
            f"call void @{name}_{entries.kind}(ptr {array}, i64 {stride}, "
            f"i64 {offset}, i64 {size}, i64 %first, i64 %rods, ptr {mark})\n"
        )

    def module(self, per_block: str, n_operands: int, n_results: int) -> str:
        """Returns the LLVM module of the kernel, without the handler that XLA calls.

        `per_block` is the LLVM IR that runs for each block of rods.
        """
        kinds = self.transposed
        texts = list(self.functions)
        declared = set(self.declared)
        for kind in sorted(kinds):
            text, more = transpose_text(kind, self.width)
            texts.append(text)
            declared |= more
        needs: set[tuple[str, str, int]] = set()
        for writer in self.writers:
            declared |= writer.declared
            needs |= writer.needs
        functions, more = elementary_texts(needs)
        texts += functions
        declared |= more
        memory = self.memory
        main = f"""
define void @kernel(ptr %operands, ptr %results) nounwind {{
entry:
{entry_text(n_operands, n_results)}
%raw = ptrtoint ptr %out{n_results - 1} to i64
%raised = add i64 %raw, 63
%aligned = and i64 %raised, -64
%room = inttoptr i64 %aligned to ptr
%shared = getelementptr i8, ptr %room, i64 0
%own = getelementptr i8, ptr %room, i64 {memory.shared.room()}
{self.fetch_shared()}
call void @shared(ptr %shared, ptr %own)
br label %blocks_test
blocks_test:
%first = phi i64 [0, %entry], [%following, %block_done]
%inside = icmp slt i64 %first, %rods
br i1 %inside, label %blocks, label %done
blocks:
{per_block}
block_done:
%following = add i64 %first, {self.width}
br label %blocks_test
done:
ret void
}}
"""
        return "\n".join([*sorted(declared | self.declared), *texts, main])


def goals_in(
    outputs: Sequence[Sequence[int]],
    arrays: Sequence[Entries],
    region: Region,
    places: Sequence[int],
) -> list[tuple[int, Region, int]]:
    """Returns the output nodes of arrays, each with its region and offset [bytes].

    `outputs` has the nodes of each array, `places` the offset of each array in
    `region`. The nodes are ordered by their relative position in the arrays, which is
    the position along the rod. So values of neighbouring elements are computed close
    together.
    """
    ordered = []
    for nodes, entries, place in zip(outputs, arrays, places, strict=True):
        size = BYTES[entries.kind] * region.lanes
        for k, node in enumerate(nodes):
            along = k / max(len(nodes), 1)
            ordered.append((along, node, region, place + k * size))
    ordered.sort(key=lambda goal: goal[0])
    return [goal[1:] for goal in ordered]


def entry_text(n_operands: int, n_results: int) -> str:
    """Returns the LLVM lines that begin a kernel on a CPU.

    They load the data pointers of all operands and results, and the counts of
    `counts_text`.
    """
    loads = [_pointer(f"%in{i}", "%operands", i) for i in range(n_operands)]
    loads += [_pointer(f"%out{i}", "%results", i) for i in range(n_results)]
    return "".join(loads) + counts_text()


def counts_text() -> str:
    """Returns LLVM IR that loads the counts from the first operand of a kernel.

    They are the numbers of steps, of steps between checkpoints, of rods and of
    checkpoints.
    """
    counts = [
        f"%{name}at = getelementptr i32, ptr %in0, i64 {i}\n"
        f"%{name}32 = load i32, ptr %{name}at\n"
        f"%{name} = sext i32 %{name}32 to i64\n"
        for i, name in enumerate(("steps", "every", "rods", "kept"))
    ]
    return "".join(counts)


def _pointer(name: str, array: str, index: int) -> str:
    """Returns LLVM IR that loads the data pointer of one buffer of an XLA call.

    `name` is the name of the pointer, `index` the number of the buffer in the list
    `array` (`%operands` or `%results`).
    """
    return (
        f"{name}b = getelementptr ptr, ptr {array}, i64 {index}\n"
        f"{name}c = load ptr, ptr {name}b\n"
        f"{name}d = getelementptr i8, ptr {name}c, i64 24\n"
        f"{name} = load ptr, ptr {name}d\n"
    )
