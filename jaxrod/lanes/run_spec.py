"""A step of a run as a closed jaxpr, and the jaxprs of its derivatives."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.jax_internals.equations import as_carry, operand_types, result_types
from jaxrod.jax_internals.mesh_axes import varying_shape
from jaxrod.jax_internals.primitives import evaluate

_in_one_kernel: ContextVar[bool] = ContextVar("in_one_kernel", default=False)


@contextmanager
def in_one_kernel() -> Iterator[None]:
    """Context in which programs are traced that are to be one kernel each.

    Parts of such a program have no kernels of their own.
    """
    before = _in_one_kernel.set(True)
    try:
        yield
    finally:
        _in_one_kernel.reset(before)


def is_in_one_kernel() -> bool:
    """Whether the program being traced is to be one kernel."""
    return _in_one_kernel.get()


@dataclass(frozen=True, eq=False)
class LoopBody:
    """One step as a closed jaxpr: it takes constants and a carry to the next carry."""

    closed: Any
    """Closed jaxpr of the step; its operands are constants, then the carry."""
    n_constants: int
    """Number of constants, which are the first operands of the step."""

    @property
    def avals(self) -> Any:
        """Types (shape and dtype) of the arrays of the carry."""
        return result_types(self.closed)

    @property
    def floating(self) -> tuple[bool, ...]:
        """Whether each array of the carry is of floats, and so has a tangent."""
        return tuple(jnp.issubdtype(a.dtype, jnp.floating) for a in self.avals)

    def __call__(self, constants: Sequence[Any], carry: Sequence[Any]) -> list[Any]:
        """Returns the carry after the step."""
        return evaluate(self.closed, *constants, *carry)


@dataclass(frozen=True, eq=False)
class Ends:
    """The beginning and the end of a run, as closed jaxprs."""

    begin: Any
    """Closed jaxpr that takes constants and the run's arguments to the first carry."""
    end: Any
    """Closed jaxpr that takes constants and the last carry to the run's results."""

    n_constants: int
    """Number of constants, which are the first operands of both jaxprs."""

    @property
    def given(self) -> Any:
        """Types of the operands of `begin`: constants, then arguments of the run."""
        return operand_types(self.begin)

    @cached_property
    def first(self) -> LoopBody:
        """The beginning as a step, so that a step's kernel can evaluate it."""
        return as_step(self.begin, self.n_constants)

    @cached_property
    def last(self) -> LoopBody:
        """The end as a step, so that a step's kernel can evaluate it."""
        return as_step(self.end, self.n_constants)

    @property
    def made(self) -> Any:
        """Types of the results of the run."""
        return result_types(self.end)


@dataclass(frozen=True)
class Batch:
    """Size of a batch of rods, and the operands that differ between its rods."""

    size: int
    """Number of rods."""
    rows: tuple[bool, ...]
    """Whether each operand after the number of steps has a leading axis of rods; an
    operand without one is shared by all rods."""


