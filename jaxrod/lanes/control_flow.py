"""Rules of unrolling for calls, loops and branches."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from jaxrod.lanes.unroll import NotUnrolled, Unroller, kind_of, rule

_CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
    "remat": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr",
}
MOST_ROUNDS = 10_000
"""Of a loop whose end is known only once it is reached."""


@rule(*_CALLS)
def called(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """A nested call is entered."""
    inner = equation.params[_CALLS[equation.primitive.name]]
    return unroller.run(_closed(inner), arrays)


@rule("scan")
def scanned(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """A loop of known length."""
    n_consts, n_carry = equation.params["num_consts"], equation.params["num_carry"]
    length = equation.params["length"]
    consts, carry = arrays[:n_consts], list(arrays[n_consts : n_consts + n_carry])
    along = arrays[n_consts + n_carry :]
    body = _closed(equation.params["jaxpr"])
    rows: list[Any] = [None] * length
    order = range(length)
    for i in reversed(order) if equation.params["reverse"] else order:
        made = unroller.run(body, [*consts, *carry, *[array[i] for array in along]])
        carry, rows[i] = made[:n_carry], made[n_carry:]
    avals = [v.aval for v in equation.outvars[n_carry:]]
    stacked = [
        np.stack([row[k] for row in rows]) if length else np.zeros(aval.shape, np.int64)
        for k, aval in enumerate(avals)
    ]
    return [*carry, *stacked]


@rule("while")
def looped(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """A loop whose end can be told while it is gone through."""
    n_test, n_body = equation.params["cond_nconsts"], equation.params["body_nconsts"]
    for_test, for_body = arrays[:n_test], arrays[n_test : n_test + n_body]
    carry = list(arrays[n_test + n_body :])
    test = _closed(equation.params["cond_jaxpr"])
    body = _closed(equation.params["body_jaxpr"])
    for _ in range(MOST_ROUNDS):
        (answer,) = unroller.run(test, [*for_test, *carry])
        known = unroller.graph.value(int(answer))
        if known is None:
            raise NotUnrolled("lanes have no loop whose length depends on numbers")
        if not known:
            return carry
        carry = unroller.run(body, [*for_body, *carry])
    raise NotUnrolled(f"a loop goes on for more than {MOST_ROUNDS} rounds")


@rule("cond")
def branched(unroller: Unroller, equation: Any, index: Any, *arrays: Any) -> Any:
    """All branches are gone through, as under `vmap`, and one is chosen."""
    graph = unroller.graph
    branches = [_closed(branch) for branch in equation.params["branches"]]
    known = graph.value(int(index))
    if known is not None:
        which = min(max(int(known), 0), len(branches) - 1)
        return unroller.run(branches[which], arrays)
    kind = kind_of(equation.invars[0].aval)
    results = unroller.run(branches[0], arrays)
    for i, branch in enumerate(branches[1:], 1):
        if kind == "b1":
            chosen = index
        else:
            chosen = graph.each("ge", "b1", index, np.int64(graph.constant(i, kind)))
        others = unroller.run(branch, arrays)
        results = [
            graph.each("select", kind_of(v.aval), chosen, new, old)
            for v, new, old in zip(equation.outvars, others, results, strict=True)
        ]
    return results


@rule("platform_index")
def by_platform(unroller: Unroller, equation: Any) -> Any:
    """Which of the variants of a program is meant, where that is clear without asking.

    Kernels are for CPUs and GPUs: variants for those are told apart by XLA alone.
    """
    rest = None
    for i, names in enumerate(equation.params["platforms"]):
        if names is None:
            rest = i
        elif {"cpu", "cuda", "rocm"} & set(names):
            raise NotUnrolled("lanes have no program that differs by platform")
    if rest is None:
        raise NotUnrolled("the program is for other platforms")
    kind = kind_of(equation.outvars[0].aval)
    return np.full((), unroller.graph.constant(rest, kind), np.int64)


@rule("custom_linear_solve")
def solved(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """The solution of linear equations, by the solver that comes with them."""
    lengths = equation.params["const_lengths"]
    begin = lengths.matvec + lengths.vecmat
    consts = arrays[begin : begin + lengths.solve]
    right = arrays[sum(lengths) :]
    solver = _closed(equation.params["jaxprs"].solve)
    return unroller.run(solver, [*consts, *right])


def _closed(jaxpr: Any) -> Any:
    return jaxpr if hasattr(jaxpr, "consts") else ClosedJaxpr(jaxpr, ())
