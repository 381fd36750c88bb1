"""Where the numbers of a run are in a GPU's memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from jaxrod.lanes.cycle import Cycle, Plan
from jaxrod.lanes.cycle import Ends as CycleEnds
from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING
from jaxrod.lanes.kernel import Ends
from jaxrod.lanes.kernel_plan import Entries, Step
from jaxrod.lanes.pallas_code import type_in_memory
from jaxrod.lanes.unrolled import entries_of, unrolled_run, unrolled_step

MOST_OPERATIONS_ON_GPU = 12_000
"""Of a step and what comes before and after: Triton takes some ten seconds for 4 400 of
them, and a time that grows with their square. Never measured on a GPU."""

REGIONS = ("numbers", "derived", "own", "given", "made")
Place = tuple[str, str, int]
"""A region, a type in it, and which of its numbers."""


@dataclass
class Layout:
    """A run as a graph, and the places of its numbers.

    Regions are `numbers` and `derived`, which all rods share: what is given and what is
    worked out of it; `own`, `given` and `made`, of each rod: constants, what a run
    begins with, and results.
    """

    step: Step
    ends: Ends
    used: list[int]
    """All nodes that are needed."""
    sizes: dict[str, dict[str, int]]
    """Numbers in each region, by their type."""
    arrays: dict[int, Place]
    """Where arrays of inputs begin, those that are used."""
    derived: list[int]
    """Nodes that all rods share, worked out first and used later."""
    nodes: dict[int, Place]
    """Where these nodes are."""
    fixed: list[int]
    """Nodes that stay the same for each rod, worked out before the first step."""
    made: list[tuple[str, int]]
    """Where results begin, an array each: type and which number."""

    def where(self, node: int) -> Place:
        """The place of a node."""
        place = self.step.graph.places.get(node)
        if place is None:
            return self.nodes[node]
        region, dtype, first = self.arrays[place[0]]
        return region, dtype, first + place[1]

    def names(self, region: str) -> list[tuple[str, str]]:
        """Region and type of the arrays of a region."""
        return [(region, dtype) for dtype in self.sizes[region]]

    def place(self, region: str, kind: str, count: int = 1) -> Place:
        """Room for more numbers."""
        sizes, dtype = self.sizes[region], type_in_memory(kind).name
        first = sizes.get(dtype, 0)
        if count:
            sizes[dtype] = first + count
        return region, dtype, first


def layout_of_plan(plan: Plan) -> Layout:
    """The places of a run, or of a cycle's repetition; read once for each.

    Args:
        plan: Its structure.

    Raises:
        NotUnrolled: If it cannot be read.
    """
    n = plan.cycle.n_constants
    shared = (True,) * n
    if plan.batch is not None:
        shared = tuple(not row for row in plan.batch.rows[:n])
    return _layout(plan.cycle, plan.ends, shared)


@lru_cache(maxsize=64)
def _layout(cycle: Cycle, ends: CycleEnds | None, shared: tuple[bool, ...]) -> Layout:
    if ends is not None:
        step, around = unrolled_run(cycle, ends, shared, MOST_OPERATIONS_ON_GPU)
    else:
        step, around = _bare(cycle, shared)
    graph = step.graph
    outputs = [
        node
        for arrays in (around.begun, step.outputs, around.ended)
        for nodes in arrays
        for node in nodes
    ]
    used = graph.needed(outputs)
    sizes: dict[str, dict[str, int]] = {region: {} for region in REGIONS}
    layout = Layout(step, around, used, sizes, {}, [], {}, [], [])
    _place_inputs(layout)
    for node in _kept(layout, outputs):
        if graph.rates[node] == UNIFORM:
            layout.derived.append(node)
            layout.nodes[node] = layout.place("derived", graph.kinds[node])
        else:
            layout.fixed.append(node)
    for entries in around.made:
        layout.made.append(layout.place("made", entries.kind, entries.size)[1:])
    return layout


def _bare(cycle: Cycle, shared: tuple[bool, ...]) -> tuple[Step, Ends]:
    step, _, inputs = unrolled_step(cycle, shared, MOST_OPERATIONS_ON_GPU)
    graph, first = step.graph, len(inputs)
    carry = [entries_of(aval) for aval in cycle.avals]
    begun = [
        graph.inputs(first + i, (e.size,), e.kind, VARYING).tolist()
        for i, e in enumerate(carry)
    ]
    ended = [nodes.reshape(-1).tolist() for nodes in inputs[cycle.n_constants :]]
    return step, Ends(carry, begun, carry, ended)


def _place_inputs(layout: Layout) -> None:
    """Constants and what is given, where they are used."""
    step, graph = layout.step, layout.step.graph
    used = {graph.places[n][0] for n in layout.used if n in graph.places}
    n, m = len(step.constants), len(step.carry)
    arrays: Sequence[Entries] = [*step.constants, *step.carry, *layout.ends.given]
    for which, entries in enumerate(arrays):
        if which not in used or n <= which < n + m:
            continue
        region = "own" if entries.rate == FIXED else "given"
        if entries.rate == UNIFORM:
            region = "numbers"
        layout.arrays[which] = layout.place(region, entries.kind, entries.size)


def _kept(layout: Layout, outputs: Sequence[int]) -> list[int]:
    """What is worked out less often than it is used, in the order of its use."""
    graph = layout.step.graph
    kept: dict[int, None] = {}

    def keep(node: int) -> None:
        if graph.operations[node] not in ("constant", "input"):
            kept[node] = None

    for node in layout.used:
        for source in graph.arguments[node]:
            if graph.rates[source] < graph.rates[node]:
                keep(source)
    for node in outputs:
        if graph.rates[node] in (UNIFORM, FIXED):
            keep(node)
    return list(kept)
