"""Rules by which calls, loops and branches become operations on single numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxrod.jax_internals.equations import CALLS, called_program, scan_of, while_of
from jaxrod.lanes.jaxpr.unroll import NotUnrolled, Unroller, kind_of, rule

MOST_ROUNDS = 10_000
"""Largest number of rounds for which a `while` loop is unrolled."""


@rule(*CALLS)
def called(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates a nested call: the operations of its program are inlined."""
    return unroller.run(called_program(equation), arrays)


@rule("scan")
def scanned(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Unrolls `lax.scan`: the operations of its body are repeated for each row."""
    scan = scan_of(equation)
    n_carry, length = scan.n_carry, scan.length
    first_row = scan.n_constants + n_carry
    consts = arrays[: scan.n_constants]
    carry = list(arrays[scan.n_constants : first_row])
    along = arrays[first_row:]
    rows: list[Any] = [None] * length
    order = range(length)
    for i in reversed(order) if scan.backwards else order:
        given = [*consts, *carry, *[array[i] for array in along]]
        made = unroller.run(scan.body, given)
        carry, rows[i] = made[:n_carry], made[n_carry:]
    avals = [v.aval for v in equation.outvars[n_carry:]]
    stacked = [
        np.stack([row[k] for row in rows]) if length else np.zeros(aval.shape, np.int64)
        for k, aval in enumerate(avals)
    ]
    return [*carry, *stacked]


@rule("while")
def looped(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Unrolls a `while` loop whose condition is a known number in every round.

    Raises:
        NotUnrolled: The condition depends on inputs, or there are too many rounds.
    """
    loop = while_of(equation)
    first_carry = loop.n_condition + loop.n_body
    for_test, for_body = (
        arrays[: loop.n_condition],
        arrays[loop.n_condition : first_carry],
    )
    carry = list(arrays[first_carry:])
    for _ in range(MOST_ROUNDS):
        (answer,) = unroller.run(loop.condition, [*for_test, *carry])
        known = unroller.graph.value(unroller.number(answer))
        if known is None:
            raise NotUnrolled("lanes have no loop whose length depends on numbers")
        if not known:
            return carry
        carry = unroller.run(loop.body, [*for_body, *carry])
    raise NotUnrolled(f"a loop runs for more than {MOST_ROUNDS} rounds")


@rule("cond")
def branched(unroller: Unroller, equation: Any, index: Any, *arrays: Any) -> Any:
    """Unrolls all branches of `cond`, as under `vmap`, and selects one result.

    If the index is a known number, only that branch is unrolled.
    """
    graph = unroller.graph
    branches = equation.params["branches"]
    known = graph.value(unroller.number(index))
    if known is not None:
        which = min(max(int(known), 0), len(branches) - 1)
        return unroller.run(branches[which], arrays)
    kind = kind_of(equation.invars[0].aval)
    results = unroller.run(branches[0], arrays)
    for i, branch in enumerate(branches[1:], 1):
        if kind == "b1":
            chosen = index
        else:
            chosen = unroller.each("ge", "b1", index, unroller.full(i, (), kind))
        others = unroller.run(branch, arrays)
        results = [
            unroller.each("select", kind_of(v.aval), chosen, new, old)
            for v, new, old in zip(equation.outvars, others, results, strict=True)
        ]
    return results


@rule("platform_index")
def by_platform(unroller: Unroller, equation: Any) -> Any:
    """Returns the index of the default variant of a program with variants by platform.

    A program with a separate variant for CPUs is refused, because only XLA selects
    variants.

    Raises:
        NotUnrolled: There is a variant for CPUs, or no default variant.
    """
    rest = None
    for i, names in enumerate(equation.params["platforms"]):
        if names is None:
            rest = i
        elif "cpu" in names:
            raise NotUnrolled("lanes have no program that differs by platform")
    if rest is None:
        raise NotUnrolled("the program is for other platforms")
    kind = kind_of(equation.outvars[0].aval)
    return unroller.full(rest, (), kind)


@rule("custom_linear_solve")
def solved(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates `custom_linear_solve`: the operations of its solver are inlined."""
    lengths = equation.params["const_lengths"]
    begin = lengths.matvec + lengths.vecmat
    consts = arrays[begin : begin + lengths.solve]
    right = arrays[sum(lengths) :]
    return unroller.run(equation.params["jaxprs"].solve, [*consts, *right])
