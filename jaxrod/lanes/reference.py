"""Repeated steps as JAX primitives, and their reference in JAX's own loops.

A step takes constants and a carry to the next carry. The first operands of each
primitive are the number of steps and the constants.

- `jaxrod_run`: a whole run, from its arguments to its results: beginning, steps, end.
- `jaxrod_cycles`: the carry after all steps; on request the checkpoints too.
- `jaxrod_cycles_tangent`: the tangent of that carry; linear in the given tangents.
- `jaxrod_cycles_adjoint`: the transpose of the tangent, computed back from checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.jax_internals.primitives import new_primitive
from jaxrod.jax_internals.scans import scan
from jaxrod.lanes.run_spec import (
    LoopBody,
    RunSpec,
    chosen,
    filled,
    parted,
    tangent_body,
)

run_p = new_primitive("jaxrod_run")
cycles_p = new_primitive("jaxrod_cycles")
tangent_p = new_primitive("jaxrod_cycles_tangent")
adjoint_p = new_primitive("jaxrod_cycles_adjoint")


def _run(spec: RunSpec, steps: Any, *arrays: Any) -> list[Any]:
    ends, body = spec.ends, spec.body
    assert ends is not None
    constants, given = parted(arrays, body.n_constants)
    carry = run_once(ends.first, constants, given)
    inner = RunSpec(body, spec.length)
    after = cycles_p.bind(steps, *constants, *carry, spec=inner)
    return run_once(ends.last, constants, after)


def run_once(step: LoopBody, constants: Sequence[Any], given: Sequence[Any]) -> Any:
    """Returns the results of one evaluation of a program, by a kernel if possible.

    The program is a step from `as_step`; `given` are its operands after the constants.
    """
    n = len(given)
    results = [jnp.zeros(aval.shape, aval.dtype) for aval in step.avals[n:]]
    spec = RunSpec(step, 1)
    made = cycles_p.bind(jnp.int32(1), *constants, *given, *results, spec=spec)
    return made[n:]


def _cycles(spec: RunSpec, steps: Any, *arrays: Any) -> list[Any]:
    body = spec.body
    constants, carry = parted(arrays, body.n_constants)

    def once(carry: list[Any]) -> list[Any]:
        return body(constants, carry)

    if not spec.keeps:
        if spec.length is None:
            return lax.fori_loop(0, steps, lambda _, c: once(c), list(carry))
        return _scanned(once, list(carry), spec.length)
    every = spec.every
    whole, rest = divmod(spec.length or 0, every)

    def segment(carry: list[Any], _: None) -> tuple[list[Any], list[Any]]:
        return _scanned(once, carry, every), carry

    after, kept = scan(segment, list(carry), None, length=whole)
    if rest:
        kept = [
            jnp.concatenate([rows, last[None]])
            for rows, last in zip(kept, after, strict=True)
        ]
        after = _scanned(once, after, rest)
    return [*after, *kept]


def _tangent(spec: RunSpec, steps: Any, *arrays: Any) -> list[Any]:
    """Returns the tangents of the floating-point arrays of the carry after all steps.

    The operands in `arrays` are constants, carry, checkpoints, tangents of constants
    and tangents of the carry.
    """
    body = spec.body
    n_kept = len(body.avals) if spec.keeps else 0
    constants, carry, _, rates, tangents = parted(
        arrays, body.n_constants, len(body.avals), n_kept, sum(spec.moving)
    )
    both, n_both = tangent_body(spec)
    inner = RunSpec(LoopBody(both, n_both), spec.length)
    after = cycles_p.bind(steps, *constants, *rates, *carry, *tangents, spec=inner)
    return after[len(body.avals) :]


def _adjoint(spec: RunSpec, steps: Any, *arrays: Any) -> list[Any]:
    """Returns cotangents of the first carry, then of the constants that have tangents.

    Only floating-point arrays of the carry have cotangents. The operands in `arrays`
    are constants, checkpoints and the cotangents of the last carry.
    """
    body, floating = spec.body, spec.body.floating
    constants, kept, seeds = parted(arrays, body.n_constants, len(body.avals))

    def backwards(
        state: tuple[list[Any], list[Any]], carry: Sequence[Any], length: int
    ) -> tuple[list[Any], list[Any]]:
        cotangents, sums = state

        def of(moved: list[Any], floats: list[Any]) -> list[Any]:
            fixed = filled(constants, spec.moving, moved)
            once = jax.checkpoint(lambda c: body(fixed, c), prevent_cse=False)
            begun = filled(carry, floating, floats)
            return chosen(_scanned(once, begun, length), floating)

        _, transpose = jax.vjp(
            of, chosen(constants, spec.moving), chosen(carry, floating)
        )
        more, earlier = transpose(cotangents)
        return earlier, [a + b for a, b in zip(sums, more, strict=True)]

    whole, rest = divmod(spec.length or 0, spec.every)
    state = (
        list(seeds),
        [jnp.zeros_like(c) for c in chosen(constants, spec.moving)],
    )
    if rest:
        state = backwards(state, [rows[-1] for rows in kept], rest)
        kept = [rows[:-1] for rows in kept]
    state, _ = scan(
        lambda state, carry: (backwards(state, carry, spec.every), None),
        state,
        list(kept),
        length=whole,
        reverse=True,
    )
    return [*state[0], *state[1]]


def _batched_reference(one: Callable[..., list[Any]]) -> Callable[..., list[Any]]:
    """Returns the reference of a primitive, mapped over the batch if there is one.

    `one` is the reference for a single rod.
    """

    def whole(steps: Any, *arrays: Any, spec: RunSpec) -> list[Any]:
        if spec.batch is None:
            return one(spec, steps, *arrays)
        single = replace(spec, batch=None)
        axes = [0 if rows else None for rows in spec.batch.rows]
        return jax.vmap(
            lambda *arrays: one(single, steps, *arrays),
            in_axes=axes,
            axis_size=spec.batch.size,
        )(*arrays)

    return whole


REFERENCES = {
    run_p: _batched_reference(_run),
    cycles_p: _batched_reference(_cycles),
    tangent_p: _batched_reference(_tangent),
    adjoint_p: _batched_reference(_adjoint),
}


def _scanned(
    once: Callable[[list[Any]], list[Any]], carry: list[Any], length: int
) -> list[Any]:
    return scan(lambda c, _: (once(c), None), carry, None, length=length)[0]
