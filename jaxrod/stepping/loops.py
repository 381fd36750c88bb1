"""Loops that apply a function many times: of a traced count, or differentiable."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import jax
from jax import lax
from jaxtyping import Array

Carry = TypeVar("Carry")


def repeat_traced(
    function: Callable[[Carry], Carry], carry: Carry, n_times: Array
) -> Carry:
    """Applies a function a traced number of times; a negative one counts as 0."""
    return lax.fori_loop(0, n_times, lambda _, c: function(c), carry)


def repeat(function: Callable[[Carry], Carry], carry: Carry, n_times: int) -> Carry:
    """Applies a function a static number of times, cheap to differentiate.

    Every application is checkpointed: reverse mode works from the carries alone,
    which compiles and runs several times faster than storing what happens in a step.
    Many applications go in two nested loops, so that about `2 sqrt(n_times)` carries
    are kept instead of `n_times`, for one more forward pass.
    """
    remembered = jax.checkpoint(function)

    def inner(carry: Carry, length: int) -> Carry:
        return lax.scan(lambda c, _: (remembered(c), None), carry, length=length)[0]

    if n_times < 64:
        return inner(carry, n_times)
    block = math.isqrt(n_times)
    blocks, rest = divmod(n_times, block)
    checkpointed = jax.checkpoint(lambda c: inner(c, block), prevent_cse=False)
    carry = lax.scan(lambda c, _: (checkpointed(c), None), carry, length=blocks)[0]
    return inner(carry, rest) if rest else carry
