"""JAX's rules of the primitives for repeated steps: batching, derivatives, lowering.

Under `vmap` an operation remains one operation over a batch. Its reference is written
once, with JAX's own loops. At compile time a kernel replaces the reference if that is
possible and faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.jax_internals.equations import operand_types
from jaxrod.jax_internals.mesh_axes import varying_aval
from jaxrod.jax_internals.primitives import (
    define,
    filled_in,
    is_linear_input,
    is_zero,
    lower_on,
    no_tangent,
)
from jaxrod.lanes.choice import lanes_wanted, refused
from jaxrod.lanes.kernels import lowered_by_lanes, lowered_by_warps
from jaxrod.lanes.reference import (
    REFERENCES,
    adjoint_p,
    cycles_p,
    run_once,
    run_p,
    tangent_p,
)
from jaxrod.lanes.run_spec import Batch, RunSpec, chosen, parted


def _abstract(primitive: Any) -> Callable[..., Any]:
    def shapes(steps: Any, *arrays: Any, spec: RunSpec) -> Any:
        carry = spec.body.avals
        floats = chosen(carry, spec.body.floating)
        constants = operand_types(spec.body.closed)
        rows = () if spec.batch is None else (spec.batch.size,)
        results = [(a.shape, a.dtype) for a in carry]
        if spec.ends is not None:
            results = [(a.shape, a.dtype) for a in spec.ends.made]
        elif primitive is tangent_p:
            results = [(a.shape, a.dtype) for a in floats]
        elif primitive is adjoint_p:
            moving = chosen(constants[: spec.body.n_constants], spec.moving)
            results = [(a.shape, a.dtype) for a in (*floats, *moving)]
        elif spec.keeps:
            results += [((spec.n_kept, *a.shape), a.dtype) for a in carry]
        given = (steps, *arrays)
        return [varying_aval((*rows, *shape), dtype, given) for shape, dtype in results]

    return shapes


def _batched(primitive: Any) -> Callable[..., Any]:
    """Returns the `vmap` rule of a primitive, which merges nested batches into one."""

    def rule(arrays: Sequence[Any], axes: Sequence[Any], *, spec: RunSpec) -> Any:
        steps, *arrays = arrays
        steps_axis, *axes = axes
        size = next(
            array.shape[axis]
            for array, axis in zip((steps, *arrays), (steps_axis, *axes), strict=True)
            if axis is not None
        )
        if steps_axis is not None:
            made = jax.vmap(
                lambda *given: REFERENCES[primitive](*given, spec=spec),
                in_axes=(steps_axis, *axes),
                axis_size=size,
            )(steps, *arrays)
            return made, [0] * len(made)
        old = spec.batch or Batch(1, (False,) * len(arrays))
        may_be_shared = _shareable(primitive, spec)
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
        made = primitive.bind(steps, *flat, spec=replace(spec, batch=batch))
        if spec.batch is not None:
            made = [m.reshape(size, old.size, *m.shape[1:]) for m in made]
        return made, [0] * len(made)

    return rule


def _shareable(primitive: Any, spec: RunSpec) -> list[bool]:
    """Whether each operand of a primitive may be shared by all rods of a batch.

    Constants and their tangents may; the carry, checkpoints and cotangents may not.
    """
    n_constants, n_carry = spec.body.n_constants, len(spec.body.avals)
    n_floats = sum(spec.body.floating)
    constants = [True] * n_constants
    if spec.ends is not None:
        return [*constants, *[False] * (len(spec.ends.given) - n_constants)]
    if primitive is cycles_p:
        return [*constants, *[False] * n_carry]
    if primitive is adjoint_p:
        return [*constants, *[False] * (n_carry + n_floats)]
    kept = n_carry if spec.keeps else 0
    rates = [True] * sum(spec.moving)
    return [*constants, *[False] * (n_carry + kept), *rates, *[False] * n_floats]


def _cycles_jvp(primals: Any, tangents: Any, *, spec: RunSpec) -> Any:
    """Forward-mode rule of `jaxrod_cycles`: carry after all steps, and its tangent.

    Checkpoints are kept for the transpose if the number of steps is known.
    """
    if spec.keeps:
        return _jvp_of_reference(cycles_p)(primals, tangents, spec=spec)
    body = spec.body
    steps, *arrays = primals
    rates, moved = parted(tangents[1:], body.n_constants)
    if spec.length == 0:
        return arrays[body.n_constants :], list(moved)
    moving = tuple(
        not is_zero(t) and jnp.issubdtype(a.dtype, jnp.floating)
        for t, a in zip(rates, arrays, strict=False)
    )
    spec = replace(spec, moving=moving, keeps=spec.length is not None)
    made = cycles_p.bind(steps, *arrays, spec=replace(spec, moving=()))
    n_carry = len(body.avals)
    carry, kept = made[:n_carry], made[n_carry:]
    given = [
        jnp.zeros_like(array) if is_zero(tangent) else tangent
        for array, tangent, floats in zip(
            arrays[body.n_constants :], moved, body.floating, strict=True
        )
        if floats
    ]
    rows = None
    if spec.batch is not None:
        of_constants = spec.batch.rows[: body.n_constants]
        carried = [True] * (n_carry + len(kept))
        rows = Batch(
            spec.batch.size,
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
        spec=replace(spec, batch=rows),
    )
    floats = iter(after)
    results = [
        next(floats) if is_float else no_tangent(array)
        for array, is_float in zip(carry, body.floating, strict=True)
    ]
    return carry, results


def _tangent_transpose(cotangents: Any, steps: Any, *arrays: Any, spec: RunSpec) -> Any:
    """Transpose rule of `jaxrod_cycles_tangent`: cotangents of the tangent operands.

    Raises:
        ValueError: The number of steps is traced.
    """
    body = spec.body
    n_carry = len(body.avals)
    if not spec.keeps:
        raise ValueError(
            "Reverse-mode differentiation does not work for a number of steps that "
            "is traced: give `advance` an `int`, or use forward mode (jax.jvp, "
            "jax.jacfwd)."
        )
    constants, _, kept, rates, tangents = parted(
        arrays, body.n_constants, n_carry, n_carry, sum(spec.moving)
    )
    seeds = [filled_in(cotangent) for cotangent in cotangents]
    moving = spec.moving
    batch = None
    if spec.batch is not None:
        of_constants = spec.batch.rows[: body.n_constants]
        batch = Batch(
            spec.batch.size, (*of_constants, *[True] * (n_carry + len(seeds)))
        )
    wanted = [is_linear_input(rate) for rate in rates]
    which = iter(wanted)
    used = tuple(is_moving and next(which) for is_moving in moving)
    made = adjoint_p.bind(
        steps, *constants, *kept, *seeds, spec=replace(spec, moving=used, batch=batch)
    )
    earlier, sums = parted(made, len(seeds))
    found = iter(sums)
    of_rates: list[Any] = []
    flags = spec.batch.rows if spec.batch is not None else (True,) * len(arrays)
    rate_flags = flags[body.n_constants + 2 * n_carry :][: len(rates)]
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
    none = [None] * (1 + body.n_constants + 2 * n_carry)
    return [*none, *of_rates, *of_tangents]


def _jvp_of_reference(primitive: Any) -> Callable[..., Any]:
    """Returns the forward-mode rule that differentiates a primitive's reference.

    It serves higher derivatives, and primitives without a rule of their own.
    """

    def jvp(primals: Any, tangents: Any, *, spec: RunSpec) -> Any:
        known = [is_zero(t) for t in tangents]

        def of(*moved: Any) -> list[Any]:
            rest = iter(moved)
            given = [
                p if fixed else next(rest)
                for p, fixed in zip(primals, known, strict=True)
            ]
            return REFERENCES[primitive](*given, spec=spec)

        moving = [p for p, fixed in zip(primals, known, strict=True) if not fixed]
        rates = [t for t, fixed in zip(tangents, known, strict=True) if not fixed]
        made, after = jax.jvp(of, moving, rates)
        return made, [
            no_tangent(m) if t.dtype == jax.dtypes.float0 else t
            for m, t in zip(made, after, strict=True)
        ]

    return jvp


def _kernels(primitive: Any, platform: str) -> Callable[..., Any]:
    """Returns a function that chooses a primitive's program when it is compiled.

    The function returns the kernel's program on the platform, or `None` for XLA.
    """

    def choose(unfit: str | None, results: Any, parameters: Any) -> Any:
        spec = parameters["spec"]
        if unfit is None:
            lowered = lowered_by_lanes if platform == "cpu" else lowered_by_warps
            return lowered(primitive.name, spec, results)
        if lanes_wanted():
            refused(unfit, spec.batch.size if spec.batch is not None else 1)
        return None

    return choose


_JVPS = {cycles_p: _cycles_jvp}
_TRANSPOSES = {tangent_p: _tangent_transpose}
for _primitive, _reference in REFERENCES.items():
    define(
        _primitive,
        _reference,
        static="spec",
        shapes=_abstract(_primitive),
        batched=_batched(_primitive),
        jvp=_JVPS.get(_primitive, _jvp_of_reference(_primitive)),
        transpose=_TRANSPOSES.get(_primitive),
    )
for _primitive in (run_p, cycles_p, adjoint_p):
    for _platform in ("cpu", "cuda"):
        lower_on(
            _platform,
            _primitive,
            REFERENCES[_primitive],
            _kernels(_primitive, _platform),
        )


__all__ = ["adjoint_p", "cycles_p", "run_once", "run_p", "tangent_p"]
