"""Common part of the writers of loops: of rows, and of lanes in loops."""

from __future__ import annotations

from jaxrod.lanes.llvm.vector_code import Writer
from jaxrod.lanes.rows.row_graph import Dims, RowGraph
from jaxrod.lanes.rows.schedule import Goal, Place, Schedule

Lines = list[str]


class LoopWriter(Writer):
    """Writer of an LLVM function that runs the loops of a schedule.

    A subclass says how numbers of a loop are read from memory and written to it.
    """

    graph: RowGraph

    def __init__(self, graph: RowGraph, schedule: Schedule, width: int) -> None:
        """Begins an LLVM function without lines.

        Args:
            graph: The graph of rows.
            schedule: Loops of the function.
            width: Lanes of a vector; 1 for single numbers.
        """
        super().__init__(graph, width, lambda writer, node: None)
        self.schedule = schedule
        self.count = 0
        self.numbers: dict[int, str] = {}
        """LLVM names of nodes without rows, by node; they can be used in all later
        loops."""
        self.behind: list[Lines] = [[]]
        """Lines after each loop of a nest, from the outermost loop on."""
        self.dims: Dims = ()
        self.indices: list[str] = []
        self.fills: set[str] = set()
        """Types of numbers for which a fill function is needed."""

    def new(self, text: str) -> str:
        """Appends a line that computes the expression `text`; returns its name."""
        self.count += 1
        name = f"%v{self.count}"
        self.lines.append(f"{name} = {text}")
        return name

    def _computed(self, node: int) -> str:
        operation = self.graph.operations[node]
        if operation == "gather":
            return self._gather(node)
        if operation == "view":
            return self._read(node)
        return self.operation(node)

    def _write(self, goal: Goal) -> None:
        place = self.schedule.goal_place(goal)
        kind, piece = self.graph.kinds[goal.node], goal.piece
        self._store(self.value(goal.node), place, piece.base, piece.strides, kind)

    def _combined(self, operation: str, a: str, b: str, kind: str) -> str:
        """Appends a reduction's operation on two values; returns the result's name.

        `a` and `b` are the names of the values, `kind` is their type.
        """
        if operation in ("min", "max"):
            return self._extreme(operation, (-1, -1), [a, b], kind)
        if kind[0] == "f":
            return self._float(operation, [a, b], kind)
        return self._whole(operation, [a, b], kind)

    def _gather(self, node: int) -> str:
        """Appends the read of a stored node at computed indices; returns its name."""
        raise NotImplementedError

    def _read(self, node: int) -> str:
        """Appends the load of a view or stored node, or an index; returns its name."""
        raise NotImplementedError

    def _store(
        self, name: str, place: Place, base: int, strides: Dims, kind: str
    ) -> None:
        """Appends the store of a value at the indices of the loops."""
        raise NotImplementedError
