"""The layout of a run's numbers in a GPU's memory."""

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
"""Largest number of operations in a step with the beginning and the end of a run.
Triton takes some ten seconds for 4 400, and its time grows with their square. Never
measured on a GPU."""

REGIONS = ("numbers", "derived", "own", "given", "made")
Place = tuple[str, str, int]
"""Place of a number: the region, the dtype in it, and the index in that array."""


@dataclass
class Layout:
    """A run as a graph, and the places of its numbers.

    All rods share the regions `numbers` (given constants) and `derived` (values
    computed from them). Each rod has rows in `own` (its constants), `given` (arguments
    of the run) and `made` (results).
    """

    step: Step
    ends: Ends
    used: list[int]
    """All nodes that are needed."""
    sizes: dict[str, dict[str, int]]
    """Number of entries in each region, by dtype."""
    arrays: dict[int, Place]
    """Places where the used arrays of inputs begin."""
    derived: list[int]
    """Nodes that all rods share, computed first and used later."""
    nodes: dict[int, Place]
    """Places of the `derived` nodes."""
    fixed: list[int]
    """Nodes that are the same in all steps of a rod, computed before the first step."""
    made: list[tuple[str, int]]
    """Places where the arrays of results begin: dtype and index."""

    def where(self, node: int) -> Place:
        """Returns the place of a node."""
        place = self.step.graph.places.get(node)
        if place is None:
            return self.nodes[node]
        region, dtype, first = self.arrays[place[0]]
        return region, dtype, first + place[1]

    def names(self, region: str) -> list[tuple[str, str]]:
        """Lists the region and dtype of each array of a region."""
        return [(region, dtype) for dtype in self.sizes[region]]

    def place(self, region: str, kind: str, count: int = 1) -> Place:
        """Allocates numbers in a region, and returns where they begin."""
        sizes, dtype = self.sizes[region], type_in_memory(kind).name
        first = sizes.get(dtype, 0)
        if count:
            sizes[dtype] = first + count
        return region, dtype, first


def layout_of_plan(plan: Plan) -> Layout:
    """Returns the layout of a run, or of repeated cycles; layouts are cached.

    Args:
        plan: Structure of the operation.

    Raises:
        NotUnrolled: The program cannot be unrolled, or is too long.
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
    """Allocates the constants and arguments that are used."""
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
    """Lists loop-invariant nodes that are outputs or used by nodes of a higher rate.

    They are in the order of their first use, followed by outputs.
    """
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
