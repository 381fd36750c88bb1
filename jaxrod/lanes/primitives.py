"""Repeated steps made known to JAX: batched, differentiated, run by lanes or XLA.

Under `vmap` an operation stays one operation over a batch. What it means is written
once, with JAX's own loops; lanes replace that when a program is compiled, where they
can and it pays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxrod.lanes.choice import lanes_wanted, lowered_by_lanes, lowered_on_gpu, refused
from jaxrod.lanes.cycle import Batch, Plan, chosen
from jaxrod.lanes.derivatives import by_meaning, cycles_jvp, tangent_transpose
from jaxrod.lanes.meanings import MEANINGS, adjoint_p, cycles_p, run_p, tangent_p
from jaxrod.lanes.varying import varying_aval


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
        given = (steps, *arrays)
        return [varying_aval((*rows, *shape), dtype, given) for shape, dtype in results]

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
                lambda *given: MEANINGS[primitive](*given, plan=plan),
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


def _lowering(primitive: Primitive, by_lanes: Callable[..., Any]) -> Callable[..., Any]:
    by_xla = mlir.lower_fun(MEANINGS[primitive], multiple_results=True)

    def rule(context: Any, *operands: Any, plan: Plan) -> Any:
        program = None
        words = _unfit(context)
        if words is None:
            program = by_lanes(primitive.name, plan, context.avals_out)
        elif lanes_wanted():
            refused(words, plan.batch.size if plan.batch is not None else 1)
        if program is None:
            return by_xla(context, *operands, plan=plan)
        # A kernel is of one device: over which axes its arrays vary is not its matter.
        plain = [jax.core.ShapedArray(a.shape, a.dtype) for a in context.avals_in]
        return mlir.lower_fun(program, multiple_results=True)(
            context.replace(avals_in=plain), *operands
        )

    return rule


def _unfit(context: Any) -> str | None:
    """Why a program cannot have kernels in it, in words; `None` if it can.

    Within `shard_map` each device has rods of its own, and a kernel for them.
    """
    module = context.module_context
    if len(module.platforms) > 1:
        return "the program is for several platforms, and kernels are of one"
    if getattr(module.lowering_parameters, "for_export", False):
        return "the program is to be exported, and kernels are of this process"
    where = module.axis_context
    devices = getattr(where, "num_devices", None)
    if hasattr(where, "manual_axes"):
        if "cuda" in module.platforms:
            return "kernels for GPUs have never been tried within shard_map"
        left = set(where.mesh.axis_names) - set(where.manual_axes)
        devices = math.prod(where.mesh.shape[name] for name in left)
    if devices not in (None, 1):
        return (
            "the compiler spreads the batch over devices, which it cannot do to kernels"
        )
    return None


for _primitive in (run_p, cycles_p, tangent_p, adjoint_p):
    _primitive.multiple_results = True
    _primitive.def_abstract_eval(_abstract(_primitive))
    _primitive.def_impl(jax.jit(MEANINGS[_primitive], static_argnames="plan"))
    batching.primitive_batchers[_primitive] = _batched(_primitive)
    mlir.register_lowering(
        _primitive, mlir.lower_fun(MEANINGS[_primitive], multiple_results=True)
    )
for _primitive in (run_p, cycles_p, adjoint_p):
    for _platform, _by_lanes in (("cpu", lowered_by_lanes), ("cuda", lowered_on_gpu)):
        mlir.register_lowering(
            _primitive, _lowering(_primitive, _by_lanes), platform=_platform
        )
ad.primitive_jvps[run_p] = by_meaning(run_p)
ad.primitive_jvps[cycles_p] = cycles_jvp
ad.primitive_jvps[tangent_p] = by_meaning(tangent_p)
ad.primitive_jvps[adjoint_p] = by_meaning(adjoint_p)
ad.primitive_transposes[tangent_p] = tangent_transpose


__all__ = ["adjoint_p", "cycles_p", "run_p", "tangent_p"]
