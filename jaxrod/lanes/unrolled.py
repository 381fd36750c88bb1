"""Runs as graphs: the step, and the beginning and end of a run."""

from __future__ import annotations

import math
from typing import Any

from jaxrod.jax_internals.equations import operand_types
from jaxrod.lanes.cycle import Cycle
from jaxrod.lanes.cycle import Ends as CycleEnds
from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING, Graph
from jaxrod.lanes.kernel import Ends
from jaxrod.lanes.kernel_plan import Entries, Step
from jaxrod.lanes.rules import Unroller
from jaxrod.lanes.unroll import NotUnrolled, kind_of


def unrolled_step(
    cycle: Cycle, shared: tuple[bool, ...], most: int
) -> tuple[Step, Unroller, list[Any]]:
    """Unrolls a step; returns it with its unroller and the nodes of its inputs.

    Args:
        cycle: The step.
        shared: Whether each constant is the same for all rods.
        most: Largest number of operations in a step.

    Raises:
        NotUnrolled: The step cannot be unrolled, or has more operations.
    """
    graph = Graph()
    unroller = Unroller(graph)
    inputs, entries = [], []
    for i, aval in enumerate(operand_types(cycle.closed)):
        rate = VARYING
        if i < cycle.n_constants:
            rate = UNIFORM if shared[i] else FIXED
        kind = kind_of(aval)
        inputs.append(graph.inputs(i, aval.shape, kind, rate))
        entries.append(Entries(kind, inputs[-1].size, rate))
    made = unroller.run(cycle.closed, inputs)
    check_length(len(graph), most)
    outputs = [array.reshape(-1).tolist() for array in made]
    constants, carry = entries[: cycle.n_constants], entries[cycle.n_constants :]
    return Step(graph, constants, carry, outputs), unroller, inputs


def unrolled_run(
    cycle: Cycle, ends: CycleEnds, shared: tuple[bool, ...], most: int
) -> tuple[Step, Ends]:
    """Unrolls a step, and the beginning and the end of a run of it, into one graph.

    Args:
        cycle: The step.
        ends: Beginning and end of the run.
        shared: Whether each constant is the same for all rods.
        most: Largest number of operations of all together.

    Raises:
        NotUnrolled: The run cannot be unrolled, or has more operations.
    """
    step, unroller, inputs = unrolled_step(cycle, shared, most)
    graph, n = step.graph, cycle.n_constants
    avals = ends.given[n:]
    first = len(inputs)
    given = [
        graph.inputs(first + i, aval.shape, kind_of(aval), VARYING)
        for i, aval in enumerate(avals)
    ]
    begun = unroller.run(ends.begin, [*inputs[:n], *given])
    ended = unroller.run(ends.end, inputs)
    check_length(len(graph), most)
    return step, Ends(
        [entries_of(aval) for aval in avals],
        [array.reshape(-1).tolist() for array in begun],
        [entries_of(aval) for aval in ends.made],
        [array.reshape(-1).tolist() for array in ended],
    )


def entries_of(aval: Any) -> Entries:
    """Returns the entries of an array that changes in every step."""
    return Entries(kind_of(aval), math.prod(aval.shape), VARYING)


def check_length(operations: int, most: int) -> None:
    """Refuses a program that is too long.

    Raises:
        NotUnrolled: It has more than `most` operations.
    """
    if operations > most:
        raise NotUnrolled(f"a program of {operations} operations is longer than {most}")
