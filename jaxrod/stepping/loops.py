"""Loops that apply a function many times: a traced number, or differentiable."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax import lax
from jaxtyping import Array

from jaxrod.jax_internals.scans import scan
from jaxrod.lanes.steps import try_lanes
from jaxrod.stepping.one_by_one import one_by_one

Carry = TypeVar("Carry")


def integrated(integrator: Any, state: Any, n_cycles: int | Array) -> Any:
    """State after the integrator's beginning, its cycles and its end.

    Args:
        integrator: A pytree with methods `begin`, `cycle` and `end`. One with
            `one_by_one` does not use lanes, and is not batched with others on a CPU.
        state: Initial state.
        n_cycles: Number of cycles; an `int` if it is to be differentiated in reverse.
    """
    if getattr(integrator, "one_by_one", False):
        if isinstance(n_cycles, int):
            whole = lambda own, state: _looped(own, state, n_cycles)
            return one_by_one(whole, integrator, state)
        return one_by_one(_looped, integrator, state, n_cycles)
    by_lanes = try_lanes(integrator, state, n_cycles)
    if by_lanes is not None:
        return by_lanes
    return _looped(integrator, state, n_cycles)


def _looped(integrator: Any, state: Any, n_cycles: int | Array) -> Any:
    begun = integrator.begin(state)
    if isinstance(n_cycles, int):
        return integrator.end(repeat(integrator.cycle, begun, n_cycles))
    return integrator.end(repeat_traced(integrator.cycle, begun, n_cycles))


def repeat_traced(
    function: Callable[[Carry], Carry], carry: Carry, n_times: Array
) -> Carry:
    """Applies a function a traced number of times; a negative number counts as 0."""
    return lax.fori_loop(0, n_times, lambda _, c: function(c), carry)


def repeat(function: Callable[[Carry], Carry], carry: Carry, n_times: int) -> Carry:
    """Applies a function a static number of times, cheap to differentiate.

    Every application is checkpointed: reverse mode starts from the carries alone. That
    compiles and runs several times faster than storing the intermediate results of a
    step. Many applications go in two nested loops, so that about `2 sqrt(n_times)`
    carries are kept instead of `n_times`, for one more forward pass.
    """
    remembered = jax.checkpoint(function)

    def inner(carry: Carry, length: int) -> Carry:
        return scan(lambda c, _: (remembered(c), None), carry, length=length)[0]

    if n_times < 64:
        return inner(carry, n_times)
    block = math.isqrt(n_times)
    blocks, rest = divmod(n_times, block)
    checkpointed = jax.checkpoint(lambda c: inner(c, block), prevent_cse=False)
    carry = scan(lambda c, _: (checkpointed(c), None), carry, length=blocks)[0]
    return inner(carry, rest) if rest else carry
