"""Repeated steps as one operation of JAX: batched, differentiated, run by lanes or XLA.

Their first operands are a count of steps, and constants.

- `jaxrod_run`: what is made of what is given, by all steps and what is before and after.
- `jaxrod_cycles`: the carry after all steps; if asked, carries on the way as well.
- `jaxrod_cycles_tangent`: its tangent; linear in the tangents it is given.
- `jaxrod_cycles_adjoint`: the transpose of that, from the carries on the way.

Under `vmap` an operation stays one operation over a batch. What it means is written
once, with JAX's own loops; lanes replace that when a program is compiled, where they
can and it pays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from jaxrod.lanes.choice import lowered_by_lanes, lowered_on_gpu
from jaxrod.lanes.cycle import Batch, Cycle, Plan, chosen, filled, parted, tangent_cycle

run_p = Primitive("jaxrod_run")
cycles_p = Primitive("jaxrod_cycles")
tangent_p = Primitive("jaxrod_cycles_tangent")
adjoint_p = Primitive("jaxrod_cycles_adjoint")


# What they mean, for one rod ------------------------------------------------------


def _run(plan: Plan, steps: Any, *arrays: Any) -> list[Any]:
    ends, cycle = plan.ends, plan.cycle
    assert ends is not None
    constants, given = parted(arrays, cycle.n_constants)
    carry = jaxpr_as_fun(ends.begin)(*constants, *given)
    inner = Plan(cycle, plan.length)
    after = cycles_p.bind(steps, *constants, *carry, plan=inner)
    return list(jaxpr_as_fun(ends.end)(*constants, *after))


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

    carry, kept = lax.scan(segment, list(carry), None, length=whole)
    if rest:
        kept = [
            jnp.concatenate([rows, last[None]])
            for rows, last in zip(kept, carry, strict=True)
        ]
        carry = _scanned(once, carry, rest)
    return [*carry, *kept]


def _tangent(plan: Plan, steps: Any, *arrays: Any) -> list[Any]:
    """Operands: constants, carry, kept carries, tangents of constants, of the carry."""
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
    """Operands: constants, kept carries, cotangents of the floats of the last carry.

    Results: cotangents of the floats of the first carry, and of moving constants.
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
    state, _ = lax.scan(
        lambda state, carry: (backwards(state, carry, plan.every), None),
        state,
        list(kept),
        length=whole,
        reverse=True,
    )
    return [*state[0], *state[1]]


# What they mean, for a batch ------------------------------------------------------


def meaning(one: Callable[..., list[Any]]) -> Callable[..., list[Any]]:
    """What an operation means in JAX's own terms, batch and all."""

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


_MEANINGS = {
    run_p: meaning(_run),
    cycles_p: meaning(_cycles),
    tangent_p: meaning(_tangent),
    adjoint_p: meaning(_adjoint),
}


def _abstract(primitive: Primitive) -> Callable[..., Any]:
    def shapes(steps: Any, *arrays: Any, plan: Plan) -> Any:
        carry = plan.cycle.avals
        floats = chosen(carry, plan.cycle.floating)
        constants = [v.aval for v in plan.cycle.closed.jaxpr.invars]
        rows = () if plan.batch is None else (plan.batch.size,)
        results = [(a.shape, a.dtype) for a in carry]
        if plan.ends is not None:
            results = [(a.shape, a.dtype) for a in plan.ends.made]
        elif primitive is tangent_p:
            results = [(a.shape, a.dtype) for a in floats]
        elif primitive is adjoint_p:
            moving = chosen(constants[: plan.cycle.n_constants], plan.moving)
            results = [(a.shape, a.dtype) for a in (*floats, *moving)]
        elif plan.keeps:
            results += [((plan.n_kept, *a.shape), a.dtype) for a in carry]
        varying = frozenset().union(
            *[getattr(a, "vma", frozenset()) for a in (steps, *arrays)]
        )
        more = {"vma": varying} if varying else {}
        return [
            jax.core.ShapedArray((*rows, *shape), dtype, **more)
            for shape, dtype in results
        ]

    return shapes


