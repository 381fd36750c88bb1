"""Functions that a batch goes through one system after the other, on CPUs.

Under `jax.vmap` a branch by a number of each system is no branch any more: both sides
are worked out for all. Contact with lists of neighbours leaves out by branches what
holds nothing, and one such system fills a core and its cache. So a batch of them takes
longer together than apart, and much longer to compile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

_apart = Primitive("jaxrod_one_by_one")
_apart.multiple_results = True


def one_by_one(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function makes of its arguments; under `jax.vmap`, one after the other.

    On other devices than CPUs a batch stays one. Where the function is differentiated
    before it is batched, it is a function like any other.

    Args:
        function: Of pytrees of arrays, to such a pytree. Arrays that it holds without
            being given them are batched and differentiated as well.
        *arguments: What it is given.
    """
    leaves, structure = jax.tree.flatten(arguments)
    results: list[Any] = []

    def flat(*arrays: Any) -> list[Any]:
        made = function(*jax.tree.unflatten(structure, arrays))
        made_leaves, made_structure = jax.tree.flatten(made)
        results.append(made_structure)
        return made_leaves

    traced = jax.make_jaxpr(flat)(*leaves)
    # What the function holds may be of another transformation: it is given, too.
    held = traced.consts
    given = [*held, *(jnp.asarray(leaf) for leaf in leaves)]

    def complete(*arrays: Any) -> list[Any]:
        own = ClosedJaxpr(traced.jaxpr, arrays[: len(held)])
        return list(jaxpr_as_fun(own)(*arrays[len(held) :]))

    closed = jax.make_jaxpr(complete)(*given) if held else traced
    made = _apart.bind(*given, closed=closed)
    return jax.tree.unflatten(results[0], made)


def _meaning(*arrays: Any, closed: Any) -> list[Any]:
    return list(jaxpr_as_fun(closed)(*arrays))


def _batched(arrays: Sequence[Any], axes: Sequence[Any], *, closed: Any) -> Any:
    if jax.default_backend() != "cpu":
        whole = jax.vmap(lambda *each: _meaning(*each, closed=closed), in_axes=axes)
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
        return _apart.bind(*given, closed=closed)

    made = lax.map(one, rows)
    return made, [0] * len(made)


def _jvp(primals: Any, tangents: Any, *, closed: Any) -> Any:
    rates = tuple(ad.instantiate_zeros(tangent) for tangent in tangents)
    return jax.jvp(jaxpr_as_fun(closed), tuple(primals), rates)


_apart.def_impl(jax.jit(_meaning, static_argnames="closed"))
_apart.def_abstract_eval(lambda *avals, closed: closed.out_avals)
batching.primitive_batchers[_apart] = _batched
ad.primitive_jvps[_apart] = _jvp
mlir.register_lowering(_apart, mlir.lower_fun(_meaning, multiple_results=True))
