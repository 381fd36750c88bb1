"""Loops that apply a function many times, with a traced count or in reverse mode.

On CPUs, batches of some systems run one system after another. Contact with neighbour
lists skips empty lists by branches. Under `jax.vmap`, a branch whose condition differs
between systems becomes a selection: both sides are computed for all systems. A single
system of this kind already fills a core and its cache, so a batch takes longer together
than one by one, and much longer to compile.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxrod.jax_internals.equations import program_of, result_types
from jaxrod.jax_internals.primitives import (
    define,
    evaluate,
    filled_in,
    new_primitive,
    unknown_rules,
)
from jaxrod.jax_internals.scans import scan
from jaxrod.lanes.steps import by_kernel, try_cycles, try_lanes


@dataclass(frozen=True, eq=False)
class _Body:
    """Program of a function for one system, as a closed jaxpr."""

    closed: Any


def one_by_one(function: Callable[..., Any], *arguments: Any) -> Any:
    """Result of a function; under `jax.vmap` it is called for one entry after another.

    On devices other than CPUs a batch stays together. If the function is differentiated
    before it is batched, it is treated like any other function.

    Args:
        function: A function of pytrees of arrays that returns a pytree of arrays.
            Arrays in its closure are batched and differentiated as well.
        *arguments: Arguments of the function.
    """
    if unknown_rules() is not None:
        return function(*arguments)
    leaves, structure = jax.tree.flatten(arguments)
    results: list[Any] = []

    def flat(*arrays: Any) -> list[Any]:
        made = function(*jax.tree.unflatten(structure, arrays))
        made_leaves, made_structure = jax.tree.flatten(made)
        results.append(made_structure)
        return made_leaves

    traced = jax.make_jaxpr(flat)(*leaves)
    # Arrays in the function's closure may belong to another transformation: they become
    # operands, too.
    jaxpr, held = program_of(traced)
    given = [*held, *(jnp.asarray(leaf) for leaf in leaves)]

    def complete(*arrays: Any) -> Any:
        return jax.core.eval_jaxpr(jaxpr, arrays[: len(held)], *arrays[len(held) :])

    closed = jax.make_jaxpr(complete)(*given) if held else traced
    made = _apart().bind(*given, body=_Body(closed))
    return jax.tree.unflatten(results[0], made)


@cache
def _apart() -> Any:
    """JAX primitive of `one_by_one`, defined at the first call."""
    apart = new_primitive("jaxrod_one_by_one")
    define(
        apart,
        _meaning,
        static="body",
        shapes=lambda *avals, body: result_types(body.closed),
        batched=_batched,
        jvp=_jvp,
    )
    return apart


def _meaning(*arrays: Any, body: _Body) -> list[Any]:
    return evaluate(body.closed, *arrays)


def _batched(arrays: Sequence[Any], axes: Sequence[Any], *, body: _Body) -> Any:
    if jax.default_backend() != "cpu":
        whole = jax.vmap(lambda *each: _meaning(*each, body=body), in_axes=axes)
        made = whole(*arrays)
        return made, [0] * len(made)
    rows = [
        None if axis is None else jnp.moveaxis(array, axis, 0)
        for array, axis in zip(arrays, axes, strict=True)
    ]

    def one(own: list[Any]) -> list[Any]:
        given = [
            array if row is None else row
            for array, row in zip(arrays, own, strict=True)
        ]
        return _apart().bind(*given, body=body)

    made = lax.map(one, rows)
    return made, [0] * len(made)


def _jvp(primals: Any, tangents: Any, *, body: _Body) -> Any:
    rates = tuple(filled_in(tangent) for tangent in tangents)
    return jax.jvp(lambda *given: _meaning(*given, body=body), tuple(primals), rates)


Carry = TypeVar("Carry")


def integrated(stepper: Any, state: Any, n_steps: int | Array) -> Any:
    """Final state of a run of a stepper, see `jaxrod.model.Stepper`.

    Args:
        stepper: A stepper. If its attribute `one_by_one` is true, batches on a CPU run
            one by one. It then also has a method `searched`, which returns a stepper
            for the next `every` steps.
        state: Initial state.
        n_steps: Number of steps, at least 1; an `int` for reverse-mode differentiation.
    """
    count = getattr(stepper, "counted", None)
    if count is None:
        return _run(stepper, state, n_steps - stepper.steps_of_end)
    counted = count(n_steps)
    if not getattr(stepper, "one_by_one", False):
        return _run(counted, state, n_steps)
    if isinstance(n_steps, int):
        whole = lambda own, state: _in_blocks(own, state, n_steps)
        return one_by_one(whole, counted, state)
    return one_by_one(_in_blocks, counted, state, n_steps)


def _run(stepper: Any, state: Any, n_cycles: int | Array) -> Any:
    """Final state of a run: `begin`, then `n_cycles` times `cycle`, then `end`."""
    by_lanes = try_lanes(stepper, state, n_cycles)
    if by_lanes is not None:
        return by_lanes
    return stepper.end(_looped(stepper, stepper.begin(state), n_cycles))


def _in_blocks(counted: Any, state: Any, n_steps: int | Array) -> Any:
    """Final state of a run in blocks of steps, each after a search.

    What the search found does not change in a block, so it is no part of the carry.
    """
    every = counted.stepper.every

    def block(carry: Any, length: int | Array) -> Any:
        steps = counted.searched(carry)
        made = try_cycles(steps, carry, length)
        return _looped(steps, carry, length) if made is None else made

    carry = counted.begin(state)
    # The last block may be shorter than the others, and has at least one step.
    if isinstance(n_steps, int):
        blocks, rest = divmod(n_steps - 1, every)
        carry = repeat(lambda carry: block(carry, every), carry, blocks)
    else:
        blocks, rest = jnp.divmod(jnp.maximum(n_steps - 1, 0), every)
        carry = repeat_traced(lambda carry: block(carry, every), carry, blocks)
    return by_kernel(counted, "end", block(carry, rest + 1))


def _looped(integrator: Any, carry: Any, n_cycles: int | Array) -> Any:
    if isinstance(n_cycles, int):
        return repeat(integrator.cycle, carry, n_cycles)
    return repeat_traced(integrator.cycle, carry, n_cycles)


def repeat_traced(
    function: Callable[[Carry], Carry], carry: Carry, n_times: Array
) -> Carry:
    """Applies a function a traced number of times; a negative number counts as 0."""
    return lax.fori_loop(0, n_times, lambda _, c: function(c), carry)


def repeat(function: Callable[[Carry], Carry], carry: Carry, n_times: int) -> Carry:
    """Applies a function a static number of times, cheap to differentiate.

    Every application is checkpointed: reverse mode keeps only the carries. That
    compiles and runs several times faster than storing the intermediate results of a
    step. Many applications run in two nested loops. These keep about `2 sqrt(n_times)`
    carries instead of `n_times`, at the price of one more forward pass.
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