def _batched(primitive: Primitive) -> Callable[..., Any]:
    """One more batch: rows of rows become rows."""

    def rule(arrays: Sequence[Any], axes: Sequence[Any], *, plan: Plan) -> Any:
        steps, *arrays = arrays
        steps_axis, *axes = axes
        size = next(
            array.shape[axis]
            for array, axis in zip((steps, *arrays), (steps_axis, *axes), strict=True)
            if axis is not None
        )
        if steps_axis is not None:
            made = jax.vmap(
                lambda *given: _MEANINGS[primitive](*given, plan=plan),
                in_axes=(steps_axis, *axes),
                axis_size=size,
            )(steps, *arrays)
            return made, [0] * len(made)
        old = plan.batch or Batch(1, (False,) * len(arrays))
        may_be_shared = _shareable(primitive, plan)
        rows, flat = [], []
        for array, axis, had, may in zip(
            arrays, axes, old.rows, may_be_shared, strict=True
        ):
            if axis is None and not had and may:
                rows.append(False)
                flat.append(array)
                continue
            if axis is None:
                array = jnp.broadcast_to(array, (size, *array.shape))
            else:
                array = jnp.moveaxis(array, axis, 0)
            if had:
                array = array.reshape(size * old.size, *array.shape[2:])
            elif old.size > 1:
                array = jnp.repeat(array, old.size, axis=0)
            rows.append(True)
            flat.append(array)
        batch = Batch(size * old.size, tuple(rows))
        made = primitive.bind(steps, *flat, plan=replace(plan, batch=batch))
        if plan.batch is not None:
            made = [m.reshape(size, old.size, *m.shape[1:]) for m in made]
        return made, [0] * len(made)

    return rule


def _shareable(primitive: Primitive, plan: Plan) -> list[bool]:
    """Which operands may be the same for all rods: constants and their tangents."""
    n_constants, n_carry = plan.cycle.n_constants, len(plan.cycle.avals)
    n_floats = sum(plan.cycle.floating)
    constants = [True] * n_constants
    if plan.ends is not None:
        return [*constants, *[False] * (len(plan.ends.given) - n_constants)]
    if primitive is cycles_p:
        return [*constants, *[False] * n_carry]
    if primitive is adjoint_p:
        return [*constants, *[False] * (n_carry + n_floats)]
    kept = n_carry if plan.keeps else 0
    rates = [True] * sum(plan.moving)
    return [*constants, *[False] * (n_carry + kept), *rates, *[False] * n_floats]


# Derivatives ----------------------------------------------------------------------


def _cycles_jvp(primals: Any, tangents: Any, *, plan: Plan) -> Any:
    if plan.keeps:
        return _by_meaning(cycles_p)(primals, tangents, plan=plan)
    cycle = plan.cycle
    steps, *arrays = primals
    rates, moved = parted(tangents[1:], cycle.n_constants)
    if plan.length == 0:
        return arrays[cycle.n_constants :], list(moved)
    moving = tuple(
        not isinstance(t, ad.Zero) and jnp.issubdtype(a.dtype, jnp.floating)
        for t, a in zip(rates, arrays, strict=False)
    )
    plan = replace(plan, moving=moving, keeps=plan.length is not None)
    made = cycles_p.bind(steps, *arrays, plan=replace(plan, moving=()))
    n_carry = len(cycle.avals)
    carry, kept = made[:n_carry], made[n_carry:]
    given = [
        jnp.zeros_like(array) if isinstance(tangent, ad.Zero) else tangent
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
        next(floats) if is_float else _without(array)
        for array, is_float in zip(carry, cycle.floating, strict=True)
    ]
    return carry, results


def _tangent_transpose(cotangents: Any, steps: Any, *arrays: Any, plan: Plan) -> Any:
    cycle = plan.cycle
    n_carry = len(cycle.avals)
    if not plan.keeps:
        raise ValueError(
            "Reverse-mode differentiation does not work for a number of steps that is "
            "traced: give `advance` an `int`, or use forward mode (jax.jvp, jax.jacfwd)."
        )
    constants, carry, kept, rates, tangents = parted(
        arrays, cycle.n_constants, n_carry, n_carry, sum(plan.moving)
    )
    floats = chosen(cycle.avals, cycle.floating)
    rows = () if plan.batch is None else (plan.batch.size,)
    seeds = [
        jnp.zeros((*rows, *aval.shape), aval.dtype) if isinstance(ct, ad.Zero) else ct
        for ct, aval in zip(cotangents, floats, strict=True)
    ]
    moving = plan.moving
    batch = None
    if plan.batch is not None:
        of_constants = plan.batch.rows[: cycle.n_constants]
        batch = Batch(
            plan.batch.size, (*of_constants, *[True] * (n_carry + len(seeds)))
        )
    wanted = [ad.is_undefined_primal(rate) for rate in rates]
    which = iter(wanted)
    used = tuple(is_moving and next(which) for is_moving in moving)
    made = adjoint_p.bind(
        steps, *constants, *kept, *seeds, plan=replace(plan, moving=used, batch=batch)
    )
    earlier, sums = parted(made, len(floats))
    found = iter(sums)
    of_rates: list[Any] = []
    flags = plan.batch.rows if plan.batch is not None else (True,) * len(arrays)
    rate_flags = flags[cycle.n_constants + 2 * n_carry :][: len(rates)]
    for rate, has_rows in zip(rates, rate_flags, strict=True):
        if not ad.is_undefined_primal(rate):
            of_rates.append(None)
            continue
        total = next(found)
        of_rates.append(total if has_rows else jnp.sum(total, axis=0))
    of_tangents = [
        ct if ad.is_undefined_primal(tangent) else None
        for tangent, ct in zip(tangents, earlier, strict=True)
    ]
    none = [None] * (1 + cycle.n_constants + 2 * n_carry)
    return [*none, *of_rates, *of_tangents]


