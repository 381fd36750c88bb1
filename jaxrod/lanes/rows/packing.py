"""Sums of numbers that are zero except where a mask is true, over true entries alone.

Of the pairs on a neighbour list few touch. So the entries at which the mask is true are
put into a list, and a *packed loop* computes the numbers at these entries, a vector of
entries at a time. It reads rows by gathers, and adds the numbers one after another to
sums in memory, in the order of the list.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from jaxrod.lanes.rows.row_graph import Dims, RowGraph, row_major

STORED = frozenset(
    {"joined", "scatter", "recurrence", "result", "reduce", "input", "data"}
)
"""Operations whose results are arrays in memory. The results of other operations are
values within the loop that computes them."""
LEAST_ENTRIES = 8
"""Smallest number of entries of a mask for which a loop is packed."""
LEAST_WORK = 60
"""Smallest work per entry that is left out where the mask is false for which a loop is
packed, in additions."""
LEAST_IN_ALL = 8000
"""Smallest work of all entries for which a loop is packed, in additions."""
MOST_MASKS = 4
"""Largest number of masks for which a sum is computed in parts."""
_WORK = {"div": 8, "sqrt": 10, "rsqrt": 16, "view": 0, "iota": 0, "constant": 0}
_ARITHMETIC = frozenset({"add", "sub", "mul", "min", "max", "neg", "select", "convert"})
_ELEMENTARY = 20
"""Work of other operations, in additions."""


@dataclass
class Sum:
    """A sum of numbers that are zero except where a mask is true."""

    mask: int
    """Node of the mask."""
    terms: list[tuple[int, int]] = field(default_factory=list)
    """Numbers that are added up: each a sign, 1 or -1, and a node of the mask's
    shape."""
    index: int | None = None
    """Node of the index at which the numbers of an entry are added; `None` for a
    reduction."""
    inside: list[int] = field(default_factory=list)
    """Nodes that a packed loop computes, each after its arguments."""
    leaves: list[int] = field(default_factory=list)
    """Nodes that must be available before the packed loop."""


class Packing:
    """The sums among some nodes of a graph that packed loops compute."""

    def __init__(
        self, graph: RowGraph, order: Sequence[int], ready: Iterable[int]
    ) -> None:
        """Finds the sums for which a packed loop is likely to be faster.

        Args:
            graph: The graph of rows.
            order: Nodes that are to be computed, each after its arguments.
            ready: Nodes that are stored already.
        """
        self._graph, self._ready = graph, set(ready)
        self._masks: dict[int, int | None] = {}
        self.sums: dict[int, Sum] = {}
        """Sums that packed loops compute, by node: reductions and scatters."""
        found: dict[int, dict[int, Sum]] = {}
        for node in order:
            one = self._sum(node)
            if one is not None:
                self._trace(node, one)
                found.setdefault(one.mask, {})[node] = one
        for mask, sums in found.items():
            saved = self._saved(mask, sums.values())
            entries = math.prod(graph.dims[mask])
            if saved >= LEAST_WORK and saved * entries >= LEAST_IN_ALL:
                self.sums.update(sums)

    def computed(self, goals: Iterable[int]) -> set[int]:
        """Returns the nodes that loops other than packed ones must compute.

        `goals` are the nodes that are to be available after all loops.
        """
        graph, found, stack = self._graph, set(), list(goals)
        while stack:
            node = stack.pop()
            if node in found:
                continue
            found.add(node)
            one = self.sums.get(node)
            given = graph.arguments[node] if one is None else one.leaves
            stack += [argument for argument in given if argument not in self._ready]
        return found

    def independent(self, order: Sequence[int]) -> dict[int, list[int]]:
        """Returns the sums under each mask, if none of them depends on another.

        `order` has all nodes to be computed, each after its arguments. Sums are given
        by node, and masks without such sums are left out.
        """
        number = {node: 1 << i for i, node in enumerate(self.sums)}
        before: dict[int, int] = {}
        groups: dict[int, list[int]] = {}
        for node, one in self.sums.items():
            groups.setdefault(one.mask, []).append(node)
        for node in order:
            depends = 0
            for argument in self._graph.arguments[node]:
                depends |= before.get(argument, 0) | number.get(argument, 0)
            before[node] = depends
        every = {mask: sum(number[n] for n in nodes) for mask, nodes in groups.items()}
        return {
            mask: nodes
            for mask, nodes in groups.items()
            if not any(before[node] & every[mask] for node in nodes)
        }

    def _sum(self, node: int) -> Sum | None:
        """Returns a node as a sum under a mask, without `inside` and `leaves`."""
        graph = self._graph
        operation, arguments = graph.operations[node], graph.arguments[node]
        if operation not in ("reduce", "scatter") or graph.extras[node][0] != "add":
            return None
        if graph.kinds[node][0] != "f":
            return None
        if operation == "reduce":
            (number,), index = arguments, None
            mask = self._mask(number)
            terms = [(1, number)]
        else:
            index, number = arguments[1], arguments[2]
            dims = (graph.extras[node][1],)
            if graph.dims[index] != dims or graph.dims[number] != dims:
                return None
            mask = arguments[3] if len(arguments) == 4 else self._mask(number)
            terms = [(1, number)]
            within = self._summed(number)
            if within is not None:
                over, terms = within
                if mask is not None and not self._is_any(mask, over):
                    return None
                mask = over
        if mask is None or len(graph.dims[mask]) > 2:
            return None
        if any(graph.dims[number] != graph.dims[mask] for _, number in terms):
            return None
        if math.prod(graph.dims[mask]) < LEAST_ENTRIES:
            return None
        if graph.operations[mask] == "view" and graph.extras[mask][1][-1] != 1:
            return None
        return Sum(mask, terms, index)

    def _summed(self, node: int) -> tuple[int, list[tuple[int, int]]] | None:
        """Returns a row as a sum of terms over the first axis of a table under a mask.

        Returns:
            The mask and the terms; `None` if the row is something else.
        """
        graph = self._graph
        operation, arguments = graph.operations[node], graph.arguments[node]
        if operation == "neg":
            one = self._summed(arguments[0])
            return one and (one[0], [(-sign, term) for sign, term in one[1]])
        if operation == "reduce" and graph.extras[node] == ("add", (0,)):
            mask = self._mask(arguments[0])
            table = len(graph.dims[arguments[0]]) == 2
            if mask is not None and table and graph.dims[node]:
                return mask, [(1, arguments[0])]
        return None

    def _is_any(self, mask: int, over: int) -> bool:
        """Whether a mask is true where a table's mask is true somewhere in a column."""
        graph = self._graph
        return (
            graph.operations[mask] == "reduce"
            and graph.extras[mask] == ("or", (0,))
            and graph.arguments[mask] == (over,)
        )

    def addends(self, node: int) -> list[int]:
        """Returns a sum of numbers under different masks as its parts, one for each.

        The parts add up to the node. If a part is under no mask, or if there are more
        than a few masks, the node itself is returned: it has to be computed everywhere.
        """
        graph = self._graph
        if math.prod(graph.dims[node]) * LEAST_WORK < LEAST_IN_ALL:
            return [node]
        parts: dict[int, int] = {}
        stack = [(1, node)]
        while stack:
            sign, now = stack.pop()
            mask = self._mask(now)
            operation, given = graph.operations[now], graph.arguments[now]
            if mask is None and operation in ("add", "sub"):
                stack.append((sign, given[0]))
                stack.append((-sign if operation == "sub" else sign, given[1]))
            elif mask is None and operation == "neg":
                stack.append((-sign, given[0]))
            elif mask is None or graph.dims[now] != graph.dims[node]:
                return [node]
            else:
                kind = graph.kinds[now]
                one = now if sign == 1 else graph.add("neg", (now,), kind)
                old = parts.get(mask)
                parts[mask] = one if old is None else graph.add("add", (old, one), kind)
        return list(parts.values()) if len(parts) <= MOST_MASKS else [node]

    def _mask(self, node: int) -> int | None:
        """Returns a mask outside of which a node's numbers are zero, or `None`."""
        if node not in self._masks:
            self._masks[node] = self._found_mask(node)
        return self._masks[node]

    def _found_mask(self, node: int) -> int | None:
        graph = self._graph
        operation, arguments = graph.operations[node], graph.arguments[node]
        dims = graph.dims[node]
        if not dims or node in self._ready:
            return None
        if operation == "select":
            condition, yes, no = arguments
            if graph.value(no) == 0:
                return condition if graph.dims[condition] == dims else self._mask(yes)
            if graph.value(yes) == 0:
                return self._mask(no)
            arguments = (yes, no)
        if operation in ("add", "sub", "select"):
            one, two = map(self._mask, arguments[:2])
            return one if one == two else None
        if operation == "mul":
            one, two = map(self._mask, arguments)
            return two if one is None else one
        if operation in ("neg", "convert"):
            return self._mask(arguments[0])
        return None

    def _trace(self, node: int, one: Sum) -> None:
        """Finds the nodes of a sum inside a packed loop, and those before it."""
        graph, mask = self._graph, one.mask
        leaves = {mask: None}
        roots = [number for _, number in one.terms]
        if one.index is not None:
            leaves[graph.arguments[node][0]] = None
            roots.append(one.index)
        seen: set[int] = set()
        stack = [(root, False) for root in reversed(roots)]
        while stack:
            now, expanded = stack.pop()
            if expanded:
                one.inside.append(now)
                continue
            if now in seen or graph.operations[now] == "constant":
                continue
            seen.add(now)
            if self.is_leaf(now):
                leaves[now] = None
                continue
            stack.append((now, True))
            given: Sequence[int] = graph.arguments[now]
            if graph.operations[now] == "gather":
                leaves[given[0]] = None
                given = given[1:]
            elif graph.operations[now] == "view" and not self.is_followed(now):
                leaves[given[0]] = None
                given = ()
            elif self.is_chosen(now, mask):
                given = given[1:2]
            stack += [(argument, False) for argument in reversed(given)]
        one.leaves = [leaf for leaf in leaves if graph.value(leaf) is None]

    def is_leaf(self, node: int) -> bool:
        """Whether a packed loop reads a node instead of computing it."""
        graph = self._graph
        stored = node in self._ready or graph.operations[node] in STORED
        return stored or (not graph.dims[node] and graph.operations[node] != "iota")

    def is_followed(self, view: int) -> bool:
        """Whether a packed loop computes a view from what computes the row it reads."""
        (source,) = self._graph.arguments[view]
        return len(self._graph.dims[source]) == 1 and not self.is_leaf(source)

    def is_chosen(self, node: int, mask: int) -> bool:
        """Whether a node is its second argument wherever a mask is true."""
        graph = self._graph
        return graph.operations[node] == "select" and graph.arguments[node][0] == mask

    def _saved(self, mask: int, sums: Iterable[Sum]) -> float:
        """Returns the work per entry of a mask that is left out where it is false."""
        needed: set[int] = set()
        stack = [mask]
        while stack:
            node = stack.pop()
            if node not in needed:
                needed.add(node)
                stack += self._graph.arguments[node]
        within = {node for one in sums for node in one.inside} - needed
        whole = math.prod(self._graph.dims[mask])
        return sum(self._work(node) / whole for node in within)

    def _work(self, node: int) -> float:
        operation = self._graph.operations[node]
        usual = 1 if operation in _ARITHMETIC else _ELEMENTARY
        work = _WORK.get(operation, usual)
        return work * math.prod(self._graph.dims[node])


def entry_strides(graph: RowGraph, node: int, dims: Dims) -> Dims:
    """Returns the distances in a reduction's result between neighbours of its source.

    They are in numbers, one for each of the source's axes, whose lengths are `dims`; 0
    for an axis along which the numbers are summed.
    """
    _, axes = graph.extras[node]
    kept = [axis for axis in range(len(dims)) if axis not in axes]
    own = dict(zip(kept, row_major(graph.dims[node]), strict=True))
    return tuple(own.get(axis, 0) for axis in range(len(dims)))
