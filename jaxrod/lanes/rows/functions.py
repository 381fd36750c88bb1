"""LLVM functions that compute nodes of one graph of rows, and their memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from jaxrod.lanes.jaxpr.unroll import NotUnrolled, kind_of
from jaxrod.lanes.llvm.machine_code import vector_bytes
from jaxrod.lanes.llvm.vector_code import BYTES, TYPES, literal
from jaxrod.lanes.rows.arrays import Rows
from jaxrod.lanes.rows.loop_code import RowWriter, fill_call
from jaxrod.lanes.rows.packing import Packing
from jaxrod.lanes.rows.row_graph import Piece, RowGraph, row_major
from jaxrod.lanes.rows.row_unroller import RowUnroller
from jaxrod.lanes.rows.schedule import Goal, Place, Schedule, fills_of, hoisted

ALIGNMENT = 64
"""Alignment of regions and of stored nodes [bytes]."""
MOST_LINES = 400_000
"""Largest number of LLVM lines of a kernel; a longer program is refused."""


class Storage:
    """A region of the workspace, in which arrays are allocated one after another."""

    def __init__(self, pointer: str, alignment: int = ALIGNMENT) -> None:
        """Creates an empty region.

        Args:
            pointer: Name of its pointer.
            alignment: Alignment of its arrays [bytes].
        """
        self.pointer, self.alignment, self.size = pointer, alignment, 0

    def give(self, kind: str, count: int) -> Place:
        """Allocates `count` numbers of type `kind`; returns their location."""
        place = Place(self.pointer, self.size)
        size = max(count, 1) * BYTES[kind]
        self.size += -(-size // self.alignment) * self.alignment
        return place

    def all(self, avals: Sequence[Any]) -> list[Place]:
        """Allocates arrays of given types, and returns their memory locations."""
        return [self.give(kind_of(aval), math.prod(aval.shape)) for aval in avals]


class RowFunctions:
    """A graph of rows, and the LLVM functions that compute its nodes."""

    alignment = ALIGNMENT
    """Alignment of arrays in memory [bytes]."""
    packs = True
    """Whether sums under a mask may be computed at the entries alone where it is
    true."""
    splits = True
    """Whether a sum of numbers under different masks is computed in parts, so that each
    can be packed."""

    def __init__(self, prefix: str = "") -> None:
        """Creates an empty graph.

        Args:
            prefix: Beginning of the names of all LLVM functions.
        """
        self.prefix = prefix
        self.graph = RowGraph()
        self.unroller = RowUnroller(self.graph)
        if self.splits:
            self.unroller.addends = Packing(self.graph, (), ()).addends
        self.fixed = self.storage("%fixed")
        self.ready: dict[int, Place] = {}
        self.scratch = 0
        self.lasting: dict[int, Place] = {}
        """Locations of nodes that are assembled from pieces (`joined`) with a constant
        in the gaps, which is written once for each scene."""
        self.texts: list[str] = []
        self.declared: set[str] = {
            "declare i64 @llvm.smin.i64(i64, i64)",
            "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)",
            "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)",
        }
        self.needs: set[tuple[str, str, int]] = set()
        self.fills: set[str] = set()
        self.lines = 0
        self.constant_names: list[str] = []
        """Pointers to constants that are in no region of the workspace."""
        self.n_nested = 0
        """Number of loops that are functions of their own."""
        self.taken = False
        """Whether the functions are among those of another graph."""

    def storage(self, pointer: str) -> Storage:
        """Returns an empty region of the workspace, with the name of its pointer."""
        return Storage(pointer, self.alignment)

    def input(self, which: int, aval: Any, rate: int) -> Rows:
        """Adds input array number `which` to the graph, and returns it as rows.

        `rate` is its rate of change: `UNIFORM`, `FIXED` or `VARYING`.
        """
        return self.unroller.input(which, aval, rate)

    def stand(self, first: int, places: Sequence[Place]) -> None:
        """Records the memory locations of input arrays, from number `first` on."""
        for node, (which, _) in self.graph.places.items():
            if first <= which < first + len(places):
                self.ready[node] = places[which - first]

    def goals(self, arrays: Sequence[Rows], places: Sequence[Place]) -> list[Goal]:
        """Returns the nodes of arrays, each with the memory location for its numbers.

        `places` has the location of each array, which is written in row-major order.
        """
        goals = []
        for array, place in zip(arrays, places, strict=True):
            strides = row_major(array.shape)
            own = tuple(strides[axis] for axis in array.loops)
            for index, node in array.entries():
                base = sum(i * s for i, s in zip(index, strides, strict=True))
                goals.append(Goal(node, place, Piece(base, own, array.dims)))
        return goals

    def take(self, other: RowFunctions) -> None:
        """Adds the LLVM functions of another graph to these, once."""
        if other.taken:
            return
        other.taken = True
        self.texts += other.texts
        self.declared |= other.declared
        self.needs |= other.needs
        self.fills |= other.fills
        self.lines += other.lines

    def hoist(self, goals: Sequence[Goal]) -> None:
        """Writes the function `@fixed`, which computes values that all steps share.

        Only values that the goals need are computed.
        """
        graph = self.graph
        self.know_data()
        ends = [goal.node for goal in goals]
        nodes = hoisted(graph, ends, self.ready, packs=self.packs)
        for node in nodes:
            self.ready[node] = self.room_for(node, self.fixed)
        self.function("fixed", [], ["%fixed", *self.constant_names], nodes)

    def room_for(self, node: int, storage: Storage) -> Place:
        """Allocates memory for the numbers of a node, and returns its location.

        A scatter gets one number more, to which dropped numbers are written.
        """
        graph = self.graph
        more = 1 if graph.operations[node] == "scatter" else 0
        return storage.give(graph.kinds[node], math.prod(graph.dims[node]) + more)

    def know_data(self) -> None:
        """Writes arrays of known numbers as constants of the LLVM module."""
        graph = self.graph
        for i, (node, numbers) in enumerate(graph.data.items()):
            kind = graph.kinds[node]
            one = "i8" if kind == "b1" else TYPES[kind]
            entries = ", ".join(
                f"{one} {int(v) if kind == 'b1' else literal(v, kind)}" for v in numbers
            )
            self.texts.append(
                f"@{self.prefix}data{i} = private constant "
                f"[{len(numbers)} x {one}] [{entries}], align {ALIGNMENT}\n"
            )
            self.ready[node] = Place(f"@{self.prefix}data{i}", 0)

    def function(
        self,
        name: str,
        goals: Sequence[Goal],
        pointers: Sequence[str],
        stored: Sequence[int] = (),
    ) -> None:
        """Writes an LLVM function that computes nodes and stores them.

        They are the nodes of the goals, and those in `stored`, whose locations are
        known. `pointers` are the arguments of the function.

        Raises:
            NotUnrolled: The kernel is too long.
        """
        lasting = self.lasting_place if goals else None
        schedule = Schedule(
            self.graph,
            goals,
            self.ready,
            stored,
            lasting,
            self.alignment,
            packs=self.packs,
        )
        writer = self.writer(schedule)
        self.texts.append(writer.text(f"{self.prefix}{name}", ["%scratch", *pointers]))
        for nested in writer.nested:
            self.take(nested)
        self.scratch = max(self.scratch, schedule.size)
        self.declared |= writer.declared
        self.needs |= writer.needs
        self.fills |= writer.fills
        self.lines += writer.count
        if self.lines > MOST_LINES:
            raise NotUnrolled(f"a program of more than {MOST_LINES} lines is too long")

    def writer(self, schedule: Schedule) -> RowWriter:
        """Returns the writer of an LLVM function that runs a schedule."""
        return RowWriter(self.graph, schedule, vector_bytes())

    def lasting_place(self, node: int) -> Place:
        """Returns the location of a node assembled from pieces with constant gaps.

        It is allocated at the first call. The constant is written to the gaps once for
        each scene.
        """
        place = self.lasting.get(node)
        if place is None:
            place = self.room_for(node, self.fixed)
            self.lasting[node] = place
        return place

    def lasting_fills(self) -> str:
        """Returns LLVM IR of the function `@fills`, called once for each scene.

        It writes the constants in the gaps of nodes that are assembled from pieces.
        """
        body = "\n".join(["entry:", *self.fill_calls(""), "ret void"])
        name = f"@{self.prefix}fills"
        return f"define internal void {name}(ptr %fixed) noinline {{\n{body}\n}}\n"

    def fill_calls(self, given: str) -> list[str]:
        """Returns LLVM calls that write constants to the gaps of assembled nodes.

        `given` is the LLVM text of the first arguments of each call.
        """
        graph, lines = self.graph, []
        for node, place in self.lasting.items():
            kind, value = graph.kinds[node], graph.value(graph.arguments[node][-1])
            self.fills.add("i8" if kind == "b1" else TYPES[kind])
            number = str(int(value)) if kind == "b1" else literal(value, kind)
            lines += [
                fill_call(number, place, kind, fill, given)
                for fill in fills_of(graph, node)
            ]
        return lines
