"""How long a program may be for lanes to take it.

LLVM compiles operations one by one, XLA equations of whole arrays. A long rod is many
operations of few equations, which XLA compiles in seconds; a system of many members is
many equations too, and XLA takes about as long for it as LLVM (docs/performance.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from jaxrod.jax_internals.equations import program_of, programs_within
from jaxrod.lanes.cycle import Cycle

MOST_OPERATIONS = 120_000
"""That are always taken: longer ones do not fit the processor's memory for
instructions, and take long to compile."""
OPERATIONS_PER_EQUATION = 100
"""Up to so many for each equation are taken too."""
MOST_OF_ALL = 400_000
"""But no more than these."""


def most_operations(cycle: Cycle) -> int:
    """Operations that lanes take of a step."""
    equations = sum(1 for _ in _equations(program_of(cycle.closed).jaxpr))
    return max(MOST_OPERATIONS, min(OPERATIONS_PER_EQUATION * equations, MOST_OF_ALL))


def _equations(jaxpr: Any) -> Iterator[Any]:
    """Equations of a program and of those within it."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in programs_within(equation):
            yield from _equations(inner)