@dataclass(frozen=True)
class RunSpec:
    """Static description of repeated steps: step, count, derivatives and batch."""

    body: LoopBody
    """The step."""
    length: int | None
    """Number of steps; `None` if it is traced."""
    moving: tuple[bool, ...] = ()
    """Whether each constant has a tangent; empty without derivatives."""
    keeps: bool = False
    """Whether checkpoints (carries before steps 0, `every`, 2 `every`, ...) are kept,
    for reverse mode."""
    batch: Batch | None = None
    """The batch; `None` for a single rod."""
    ends: Ends | None = None
    """Beginning and end of a whole run; `None` if steps alone are repeated."""

    @property
    def every(self) -> int:
        """Number of steps between checkpoints: the integer square root of `length`."""
        return max(1, math.isqrt(max(self.length or 1, 1)))

    @property
    def n_kept(self) -> int:
        """Number of checkpoints, `length / every` rounded up."""
        return -(-(self.length or 0) // self.every)

    @property
    def stores(self) -> bool:
        """Whether checkpoints are results of the run.

        A single one is the carry before the run, which nobody has to store.
        """
        return self.keeps and self.n_kept > 1


def as_step(closed: Any, n_constants: int) -> LoopBody:
    """Returns a program as a step, whose carry is its arguments and its results.

    So a program that is evaluated once can use the kernels and derivatives of steps.
    """
    return LoopBody(as_carry(closed, n_constants), n_constants)


def tangent_body(spec: RunSpec) -> tuple[Any, int]:
    """Returns the jaxpr of a step that advances a carry and its tangent together.

    Its operands are constants, tangents of the constants that have one, carry, and
    tangents of the floating-point arrays of the carry.

    Returns:
        The closed jaxpr, and the number of its constants, including their tangents.
    """
    body, moving = spec.body, spec.moving
    floating = body.floating
    avals = operand_types(body.closed)
    constants, carry = avals[: body.n_constants], avals[body.n_constants :]
    rates = chosen(constants, moving)
    tangents = chosen(carry, floating)

    def both(*arrays: Any) -> list[Any]:
        fixed, rates_now, now, tangents_now = parted(
            arrays, len(constants), len(rates), len(carry)
        )

        def of(moved: list[Any], floats: list[Any]) -> tuple[list[Any], list[Any]]:
            made = body(filled(fixed, moving, moved), filled(now, floating, floats))
            return chosen(made, floating), made

        _, after, made = jax.jvp(
            of,
            (chosen(fixed, moving), chosen(now, floating)),
            (list(rates_now), list(tangents_now)),
            has_aux=True,
        )
        return [*made, *after]

    with in_one_kernel():
        closed = jax.make_jaxpr(both)(
            *map(varying_shape, [*constants, *rates, *carry, *tangents])
        )
    return closed, len(constants) + len(rates)


@lru_cache(maxsize=64)
def adjoint_body(spec: RunSpec) -> Any:
    """Returns the closed jaxpr of a reversed step (vector-Jacobian product).

    It takes constants, the carry before the step and the cotangents of the next carry.
    It returns the cotangents of the carry, then those of the constants that have a
    tangent.
    """
    body, moving, floating = spec.body, spec.moving, spec.body.floating
    avals = operand_types(body.closed)
    constants, carry = avals[: body.n_constants], avals[body.n_constants :]

    def back(*arrays: Any) -> list[Any]:
        fixed, now, cotangents = parted(arrays, len(constants), len(carry))

        def of(moved: list[Any], floats: list[Any]) -> list[Any]:
            made = body(filled(fixed, moving, moved), filled(now, floating, floats))
            return chosen(made, floating)

        def rates(*tangents: list[Any]) -> list[Any]:
            return jax.jvp(of, at, tangents)[1]

        # Half the tracing time of jax.vjp, which traces every equation by itself.
        at = chosen(fixed, moving), chosen(now, floating)
        sums, earlier = jax.linear_transpose(rates, *at)(list(cotangents))
        return [*earlier, *sums]

    given = [*constants, *carry, *chosen(body.avals, floating)]
    with in_one_kernel():
        return jax.make_jaxpr(back)(*map(varying_shape, given))


def parted(arrays: Sequence[Any], *sizes: int) -> list[Sequence[Any]]:
    """Splits a sequence into parts of the given sizes, followed by the rest."""
    parts, begin = [], 0
    for size in sizes:
        parts.append(arrays[begin : begin + size])
        begin += size
    return [*parts, arrays[begin:]]


def chosen(things: Sequence[Any], flags: Sequence[bool]) -> list[Any]:
    """Returns the entries whose flag is true."""
    return [thing for thing, flag in zip(things, flags, strict=True) if flag]


def filled(
    things: Sequence[Any], flags: Sequence[bool], chosen: Sequence[Any]
) -> list[Any]:
    """Returns a list in which the entries whose flag is true are replaced, in order.

    There is one entry in `chosen` for each true flag.
    """
    rest = iter(chosen)
    return [
        next(rest) if flag else thing for thing, flag in zip(things, flags, strict=True)
    ]
