"""Schedules: order of the loops that compute the nodes of a graph of rows, and memory.

Nodes of the same shape are computed in one loop, unless one needs all numbers of
another: a shifted view, a gather or a sum. So nodes get *levels*. A loop computes all
nodes of one level and shape, and stores those that other loops need.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from jaxrod.lanes.graph import VARYING
from jaxrod.lanes.llvm.vector_code import BYTES
from jaxrod.lanes.rows.packing import STORED, Packing
from jaxrod.lanes.rows.row_graph import Dims, Piece, RowGraph

LEAST_SKIPPED = 8
"""Smallest number of operations under a mask for which vectors are skipped."""
MOST_STORED = 16_384
"""Largest table that is stored for packed loops alone [numbers]."""
ALIGNMENT = 64
"""Default alignment of stored nodes [bytes]."""


@dataclass(frozen=True)
class Place:
    """A memory location: a pointer and an offset."""

    pointer: str
    """Name of the pointer to a region of memory."""
    offset: int
    """Distance of the location from the pointer [bytes]."""


@dataclass(frozen=True)
class Goal:
    """A node to be computed, and the part of an array to which it is written."""

    node: int
    place: Place
    """Memory location of the array."""
    piece: Piece
    """Part of the array that is written."""


@dataclass(frozen=True)
class Fill:
    """Gaps of equal length and spacing in a node that is assembled from pieces.

    One number, the fill, is written to every position of a gap.
    """

    node: int
    first: int
    """Flat index of the first number of the first gap."""
    count: int
    """Length of each gap."""
    runs: int = 1
    stride: int = 0
    """Distance between the beginnings of neighbouring gaps; 0 if there is one gap."""


@dataclass
class Loop:
    """A loop nest that computes nodes of one shape, or straight-line code.

    Its shape `dims` is () for straight-line code on single numbers.
    """

    level: int
    dims: Dims
    nodes: list[int] = field(default_factory=list)
    goals: list[Goal] = field(default_factory=list)
    """Nodes that are written to given memory locations."""
    reductions: list[int] = field(default_factory=list)
    scatters: list[int] = field(default_factory=list)
    """Nodes of scatters with the same indices, which are a loop without other nodes."""
    recurrence: int | None = None
    """Node of a recurrence, which is a loop without other nodes; `None` for other
    loops."""
    nested: int | None = None
    """Node of a loop that is a function of its own; `None` for other loops."""
    mask: int | None = None
    """Node of a mask; vectors in which it is false everywhere are skipped. `None` if
    all vectors are computed."""
    packed: list[int] = field(default_factory=list)
    """Nodes of sums that the loop computes at the entries alone where its mask is true;
    empty in other loops."""


class Schedule:
    """Order of the loops that compute the required nodes (goals) of a graph of rows.

    It also holds the memory locations of the nodes that the loops store.
    """

    def __init__(
        self,
        graph: RowGraph,
        goals: Sequence[Goal],
        ready: dict[int, Place],
        stored: Iterable[int] = (),
        lasting: Callable[[int], Place] | None = None,
        alignment: int = ALIGNMENT,
        *,
        packs: bool = False,
    ) -> None:
        """Assigns nodes to loops, and memory to the nodes that loops store.

        Args:
            graph: The graph of rows.
            goals: Nodes to be written to given memory locations.
            ready: Memory locations of nodes that are stored already.
            stored: Nodes that are to be computed and stored; their locations are in
                `ready` too.
            lasting: Function that returns a location for a node that is assembled from
                pieces, with a constant in the gaps. The constant is written there once,
                not at every step.
            alignment: Alignment of the nodes that the loops store [bytes].
            packs: Whether sums under a mask may be computed by packed loops.
        """
        self.alignment = alignment
        self.graph, self.ready = graph, dict(ready)
        self.fresh = set(stored)
        self.places: dict[int, Place] = {}
        """Memory locations of the nodes that the loops store."""
        self.fills: dict[int, list[Fill]] = {}
        """Gaps in nodes that are assembled from pieces, by the level at which they are
        filled."""
        self._lasting = lasting
        self.size = 0
        """Memory for all nodes that the loops store [bytes]."""
        self._at: dict[int, int] = {}
        self._done: dict[int, int] = {}
        self._loops: dict[tuple[int, Dims, str], Loop] = {}
        self._kept: set[int] = set()
        self._read: dict[int, int] = {}
        self._goals = list(goals)
        self.order = self._needed()
        self.packing = Packing(graph, self.order if packs else (), self.ready)
        self._floors: dict[int, int] = {}
        if self.packing.sums:
            ends = [*(goal.node for goal in self._goals), *self.fresh]
            computed = self.packing.computed(ends)
            whole, self.order = self.order, [n for n in self.order if n in computed]
        self._masks = self._masked()
        self._levels()
        if self.packing.sums:
            self._join_sums(whole)
        for goal in goals:
            self._write(goal)
        for node in self.order:
            self._use(node)
        self._read_by_packed()
        self.loops = [self._loops[key] for key in sorted(self._loops, key=_key)]
        rank = {node: i for i, node in enumerate(self.order)}
        for loop in self.loops:
            loop.nodes = sorted(set(loop.nodes), key=rank.__getitem__)
        self._allocate()

    def place(self, node: int) -> Place | None:
        """Returns the memory location of a node; `None` if it is not stored."""
        return self.ready.get(node) or self.places.get(node)

    def is_ready(self, node: int) -> bool:
        """Whether a node is available before the first loop.

        True for a node that is stored already, and for a constant or an index.
        """
        if node in self.fresh:
            return False
        return node in self.ready or self.graph.operations[node] in (
            "constant",
            "iota",
        )

    def _needed(self) -> list[int]:
        graph, order, seen = self.graph, [], set()
        for start in [*(goal.node for goal in self._goals), *self.fresh]:
            stack = [(start, False)]
            while stack:
                node, expanded = stack.pop()
                if expanded:
                    order.append(node)
                    continue
                if node in seen or self.is_ready(node):
                    continue
                seen.add(node)
                stack.append((node, True))
                stack.extend((a, False) for a in reversed(graph.arguments[node]))
        return order

    def _masked(self) -> dict[int, int]:
        """Returns the mask of each node that matters only where the mask is true.

        Such a node is used only by scatters under that mask, by its conjunction with
        that mask, and by other such nodes. Indices of gathers are excluded, because
        they must be inside the array everywhere. The masks are stored before the first
        loop.
        """
        graph = self.graph
        users: dict[int, list[tuple[int, int]]] = {}
        for node in self.order:
            if node in self.packing.sums:
                continue
            for position, argument in enumerate(graph.arguments[node]):
                users.setdefault(argument, []).append((node, position))
        apart = {goal.node for goal in self._goals} | self.fresh
        apart.update(n for one in self.packing.sums.values() for n in one.leaves)
        masks: dict[int, int] = {}
        for node in reversed(self.order):
            operation, dims = graph.operations[node], graph.dims[node]
            if not dims or node in apart or operation in ("view", *STORED):
                continue
            found = set()
            for user, position in users[node]:
                given = graph.arguments[user]
                if graph.operations[user] == "scatter":
                    last = given[3] if position == 2 and len(given) == 4 else None
                elif graph.operations[user] == "gather":
                    last = None
                else:
                    last = masks.get(user)
                    if last is None and self._is_conjunction(user):
                        last = given[1 - position]
                found.add(last)
            (mask,) = found if len(found) == 1 else (None,)
            if mask is None or graph.dims[mask] != dims:
                continue
            if self._is_stored_first(mask):
                masks[node] = mask
        work: dict[int, int] = {}
        for node, mask in masks.items():
            work[mask] = work.get(mask, 0) + (graph.operations[node] != "iota")
        return {n: mask for n, mask in masks.items() if work[mask] >= LEAST_SKIPPED}

    def _is_stored_first(self, mask: int) -> bool:
        """Whether a mask is stored before the first loop."""
        graph = self.graph
        stored = graph.arguments[mask] if graph.operations[mask] == "view" else ()
        return self.is_ready(stored[0] if stored else mask)

    def _is_conjunction(self, node: int) -> bool:
        """Whether a node is the conjunction of two masks."""
        graph = self.graph
        return graph.operations[node] == "and" and graph.kinds[node] == "b1"

    def _after(self, node: int) -> int:
        """Returns the first level at which all numbers of a node are available."""
        return 0 if self.is_ready(node) else self._done[node] + 1

    def _beside(self, node: int, dims: Dims, mask: int | None = None) -> int:
        """Returns the first level at which a loop can use a node, entry by entry.

        `dims` and `mask` are the shape and the mask of that loop. If the same loop can
        compute the node, it is the level of the node; otherwise it is a later one.
        """
        graph = self.graph
        if self.is_ready(node):
            return 0
        inline = graph.operations[node] not in STORED
        same = operation_is_read(graph, node) or self._masks.get(node) == mask
        if inline and graph.dims[node] == dims and same:
            return self._at[node]
        return self._after(node)

    def _levels(self) -> None:
        for node in self.order:
            self._level(node)

    def _join_sums(self, order: Sequence[int]) -> None:
        """Raises the levels of sums under one mask, so that one loop computes them.

        `order` has all nodes, also those inside of packed loops.
        """
        groups = self.packing.independent(order)
        for _ in range(len(groups) + 1):
            floors = {
                node: max(self._at[other] for other in nodes)
                for nodes in groups.values()
                for node in nodes
            }
            if floors == self._floors:
                break
            self._floors = floors
            self._levels()

    def _level(self, node: int) -> None:
        if node in self.packing.sums:
            leaves = self.packing.sums[node].leaves
            level = max(self._after(leaf) for leaf in leaves)
            level = max(level, self._floors.get(node, 0))
            self._at[node] = self._done[node] = level
            return
        graph = self.graph
        operation, arguments = graph.operations[node], graph.arguments[node]
        dims = graph.dims[node]
        if operation == "view":
            level = self._after(arguments[0])
        elif operation == "reduce":
            level = self._beside(arguments[0], graph.dims[arguments[0]])
        elif operation == "gather":
            mask = self._masks.get(node)
            at = self._beside(arguments[1], dims, mask)
            level = max(self._after(arguments[0]), at)
        elif operation in ("scatter", "recurrence", "nested"):
            level = max((self._after(a) for a in arguments), default=0)
        elif operation == "result":
            level = self._at[arguments[0]]
        elif operation == "joined":
            level = self._after(arguments[-1])
            for source, piece in self._pieces(node):
                level = max(level, self._piece_level(source, piece))
        else:
            mask = self._masks.get(node)
            level = max((self._beside(a, dims, mask) for a in arguments), default=0)
        self._at[node] = self._done[node] = level

    def _pieces(self, node: int) -> list[tuple[int, Piece]]:
        sources = self.graph.arguments[node][:-1]
        return list(zip(sources, self.graph.extras[node], strict=True))

    def _piece_level(self, source: int, piece: Piece) -> int:
        return self._beside(source, piece.dims)

    def _loop(
        self, level: int, dims: Dims, what: str = "loop", mask: int | None = None
    ) -> Loop:
        key = (level, dims, what if mask is None else f"{what} under {mask}")
        if key not in self._loops:
            self._loops[key] = loop = Loop(level, dims, mask=mask)
            if mask is not None:
                self._take(mask, loop)
        return self._loops[key]

    def _write(self, goal: Goal) -> None:
        level = self._piece_level(goal.node, goal.piece)
        loop = self._loop(level, goal.piece.dims)
        loop.goals.append(goal)
        self._take(goal.node, loop)

    def _take(self, node: int, loop: Loop) -> None:
        """Records that a loop uses a node; a node of an earlier loop will be stored."""
        graph = self.graph
        if self.is_ready(node):
            return
        operation, dims = graph.operations[node], graph.dims[node]
        if operation == "view":
            self._keep(graph.arguments[node][0], loop.level)
            return
        if not dims:
            if loop.dims == () and operation not in STORED:
                return
            self._read[node] = max(self._read.get(node, 0), loop.level)
            return
        here = self._at[node] == loop.level and dims == loop.dims
        if operation in STORED or not here or self._masks.get(node) != loop.mask:
            self._keep(node, loop.level)

    def _keep(self, node: int, level: int) -> None:
        if self.is_ready(node):
            return
        self._kept.add(node)
        self._read[node] = max(self._read.get(node, 0), level)

    def _use(self, node: int) -> None:
        """Adds a node to its loop, and records the nodes that this loop uses."""
        graph = self.graph
        operation, arguments = graph.operations[node], graph.arguments[node]
        level, dims = self._at[node], graph.dims[node]
        if node in self.packing.sums:
            self._use_packed(node)
            return
        if node in self.fresh and operation not in STORED:
            self._kept.add(node)
        if operation == "view":
            # A view is read in the loops that use it; a single number is read once.
            if not dims:
                loop = self._loop(level, ())
                loop.nodes.append(node)
                self._keep(arguments[0], level)
            return
        if operation == "joined":
            self._kept.add(node)
            first = level
            for source, piece in self._pieces(node):
                at = self._piece_level(source, piece)
                loop = self._loop(at, piece.dims)
                loop.goals.append(Goal(source, Place(f"node {node}", 0), piece))
                self._take(source, loop)
                first = min(first, at)
            self._fill(node, first)
            return
        if operation == "scatter":
            rounds, mask = graph.extras[node][1], arguments[3:]
            loop = self._loop(level, (), f"scatter {arguments[1]} {rounds} {mask}")
            loop.scatters.append(node)
            self._read_as_stored(node)
            return
        if operation == "recurrence":
            self._loop(level, (), f"recurrence {node}").recurrence = node
            self._read_as_stored(node)
            return
        if operation == "nested":
            self._loop(level, (), f"nested {node}").nested = node
            for argument in arguments:
                self._keep(argument, level)
            return
        if operation == "result":
            self._kept.add(node)
            return
        if operation == "reduce":
            source = arguments[0]
            loop = self._loop(level, graph.dims[source])
            loop.reductions.append(node)
            self._take(source, loop)
            if dims or len(graph.dims[source]) > 1:
                self._kept.add(node)
            return
        loop = self._loop(level, dims, mask=self._masks.get(node))
        loop.nodes.append(node)
        if operation == "gather":
            self._keep(arguments[0], level)
            self._take(arguments[1], loop)
            return
        for argument in arguments:
            self._take(argument, loop)

    def _use_packed(self, node: int) -> None:
        """Adds a sum to its packed loop, and marks what that loop reads as stored."""
        one, level = self.packing.sums[node], self._at[node]
        dims = self.graph.dims[one.mask]
        loop = self._loop(level, dims, f"packed under {one.mask}")
        loop.mask = one.mask
        loop.packed.append(node)
        self._kept.add(node)
        for leaf in one.leaves:
            if self.graph.operations[leaf] == "view" and self.graph.dims[leaf]:
                (leaf,) = self.graph.arguments[leaf]
            if self.graph.dims[leaf]:
                self._keep(leaf, level)
            else:
                self._read[leaf] = max(self._read.get(leaf, 0), level)

    def _read_by_packed(self) -> None:
        """Records that packed loops read what other loops store anyway."""
        for node, one in self.packing.sums.items():
            level = self._at.get(node, 0)
            for inside in one.inside:
                if self.is_stored_before(inside, level):
                    self._keep(inside, level)

    def _read_as_stored(self, node: int) -> None:
        """Marks the input rows and the result of a scatter or recurrence as stored.

        Its loop reads and writes them in memory.
        """
        graph, level = self.graph, self._at[node]
        self._kept.add(node)
        for argument in graph.arguments[node]:
            if graph.operations[argument] == "view" and graph.dims[argument]:
                self._keep(graph.arguments[argument][0], level)
            elif graph.dims[argument]:
                self._keep(argument, level)

    def _fill(self, node: int, level: int) -> None:
        fills = fills_of(self.graph, node)
        if not fills:
            return
        fill = self.graph.arguments[node][-1]
        if self._lasting is not None and self.graph.value(fill) is not None:
            self.places[node] = self._lasting(node)
            return
        level = max(level, self._after(fill))
        self.fills.setdefault(level, []).extend(fills)
        self._loop(level, ())

    def _allocate(self) -> None:
        """Allocates memory for nodes that loops store.

        The memory of a node is used again for others after the last loop that reads it.
        """
        graph = self.graph
        begins: dict[int, list[int]] = {}
        first_write: dict[int, int] = {}
        for node in self._kept:
            if node in self.ready or node in self.places:
                continue
            first = self._at[node]
            if graph.operations[node] == "joined":
                first = min(
                    [self._piece_level(s, p) for s, p in self._pieces(node)] + [first]
                )
            first_write[node] = first
            begins.setdefault(first, []).append(node)
        free: dict[int, list[int]] = {}
        ends: dict[int, list[tuple[int, int]]] = {}
        for level in sorted(begins):
            for past in sorted(level_ for level_ in ends if level_ < level):
                for size, offset in ends.pop(past):
                    free.setdefault(size, []).append(offset)
            for node in sorted(begins[level]):
                more = 1 if graph.operations[node] == "scatter" else 0
                count = math.prod(graph.dims[node]) + more
                size = count * BYTES[graph.kinds[node]]
                size = -(-size // self.alignment) * self.alignment
                spare = free.get(size)
                if spare:
                    offset = spare.pop()
                else:
                    offset = self.size
                    self.size += size
                self.places[node] = Place("%scratch", offset)
                last = max(self._read.get(node, level), self._done[node])
                ends.setdefault(last, []).append((size, offset))

    def room(self, size: int) -> Place:
        """Allocates memory that only one loop uses, and returns its location.

        `size` is in bytes.
        """
        place = Place("%scratch", self.size)
        self.size += -(-size // self.alignment) * self.alignment
        return place

    def goal_place(self, goal: Goal) -> Place:
        """Returns the memory location of the array to which a goal is written."""
        word, _, number = goal.place.pointer.partition(" ")
        if word != "node":
            return goal.place
        place = self.place(int(number))
        assert place is not None
        return place

    def is_stored_before(self, node: int, level: int) -> bool:
        """Whether a node is in memory before the loops of a level begin."""
        if node in self.ready and node not in self.fresh:
            return True
        return node in self._kept and self._done[node] < level

    def is_kept(self, node: int) -> bool:
        """Whether the loop that computes a node also stores it."""
        return node in self._kept


def hoisted(
    graph: RowGraph, goals: Iterable[int], given: Iterable[int], *, packs: bool = False
) -> list[int]:
    """Returns the nodes to compute once before all steps, for use at every step.

    They do not vary between steps. Each is a goal, or is read by a node that varies.
    Large tables that packed loops alone read are not among them, but the rows are from
    which those loops compute a few of their entries.

    Args:
        graph: The graph of rows.
        goals: Nodes that are to be computed in a step.
        given: Nodes that are stored already.
        packs: Whether sums under a mask may be computed by packed loops.
    """
    known: set[int] = set(given)
    found: dict[int, None] = {}

    def keep(node: int) -> None:
        if graph.rates[node] >= VARYING or node in known:
            return
        operation = graph.operations[node]
        if operation in ("constant", "iota"):
            return
        if operation == "view" and graph.dims[node]:
            keep(graph.arguments[node][0])
            return
        found[node] = None

    goals = list(goals)
    order = graph.needed(goals)
    packing = Packing(graph, order if packs else (), known)
    packing.sums = {
        node: one
        for node, one in packing.sums.items()
        if math.prod(graph.dims[one.mask]) > MOST_STORED
    }
    computed = packing.computed(goals)
    for node in order:
        if node not in computed:
            continue
        if node in packing.sums:
            one = packing.sums[node]
            for leaf in one.leaves:
                keep(leaf)
            for inside in one.inside:
                if math.prod(graph.dims[inside]) <= MOST_STORED:
                    keep(inside)
        elif graph.rates[node] >= VARYING:
            for argument in graph.arguments[node]:
                keep(argument)
    for node in goals:
        keep(node)
    return list(found)


def operation_is_read(graph: RowGraph, node: int) -> bool:
    """Whether a node is a view, index or constant, which no loop has to compute."""
    return graph.operations[node] in ("view", "iota", "constant")


def fills_of(graph: RowGraph, node: int) -> list[Fill]:
    """Returns the gaps in a node that is assembled from pieces, grouped by length."""
    free = np.ones(math.prod(graph.dims[node]), bool)
    for piece in graph.extras[node]:
        free[piece.places()] = False
    edges = np.flatnonzero(np.diff(np.r_[False, free, False].astype(np.int8)))
    made: list[Fill] = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        count = last - first
        if made and made[-1].count == count:
            old = made[-1]
            stride = old.stride or first - old.first
            if first == old.first + old.runs * stride:
                made[-1] = Fill(node, old.first, count, old.runs + 1, stride)
                continue
        made.append(Fill(node, first, count))
    return made


def _key(key: tuple[int, Dims, str]) -> tuple[int, int, Dims, str]:
    level, dims, what = key
    return level, len(dims), dims, what
