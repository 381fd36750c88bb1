"""Batches that run one system after the other, on CPUs.

Under `jax.vmap` a branch on a number of each system is no longer a branch: both sides
are computed for all. Contact with neighbour lists skips empty lists by branches, and
one such system fills a core and its cache. So a batch of them takes longer together
than one by one, and much longer to compile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.jax_internals.equations import program_of, result_types
from jaxrod.jax_internals.primitives import (
    define,
    evaluate,
    filled_in,
    new_primitive,
    unknown_rules,
)


@dataclass(frozen=True, eq=False)
class _Body:
    """Program of one system."""

    closed: Any


def one_by_one(function: Callable[..., Any], *arguments: Any) -> Any:
    """Result of a function; under `jax.vmap` it is called for one entry at a time.

    On devices other than CPUs a batch stays together. If the function is differentiated
    before it is batched, it is treated like any other function.

    Args:
        function: A function of pytrees of arrays whose result is such a pytree. Arrays
            in its closure are batched and differentiated as well.
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
    """The primitive, made when it is first needed."""
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
