"""Bodies of a kernel: what is worked out once, once for each rod, and in every step.

A kernel's memory has one region that all rods share (single numbers), one for what
stays with a block of rods (a vector for every number), and buffers of vectors for what
changes. Every number has its place, known when the kernel is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING, Graph
from jaxrod.lanes.transport import room_for
from jaxrod.lanes.vector_code import BYTES, TYPES, Writer

ALIGNMENT = 64
"""Of vectors in memory [bytes]."""
_ATTRIBUTES = f"noinline nounwind alignstack({ALIGNMENT})"
"""Of functions. Left to itself LLVM puts vectors that it has no register for where they
lie across two lines of the cache."""


@dataclass
class Region:
    """A stretch of memory and the places given away in it."""

    pointer: str
    """Its name in the functions of a kernel."""
    lanes: int
    """1 for single numbers."""
    size: int = 0
    """Bytes given away."""

    def place(self, kind: str, count: int = 1) -> int:
        """Room for some numbers of a kind, one after another; its offset in bytes."""
        step = BYTES[kind] * self.lanes
        aligned = min(ALIGNMENT, max(step, 1))
        start = -(-self.size // aligned) * aligned
        self.size = start + room_for(kind, count, self.lanes) * step
        return start

    def room(self) -> int:
        """Bytes, so that another region can follow."""
        return -(-self.size // ALIGNMENT) * ALIGNMENT


@dataclass
class Memory:
    """Where the numbers of a kernel are: inputs by array, others by node."""

    graph: Graph
    width: int
    shared: Region = field(init=False)
    own: Region = field(init=False)
    arrays: dict[int, tuple[Region, int]] = field(default_factory=dict)
    nodes: dict[int, tuple[Region, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Begins with nothing in either region."""
        self.shared = Region("%shared", 1)
        self.own = Region("%own", self.width)

    def give(self, which: int, region: Region, kind: str, count: int) -> int:
        """A place for an array of inputs."""
        offset = region.place(kind, count)
        self.arrays[which] = region, offset
        return offset

    def keep(self, used: Sequence[int]) -> tuple[list[int], list[int]]:
        """Places for what steps use and does not change: shared, and for each rod.

        Args:
            used: All nodes of the kernel that are needed, in order.
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
        """Places for outputs that do not change."""
        for node in outputs:
            rate = self.graph.rates[node]
            if rate in (UNIFORM, FIXED):
                region = self.shared if rate == UNIFORM else self.own
                self._placed({node: None}, rate, region)

    def where(self, node: int) -> tuple[Region, int] | None:
        """The place of a node that is in memory."""
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


def body(
    name: str,
    memory: Memory,
    width: int,
    rate: int,
    outputs: Sequence[tuple[int, Region, int]],
    pointers: Sequence[str],
) -> tuple[str, Writer]:
    """One function that works out outputs and writes them to their places.

    Args:
        name: Of the function.
        memory: Where everything is.
        width: Lanes of its values.
        rate: How often it runs; what changes less often is read from memory.
        outputs: Nodes, and where they go: region and offset.
        pointers: Names of its arguments, the pointers to the regions.
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


__all__ = ["VARYING", "Memory", "Region", "body"]
