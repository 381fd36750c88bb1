"""Largest length of a program that lanes take.

LLVM compiles single operations, XLA compiles equations of whole arrays. A long rod has
many operations in few equations, which XLA compiles in seconds. A system of many
members has many equations too, and XLA takes about as long for it as LLVM
(docs/performance.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from jaxrod.jax_internals.equations import program_of, programs_within
from jaxrod.lanes.cycle import Cycle

MOST_OPERATIONS = 120_000
"""Length up to which programs are always taken: longer ones do not fit the processor's
instruction cache, and take long to compile."""
OPERATIONS_PER_EQUATION = 100
"""Operations per equation up to which longer programs are taken too."""
MOST_OF_ALL = 400_000
"""Length beyond which no program is taken."""


def most_operations(cycle: Cycle) -> int:
    """Largest number of operations in a step that lanes take."""
    equations = sum(1 for _ in _equations(program_of(cycle.closed).jaxpr))
    return max(MOST_OPERATIONS, min(OPERATIONS_PER_EQUATION * equations, MOST_OF_ALL))


def _equations(jaxpr: Any) -> Iterator[Any]:
    """Yields the equations of a program and of the programs within it."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in programs_within(equation):
            yield from _equations(inner)
