"""A step as a program, and the programs of its derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.jax_internals.equations import operand_types, result_types
from jaxrod.jax_internals.mesh_axes import varying_shape
from jaxrod.jax_internals.primitives import evaluate


@dataclass(frozen=True, eq=False)
class Cycle:
    """One step as a program: constants and carry to the next carry."""

    closed: Any
    """Its closed jaxpr."""
    n_constants: int

    @property
    def avals(self) -> Any:
        """Of the carry."""
        return result_types(self.closed)

    @property
    def floating(self) -> tuple[bool, ...]:
        """Which arrays of the carry have tangents."""
        return tuple(jnp.issubdtype(a.dtype, jnp.floating) for a in self.avals)

    def __call__(self, constants: Sequence[Any], carry: Sequence[Any]) -> list[Any]:
        """The next carry."""
        return evaluate(self.closed, *constants, *carry)


@dataclass(frozen=True, eq=False)
class Ends:
    """What a run begins and ends with, as programs."""

    begin: Any
    """Closed jaxpr: constants and what is given to the first carry."""
    end: Any
    """Closed jaxpr: constants and the last carry to what is made."""

    @property
    def given(self) -> Any:
        """Shapes and types of what is given, after the constants."""
        return operand_types(self.begin)

    @property
    def made(self) -> Any:
        """Shapes and types of what is made."""
        return result_types(self.end)


@dataclass(frozen=True)
class Batch:
    """Rods of an operation, and which operands have a row for each of them."""

    size: int
    rows: tuple[bool, ...]


@dataclass(frozen=True)
class Plan:
    """The structure of an operation."""

    cycle: Cycle
    length: int | None
    """How many steps, where that is known when the program is made."""
    moving: tuple[bool, ...] = ()
    """Which constants have tangents."""
    keeps: bool = False
    """Whether carries on the way are results too."""
    batch: Batch | None = None
    ends: Ends | None = None
    """Of a whole run."""

    @property
    def every(self) -> int:
        """Steps between the carries that are kept: about the root of their number."""
        return max(1, math.isqrt(max(self.length or 1, 1)))

    @property
    def n_kept(self) -> int:
        """How many carries are kept."""
        return -(-(self.length or 0) // self.every)


def tangent_cycle(plan: Plan) -> tuple[Any, int]:
    """A step of carry and tangents together, and its number of constants."""
    cycle, moving = plan.cycle, plan.moving
    floating = cycle.floating
    avals = operand_types(cycle.closed)
    constants, carry = avals[: cycle.n_constants], avals[cycle.n_constants :]
    rates = chosen(constants, moving)
    tangents = chosen(carry, floating)

    def both(*arrays: Any) -> list[Any]:
        fixed, rates_now, now, tangents_now = parted(
            arrays, len(constants), len(rates), len(carry)
        )

        def of(moved: list[Any], floats: list[Any]) -> tuple[list[Any], list[Any]]:
            made = cycle(filled(fixed, moving, moved), filled(now, floating, floats))
            return chosen(made, floating), made

        _, after, made = jax.jvp(
            of,
            (chosen(fixed, moving), chosen(now, floating)),
            (list(rates_now), list(tangents_now)),
            has_aux=True,
        )
        return [*made, *after]

    closed = jax.make_jaxpr(both)(
        *map(varying_shape, [*constants, *rates, *carry, *tangents])
    )
    return closed, len(constants) + len(rates)


def adjoint_cycle(plan: Plan) -> Any:
    """A step backwards: constants, carry, cotangents to cotangents of both."""
    cycle, moving, floating = plan.cycle, plan.moving, plan.cycle.floating
    avals = operand_types(cycle.closed)
    constants, carry = avals[: cycle.n_constants], avals[cycle.n_constants :]

    def back(*arrays: Any) -> list[Any]:
        fixed, now, cotangents = parted(arrays, len(constants), len(carry))

        def of(moved: list[Any], floats: list[Any]) -> list[Any]:
            made = cycle(filled(fixed, moving, moved), filled(now, floating, floats))
            return chosen(made, floating)

        _, transpose = jax.vjp(of, chosen(fixed, moving), chosen(now, floating))
        sums, earlier = transpose(list(cotangents))
        return [*earlier, *sums]

    given = [*constants, *carry, *chosen(cycle.avals, floating)]
    return jax.make_jaxpr(back)(*map(varying_shape, given))


def parted(arrays: Sequence[Any], *sizes: int) -> list[Sequence[Any]]:
    """Cut into parts of these sizes, and the rest."""
    parts, begin = [], 0
    for size in sizes:
        parts.append(arrays[begin : begin + size])
        begin += size
    return [*parts, arrays[begin:]]


def chosen(things: Sequence[Any], flags: Sequence[bool]) -> list[Any]:
    """Those that have the flag."""
    return [thing for thing, flag in zip(things, flags, strict=True) if flag]


def filled(
    things: Sequence[Any], flags: Sequence[bool], chosen: Sequence[Any]
) -> list[Any]:
    """With chosen ones in place of those that have the flag."""
    rest = iter(chosen)
    return [
        next(rest) if flag else thing for thing, flag in zip(things, flags, strict=True)
    ]
