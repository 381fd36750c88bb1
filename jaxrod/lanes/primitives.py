"""Repeated steps as JAX primitives: their reference, and JAX's rules for them.

A step takes constants and a carry to the next carry. The first operands of each
primitive are the number of steps and the constants.

- `jaxrod_run`: a whole run, from its arguments to its results: beginning, steps, end.
- `jaxrod_cycles`: the carry after all steps; on request the checkpoints too.
- `jaxrod_cycles_tangent`: the tangent of that carry; linear in the given tangents.
- `jaxrod_cycles_adjoint`: the transpose of the tangent, computed backwards from
  checkpoints.

The rules are those of batching, derivatives and lowering. Under `vmap` an operation
remains one operation over a batch. Its reference is written once, with JAX's own loops.
At compile time a kernel replaces the reference if that is possible and faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.jax_internals.equations import operand_types
from jaxrod.jax_internals.mesh_axes import varying_aval
from jaxrod.jax_internals.primitives import (
    define,
    filled_in,
    is_linear_input,
    is_zero,
    lower_on,
    new_primitive,
    no_tangent,
)
from jaxrod.jax_internals.scans import scan
from jaxrod.lanes.choice import lanes_wanted, refused
from jaxrod.lanes.kernels import lowered_by_lanes, lowered_by_warps
from jaxrod.lanes.run_spec import (
    Batch,
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

    The operands in `arrays` are constants, checkpoints if they are stored or else the
    carry, tangents of constants and tangents of the carry.
    """
    body = spec.body
    constants, carry, rates, tangents = parted(
        arrays, body.n_constants, len(body.avals), sum(spec.moving)
    )
    if spec.stores:
        carry = [rows[0] for rows in carry]
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
    """Returns the reference implementation of a primitive for one rod or a batch.

    `one` is the implementation for a single rod. It is mapped over the leading axis of
    the operands that `spec.batch.rows` marks.
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
    rates = [True] * sum(spec.moving)
    return [*constants, *[False] * n_carry, *rates, *[False] * n_floats]


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
    made = cycles_p.bind(
        steps, *arrays, spec=replace(spec, moving=(), keeps=spec.stores)
    )
    constants, points = parted(arrays, body.n_constants)
    n_carry = len(body.avals)
    carry = made[:n_carry]
    if spec.stores:
        points = made[n_carry:]
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
        rows = Batch(
            spec.batch.size,
            (
                *of_constants,
                *[True] * n_carry,
                *chosen(of_constants, moving),
                *[True] * len(given),
            ),
        )
    after = tangent_p.bind(
        steps,
        *constants,
        *points,
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
            "is a JAX array: give `advance` an `int`, such as int(n_steps) outside of "
            "jax.jit, or use forward mode (jax.jvp, jax.jacfwd)."
        )
    constants, kept, rates, tangents = parted(
        arrays, body.n_constants, n_carry, sum(spec.moving)
    )
    if not spec.stores:
        axis = 0 if spec.batch is None else 1
        kept = [jnp.expand_dims(array, axis) for array in kept]
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
    rate_flags = flags[body.n_constants + n_carry :][: len(rates)]
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
    none = [None] * (1 + body.n_constants + n_carry)
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
