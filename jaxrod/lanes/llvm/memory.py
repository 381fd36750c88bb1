"""Memory of a kernel with a rod in each vector lane, and functions that use it.

A function runs once, once for each block of rods, or in every step.

A kernel's memory has one region that all rods share (single numbers), one for the
loop-invariant values of a block of rods (a vector for every number), and buffers of
vectors for values that change. Every number has a fixed offset, known when the kernel
is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from jaxrod.lanes.graph import FIXED, UNIFORM, Graph
from jaxrod.lanes.llvm.transpose import room_for
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
        """Allocates `count` numbers of a type, and returns their offset [bytes]."""
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
        """Creates the empty regions of values shared by all rods and fixed for each."""
        self.shared = Region("%shared", 1)
        self.own = Region("%own", self.width)

    def give(self, which: int, region: Region, kind: str, count: int) -> int:
        """Allocates input array number `which`, and returns its offset [bytes]."""
        offset = region.place(kind, count)
        self.arrays[which] = region, offset
        return offset

    def keep(self, used: Sequence[int]) -> tuple[list[int], list[int]]:
        """Allocates loop-invariant values that values of a higher rate need.

        Such a value is the same for all rods, or fixed for each rod.

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
    writer = Writer(graph, width, _reader(memory, rate))
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
