"""Repeated steps as JAX primitives, and their meaning in JAX's own loops.

Their first operands are the number of steps and the constants.

- `jaxrod_run`: a whole run, from its arguments to its results: beginning, steps, end.
- `jaxrod_cycles`: the carry after all steps; on request the checkpoints too.
- `jaxrod_cycles_tangent`: the tangent of that carry; linear in the given tangents.
- `jaxrod_cycles_adjoint`: the transpose of that, from the checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.jax_internals.primitives import evaluate, new_primitive
from jaxrod.jax_internals.scans import scan
from jaxrod.lanes.cycle import Cycle, Plan, chosen, filled, parted, tangent_cycle

run_p = new_primitive("jaxrod_run")
cycles_p = new_primitive("jaxrod_cycles")
tangent_p = new_primitive("jaxrod_cycles_tangent")
adjoint_p = new_primitive("jaxrod_cycles_adjoint")


def _run(plan: Plan, steps: Any, *arrays: Any) -> list[Any]:
    ends, cycle = plan.ends, plan.cycle
    assert ends is not None
    constants, given = parted(arrays, cycle.n_constants)
    carry = evaluate(ends.begin, *constants, *given)
    inner = Plan(cycle, plan.length)
    after = cycles_p.bind(steps, *constants, *carry, plan=inner)
    return evaluate(ends.end, *constants, *after)


def _cycles(plan: Plan, steps: Any, *arrays: Any) -> list[Any]:
    cycle = plan.cycle
    constants, carry = parted(arrays, cycle.n_constants)

    def once(carry: list[Any]) -> list[Any]:
        return cycle(constants, carry)

    if not plan.keeps:
        if plan.length is None:
            return lax.fori_loop(0, steps, lambda _, c: once(c), list(carry))
        return _scanned(once, list(carry), plan.length)
    every = plan.every
    whole, rest = divmod(plan.length or 0, every)

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


def _tangent(plan: Plan, steps: Any, *arrays: Any) -> list[Any]:
    """Returns the tangent of the carry after all steps.

    Operands: constants, carry, checkpoints, tangents of constants, tangents of the
    carry.
    """
    cycle = plan.cycle
    n_kept = len(cycle.avals) if plan.keeps else 0
    constants, carry, _, rates, tangents = parted(
        arrays, cycle.n_constants, len(cycle.avals), n_kept, sum(plan.moving)
    )
    both, n_both = tangent_cycle(plan)
    inner = Plan(Cycle(both, n_both), plan.length)
    after = cycles_p.bind(steps, *constants, *rates, *carry, *tangents, plan=inner)
    return after[len(cycle.avals) :]


def _adjoint(plan: Plan, steps: Any, *arrays: Any) -> list[Any]:
    """Returns cotangents of the floats of the first carry, and of moving constants.

    Operands: constants, checkpoints, cotangents of the floats of the last carry.
    """
    cycle, floating = plan.cycle, plan.cycle.floating
    constants, kept, seeds = parted(arrays, cycle.n_constants, len(cycle.avals))

    def backwards(
        state: tuple[list[Any], list[Any]], carry: Sequence[Any], length: int
    ) -> tuple[list[Any], list[Any]]:
        cotangents, sums = state

        def of(moved: list[Any], floats: list[Any]) -> list[Any]:
            fixed = filled(constants, plan.moving, moved)
            once = jax.checkpoint(lambda c: cycle(fixed, c), prevent_cse=False)
            begun = filled(carry, floating, floats)
            return chosen(_scanned(once, begun, length), floating)

        _, transpose = jax.vjp(
            of, chosen(constants, plan.moving), chosen(carry, floating)
        )
        more, earlier = transpose(cotangents)
        return earlier, [a + b for a, b in zip(sums, more, strict=True)]

    whole, rest = divmod(plan.length or 0, plan.every)
    state = (
        list(seeds),
        [jnp.zeros_like(c) for c in chosen(constants, plan.moving)],
    )
    if rest:
        state = backwards(state, [rows[-1] for rows in kept], rest)
        kept = [rows[:-1] for rows in kept]
    state, _ = scan(
        lambda state, carry: (backwards(state, carry, plan.every), None),
        state,
        list(kept),
        length=whole,
        reverse=True,
    )
    return [*state[0], *state[1]]


def _whole(one: Callable[..., list[Any]]) -> Callable[..., list[Any]]:
    """Returns the meaning of a primitive for a plan with or without a batch."""

    def whole(steps: Any, *arrays: Any, plan: Plan) -> list[Any]:
        if plan.batch is None:
            return one(plan, steps, *arrays)
        single = replace(plan, batch=None)
        axes = [0 if rows else None for rows in plan.batch.rows]
        return jax.vmap(
            lambda *arrays: one(single, steps, *arrays),
            in_axes=axes,
            axis_size=plan.batch.size,
        )(*arrays)

    return whole


MEANINGS = {
    run_p: _whole(_run),
    cycles_p: _whole(_cycles),
    tangent_p: _whole(_tangent),
    adjoint_p: _whole(_adjoint),
}


def _scanned(
    once: Callable[[list[Any]], list[Any]], carry: list[Any], length: int
) -> list[Any]:
    return scan(lambda c, _: (once(c), None), carry, None, length=length)[0]