def _by_meaning(primitive: Primitive) -> Callable[..., Any]:
    """The derivative of what an operation means: for derivatives of derivatives."""

    def jvp(primals: Any, tangents: Any, *, plan: Plan) -> Any:
        known = [isinstance(t, ad.Zero) for t in tangents]

        def of(*moved: Any) -> list[Any]:
            rest = iter(moved)
            given = [
                p if fixed else next(rest)
                for p, fixed in zip(primals, known, strict=True)
            ]
            return _MEANINGS[primitive](*given, plan=plan)

        moving = [p for p, fixed in zip(primals, known, strict=True) if not fixed]
        rates = [t for t, fixed in zip(tangents, known, strict=True) if not fixed]
        made, after = jax.jvp(of, moving, rates)
        return made, [
            _without(m) if t.dtype == jax.dtypes.float0 else t
            for m, t in zip(made, after, strict=True)
        ]

    return jvp


# Registration ---------------------------------------------------------------------


def _lowering(
    primitive: Primitive, by_lanes: Callable[..., Any], fits: Callable[[Any], bool]
) -> Callable[..., Any]:
    by_xla = mlir.lower_fun(_MEANINGS[primitive], multiple_results=True)

    def rule(context: Any, *operands: Any, plan: Plan) -> Any:
        program = None
        if fits(context):
            program = by_lanes(primitive.name, plan)
        if program is None:
            return by_xla(context, *operands, plan=plan)
        return mlir.lower_fun(program, multiple_results=True)(context, *operands)

    return rule


def _on_one_device(context: Any) -> bool:
    """Whether the compiler has no rods to spread: it cannot cut a kernel's arrays.

    Within `shard_map` each device has rods of its own, and a kernel for them.
    """
    where = context.module_context.axis_context
    if hasattr(where, "num_devices"):
        return bool(where.num_devices in (None, 1))
    if hasattr(where, "manual_axes"):
        return (
            set(where.mesh.axis_names) <= set(where.manual_axes) or where.mesh.size == 1
        )
    return False


def _for_one_gpu(context: Any) -> bool:
    """Whether the program is for CUDA alone, and spread over no devices."""
    where = context.module_context
    on_one = getattr(where.axis_context, "num_devices", 2) in (None, 1)
    return on_one and tuple(where.platforms) == ("cuda",)


for _primitive in (run_p, cycles_p, tangent_p, adjoint_p):
    _primitive.multiple_results = True
    _primitive.def_abstract_eval(_abstract(_primitive))
    _primitive.def_impl(jax.jit(_MEANINGS[_primitive], static_argnames="plan"))
    batching.primitive_batchers[_primitive] = _batched(_primitive)
    mlir.register_lowering(
        _primitive, mlir.lower_fun(_MEANINGS[_primitive], multiple_results=True)
    )
for _primitive in (run_p, cycles_p, adjoint_p):
    mlir.register_lowering(
        _primitive,
        _lowering(_primitive, lowered_by_lanes, _on_one_device),
        platform="cpu",
    )
for _primitive in (run_p, cycles_p):
    mlir.register_lowering(
        _primitive,
        _lowering(_primitive, lowered_on_gpu, _for_one_gpu),
        platform="cuda",
    )
ad.primitive_jvps[run_p] = _by_meaning(run_p)
ad.primitive_jvps[cycles_p] = _cycles_jvp
ad.primitive_jvps[tangent_p] = _by_meaning(tangent_p)
ad.primitive_jvps[adjoint_p] = _by_meaning(adjoint_p)
ad.primitive_transposes[tangent_p] = _tangent_transpose


def _without(array: Any) -> Any:
    """The tangent of an array that has none."""
    return ad.Zero(jax.core.ShapedArray(array.shape, jax.dtypes.float0))


# Small things ---------------------------------------------------------------------


def _scanned(
    once: Callable[[list[Any]], list[Any]], carry: list[Any], length: int
) -> list[Any]:
    return lax.scan(lambda c, _: (once(c), None), carry, None, length=length)[0]
