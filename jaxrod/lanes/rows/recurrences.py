"""Loops along a row in which each round needs the one before: `scan` of a few numbers.

Each round does arithmetic on numbers, or on short vectors of equal length, entry by
entry. It is compiled once, as the body of a loop that holds the carry in registers. A
node `recurrence` stores the last carry, followed by the results of all rounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxrod.jax_internals.equations import Scan, operand_types, result_types
from jaxrod.lanes.graph import OPERATIONS, VARYING
from jaxrod.lanes.jaxpr.unroll import kind_of
from jaxrod.lanes.llvm.vector_code import BYTES, TYPES, Writer
from jaxrod.lanes.rows.arrays import Rows, long_axes
from jaxrod.lanes.rows.row_graph import Move, RowGraph

Lines = list[str]


@dataclass(frozen=True, eq=False)
class Recurrence:
    """A `scan` that is compiled as a loop along rows, with its carry in registers.

    The arguments of its graph node are the operands of the scan (constants, carry,
    rows). A vector operand has one argument for each of its entries.
    """

    graph: RowGraph
    """Graph of one round."""
    inputs: Sequence[int]
    """Nodes of the inputs of a round: constants, carry, and one entry of each row."""
    outputs: Sequence[int]
    """Nodes of the outputs of a round: the next carry, then one entry of each
    result."""
    n_constants: int
    n_carry: int
    length: int
    """Number of rounds."""
    backwards: bool
    """Whether the loop begins with the last entries of the rows."""
    shape: tuple[int, ...]
    """Shape of everything that a round takes and returns: `()` for single numbers, and
    `(n,)` for vectors of n numbers, of which n may be 1."""
    kind: str
    """Type of all numbers, such as `"f32"`."""

    @property
    def lanes(self) -> int:
        """Length of the vectors that a round computes with; 1 for single numbers."""
        return self.shape[0] if self.shape else 1

    def stored_at(self, output: int) -> int:
        """Flat index in the stored node at which an output begins.

        The outputs are the arrays of the last carry, then the results of all rounds.
        """
        if output < self.n_carry:
            return output * self.lanes
        made = output - self.n_carry
        return (self.n_carry + made * self.length) * self.lanes


def recurrence(unroller: Any, scan: Scan, arrays: Sequence[Rows]) -> list[Rows] | None:
    """Returns the results of a `scan` that is compiled as one loop along rows.

    `arrays` are the operands of the scan: constants, carry, rows.

    Returns:
        The last carry, then the stacked results. `None` if there are fewer than two
        rounds, or if a round does more than arithmetic on floats, or on short vectors
        of floats, of one type and length.
    """
    body = scan.body
    avals = [*operand_types(body), *result_types(body)]
    shapes, kinds = {aval.shape for aval in avals}, {kind_of(aval) for aval in avals}
    if scan.length < 2 or len(shapes) != 1 or len(kinds) != 1:
        return None
    (shape,), (kind,) = shapes, kinds
    if len(shape) > 1 or shape == (0,) or long_axes(shape) or kind[0] != "f":
        return None
    inside = type(unroller)(RowGraph())
    inputs = [
        inside.graph.place("input", (), kind, shape, i, VARYING)
        for i in range(len(arrays))
    ]
    loops = tuple(range(len(shape)))
    one = [1] * len(shape)
    given = [Rows(shape, loops, np.full(one, node), kind) for node in inputs]
    outputs: list[int] = []
    for array in inside.run(body, given):
        nodes = set(array.nodes.reshape(-1).tolist())
        if len(nodes) != 1:
            return None
        outputs += nodes
    known = {"constant", "input", *OPERATIONS}
    if not {inside.graph.operations[n] for n in inside.graph.needed(outputs)} <= known:
        return None
    made = Recurrence(
        inside.graph,
        inputs,
        outputs,
        scan.n_constants,
        scan.n_carry,
        scan.length,
        scan.backwards,
        shape,
        kind,
    )
    return _results(unroller, made, arrays)


def _results(unroller: Any, made: Recurrence, arrays: Sequence[Rows]) -> list[Rows]:
    layout, shape = unroller.layout, made.shape
    first_row = made.n_constants + made.n_carry
    given = [
        _of_lane(layout, array, lane, int(i >= first_row))
        for i, array in enumerate(arrays)
        for lane in range(made.lanes)
    ]
    size = made.stored_at(len(made.outputs))
    node = unroller.graph.place("recurrence", tuple(given), made.kind, (size,), made)
    results = []
    for output in range(len(made.outputs)):
        whole = shape if output < made.n_carry else (made.length, *shape)
        at = made.stored_at(output)
        results.append(layout.views((node, at), whole, long_axes(whole), made.kind))
    return results


def _of_lane(layout: Any, array: Rows, lane: int, rows: int) -> int:
    """Returns the node of entry `lane` of the vectors in an operand of a scan.

    `rows` is 1 if the operand is scanned along its leading axis, otherwise 0.
    """
    graph = layout.graph
    if len(array.shape) > rows:
        start = [0] * rows + [lane]
        moves = [Move(axis) for axis in range(rows)]
        array = layout.taken(array, array.shape[:rows], start, moves)
    nodes = array.nodes.reshape(-1).tolist()
    if rows and len(nodes) > 1 and {graph.operations[n] for n in nodes} == {"view"}:
        # Single numbers at equal distances in a stored node are a view of it.
        sources = {graph.arguments[n] for n in nodes}
        at = [graph.extras[n][0] for n in nodes]
        step = at[1] - at[0]
        if len(sources) == 1 and at == [at[0] + i * step for i in range(len(at))]:
            return graph.view(sources.pop()[0], (len(at),), at[0], (step,))
    return int(layout.looped(array, tuple(range(rows))).nodes.reshape(-1)[0])


class _RoundWriter(Writer):
    """Writer of one round of a recurrence, which appends to another writer's lines."""

    def __init__(self, graph: RowGraph, lanes: int, outer: Any) -> None:
        super().__init__(graph, lanes, lambda writer, node: None)
        self.outer, self.lines = outer, outer.lines
        self.needs, self.declared = outer.needs, outer.declared

    def new(self, text: str) -> str:
        return self.outer.new(text)


