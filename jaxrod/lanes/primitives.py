"""Rules of the primitives for repeated steps: batching, derivatives and lowering.

Under `vmap` an operation stays one operation over a batch. Its meaning is written once,
with JAX's own loops. Lanes replace that at compile time where they can and where it
pays off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.jax_internals.equations import operand_types
from jaxrod.jax_internals.mesh_axes import varying_aval
from jaxrod.jax_internals.primitives import define, lower_on_cpus
from jaxrod.lanes.choice import lanes_wanted, lowered_by_lanes, refused
from jaxrod.lanes.cycle import Batch, Plan, chosen
from jaxrod.lanes.derivatives import by_meaning, cycles_jvp, tangent_transpose
from jaxrod.lanes.meanings import MEANINGS, adjoint_p, cycles_p, run_p, tangent_p


def _abstract(primitive: Any) -> Callable[..., Any]:
    def shapes(steps: Any, *arrays: Any, plan: Plan) -> Any:
        carry = plan.cycle.avals
        floats = chosen(carry, plan.cycle.floating)
        constants = operand_types(plan.cycle.closed)
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


def _batched(primitive: Any) -> Callable[..., Any]:
    """Returns the batching rule, which flattens a batch of batches to one batch."""

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


def _shareable(primitive: Any, plan: Plan) -> list[bool]:
    """Whether each operand may be shared by all rods: constants and their tangents."""
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


def _kernels(primitive: Any) -> Callable[..., Any]:
    """Returns the choice of a program on CPUs: a kernel, or `None`."""

    def choose(unfit: str | None, results: Any, parameters: Any) -> Any:
        plan = parameters["plan"]
        if unfit is None:
            return lowered_by_lanes(primitive.name, plan, results)
        if lanes_wanted():
            refused(unfit, plan.batch.size if plan.batch is not None else 1)
        return None

    return choose


_JVPS = {cycles_p: cycles_jvp}
_TRANSPOSES = {tangent_p: tangent_transpose}
for _primitive, _meaning in MEANINGS.items():
    define(
        _primitive,
        _meaning,
        static="plan",
        shapes=_abstract(_primitive),
        batched=_batched(_primitive),
        jvp=_JVPS.get(_primitive, by_meaning(_primitive)),
        transpose=_TRANSPOSES.get(_primitive),
    )
for _primitive in (run_p, cycles_p, adjoint_p):
    lower_on_cpus(_primitive, MEANINGS[_primitive], _kernels(_primitive))


__all__ = ["adjoint_p", "cycles_p", "run_p", "tangent_p"]
