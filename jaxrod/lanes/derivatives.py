"""Derivatives of repeated steps, in forward mode and in reverse mode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.jax_internals.primitives import (
    filled_in,
    is_linear_input,
    is_zero,
    no_tangent,
)
from jaxrod.lanes.cycle import Batch, Plan, chosen, parted
from jaxrod.lanes.meanings import MEANINGS, adjoint_p, cycles_p, tangent_p


def cycles_jvp(primals: Any, tangents: Any, *, plan: Plan) -> Any:
    """JVP rule of `jaxrod_cycles`: the carry after all steps, and its tangent.

    Checkpoints are kept for the transpose if the number of steps is known.
    """
    if plan.keeps:
        return by_meaning(cycles_p)(primals, tangents, plan=plan)
    cycle = plan.cycle
    steps, *arrays = primals
    rates, moved = parted(tangents[1:], cycle.n_constants)
    if plan.length == 0:
        return arrays[cycle.n_constants :], list(moved)
    moving = tuple(
        not is_zero(t) and jnp.issubdtype(a.dtype, jnp.floating)
        for t, a in zip(rates, arrays, strict=False)
    )
    plan = replace(plan, moving=moving, keeps=plan.length is not None)
    made = cycles_p.bind(steps, *arrays, plan=replace(plan, moving=()))
    n_carry = len(cycle.avals)
    carry, kept = made[:n_carry], made[n_carry:]
    given = [
        jnp.zeros_like(array) if is_zero(tangent) else tangent
        for array, tangent, floats in zip(
            arrays[cycle.n_constants :], moved, cycle.floating, strict=True
        )
        if floats
    ]
    rows = None
    if plan.batch is not None:
        of_constants = plan.batch.rows[: cycle.n_constants]
        carried = [True] * (n_carry + len(kept))
        rows = Batch(
            plan.batch.size,
            (
                *of_constants,
                *carried,
                *chosen(of_constants, moving),
                *[True] * len(given),
            ),
        )
    after = tangent_p.bind(
        steps,
        *arrays,
        *kept,
        *chosen(rates, moving),
        *given,
        plan=replace(plan, batch=rows),
    )
    floats = iter(after)
    results = [
        next(floats) if is_float else no_tangent(array)
        for array, is_float in zip(carry, cycle.floating, strict=True)
    ]
    return carry, results


def tangent_transpose(cotangents: Any, steps: Any, *arrays: Any, plan: Plan) -> Any:
    """Transpose rule of `jaxrod_cycles_tangent`: cotangents of its linear operands.

    Raises:
        ValueError: The number of steps is traced.
    """
    cycle = plan.cycle
    n_carry = len(cycle.avals)
    if not plan.keeps:
        raise ValueError(
            "Reverse-mode differentiation does not work for a number of steps that "
            "is traced: give `advance` an `int`, or use forward mode (jax.jvp, "
            "jax.jacfwd)."
        )
    constants, _, kept, rates, tangents = parted(
        arrays, cycle.n_constants, n_carry, n_carry, sum(plan.moving)
    )
    seeds = [filled_in(cotangent) for cotangent in cotangents]
    moving = plan.moving
    batch = None
    if plan.batch is not None:
        of_constants = plan.batch.rows[: cycle.n_constants]
        batch = Batch(
            plan.batch.size, (*of_constants, *[True] * (n_carry + len(seeds)))
        )
    wanted = [is_linear_input(rate) for rate in rates]
    which = iter(wanted)
    used = tuple(is_moving and next(which) for is_moving in moving)
    made = adjoint_p.bind(
        steps, *constants, *kept, *seeds, plan=replace(plan, moving=used, batch=batch)
    )
    earlier, sums = parted(made, len(seeds))
    found = iter(sums)
    of_rates: list[Any] = []
    flags = plan.batch.rows if plan.batch is not None else (True,) * len(arrays)
    rate_flags = flags[cycle.n_constants + 2 * n_carry :][: len(rates)]
    for rate, has_rows in zip(rates, rate_flags, strict=True):
        if not is_linear_input(rate):
            of_rates.append(None)
            continue
        total = next(found)
        of_rates.append(total if has_rows else jnp.sum(total, axis=0))
    of_tangents = [
        ct if is_linear_input(tangent) else None
        for tangent, ct in zip(tangents, earlier, strict=True)
    ]
    none = [None] * (1 + cycle.n_constants + 2 * n_carry)
    return [*none, *of_rates, *of_tangents]


def by_meaning(primitive: Any) -> Callable[..., Any]:
    """Returns the JVP rule of a primitive by its meaning, for higher derivatives."""

    def jvp(primals: Any, tangents: Any, *, plan: Plan) -> Any:
        known = [is_zero(t) for t in tangents]

        def of(*moved: Any) -> list[Any]:
            rest = iter(moved)
            given = [
                p if fixed else next(rest)
                for p, fixed in zip(primals, known, strict=True)
            ]
            return MEANINGS[primitive](*given, plan=plan)

        moving = [p for p, fixed in zip(primals, known, strict=True) if not fixed]
        rates = [t for t, fixed in zip(tangents, known, strict=True) if not fixed]
        made, after = jax.jvp(of, moving, rates)
        return made, [
            no_tangent(m) if t.dtype == jax.dtypes.float0 else t
            for m, t in zip(made, after, strict=True)
        ]

    return jvp