def write_recurrence(writer: Any, number: int, node: int) -> Lines:
    """Returns LLVM IR of the loop of a recurrence.

    Args:
        writer: Writer of the function.
        number: Number of the loop, for its labels.
        node: Node of the recurrence.
    """
    graph, schedule = writer.graph, writer.schedule
    made: Recurrence = graph.extras[node]
    given, lanes = graph.arguments[node], made.lanes
    place = schedule.place(node)
    mark = f"g{number}"
    before: Lines = []
    body: Lines = []
    writer.names, writer.spreads = {}, {}
    writer.width, writer.dims = 1, (made.length,)
    writer.before, writer.indices = [before, body], [f"%i_{mark}"]
    inside = _RoundWriter(made.graph, lanes, writer)
    many = inside.type(made.kind)
    names, begun = inside.names, []
    for i, entry in enumerate(made.inputs):
        own = given[i * lanes : (i + 1) * lanes]
        is_row = i >= made.n_constants + made.n_carry
        writer.lines = body if is_row else before
        names[entry] = _vector(writer, own, many)
        if made.n_constants <= i and not is_row:
            begun.append(names[entry])
            names[entry] = f"%a_{mark}_{i}"
    writer.lines = inside.lines = body
    places: dict[int, list[int]] = {}
    for output in range(made.n_carry, len(made.outputs)):
        places.setdefault(made.outputs[output], []).append(made.stored_at(output))

    def store(name: str, at: int, strides: tuple[int, ...]) -> None:
        to = writer.address(place, at, strides, made.kind)
        writer.lines.append(f"store {many} {name}, ptr {to}, align {BYTES[made.kind]}")

    def kept(entry: int) -> None:
        for at in places.pop(entry, ()):
            store(inside.value(entry), at, (lanes,))

    order = made.graph.needed(made.outputs)
    inside.write(order, kept)
    for entry in list(places):
        kept(entry)
    carried = [inside.value(entry) for entry in made.outputs[: made.n_carry]]
    phis = [
        f"%a_{mark}_{made.n_constants + i} = phi {many} "
        f"[{first}, %{mark}_pre], [{later}, %{mark}]"
        for i, (first, later) in enumerate(zip(begun, carried, strict=True))
    ]
    first = f"add i64 %c_{mark}, 0"
    if made.backwards:
        first = f"sub i64 {made.length - 1}, %c_{mark}"
    after: Lines = []
    writer.lines, writer.indices = after, []
    for i, name in enumerate(carried):
        store(name, made.stored_at(i), ())
    return [
        *before,
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


def _vector(writer: Any, nodes: Sequence[int], many: str) -> str:
    """Appends lines that load or assemble a vector; returns its name.

    Its entries are the numbers of nodes at the index of the loop. `many` is its LLVM
    type.
    """
    graph, kind = writer.graph, writer.graph.kinds[nodes[0]]
    if len(nodes) == 1:
        return writer.stored_number(nodes[0])
    if len(set(nodes)) == 1 and graph.value(nodes[0]) is not None:
        entry = f"{TYPES[kind]} {writer.literal(graph.value(nodes[0]), kind)}"
        return "<" + ", ".join([entry] * len(nodes)) + ">"
    views = [graph.extras[n] for n in nodes if graph.operations[n] == "view"]
    sources = {graph.arguments[n] for n in nodes}
    if len(views) == len(nodes) and len(sources) == 1:
        base, strides = views[0]
        beside = [(base + i, strides) for i in range(len(nodes))]
        if views == beside and graph.dims[nodes[0]]:
            place = writer.schedule.place(sources.pop()[0])
            at = writer.address(place, base, strides, kind)
            return writer.new(f"load {many}, ptr {at}, align {BYTES[kind]}")
    name = "poison"
    for lane, node in enumerate(nodes):
        one = writer.stored_number(node)
        name = writer.new(
            f"insertelement {many} {name}, {TYPES[kind]} {one}, i64 {lane}"
        )
    return name
