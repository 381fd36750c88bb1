r"""Numbers of an effect that depend on time, and a clock that stays exact.

A `Schedule` may stand in any field of an effect where a number or an array would. At
every step it is replaced by its value, so that hooks see plain numbers. Scenes without
a schedule have no clock, and their programs do not change.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array

Tree = TypeVar("Tree")

_DIGIT = 10
"""Bits per digit of the step count."""
_COARSE = 4096
"""Parts of a turn. Products of their number with a digit are exact in float32."""


@pytree
class Clock:
    """Time as a count of steps, so that it loses no digits in long runs."""

    step: Int[Array, ""]
    """Number of whole steps since time zero."""
    fraction: Float[Array, ""]
    """Fraction of a step passed since then [1]."""
    dt: Float[Array, ""]
    """Step size [s]."""

    @property
    def time(self) -> Float[Array, ""]:
        """Time [s], rounded; use `phase` for a period that repeats many times."""
        return (self.step.astype(self.dt.dtype) + self.fraction) * self.dt

    def phase(self, period: Array) -> Float[Array, "..."]:
        """Fraction of the current period that has passed, from 0 to 1 [1].

        The error is a few round-offs, however many periods have passed. The step count
        is taken digit by digit, and the periods per step to twice the precision.

        Args:
            period: The period [s].
        """
        period = jnp.asarray(period, self.dt.dtype)
        turns, rest = _quotient(self.dt, period)
        total = self.fraction * turns
        count = self.step
        for digit in range(0, 31, _DIGIT):
            part = ((count >> digit) & (2**_DIGIT - 1)).astype(turns.dtype)
            size = turns * 2.0**digit
            size = size - jnp.floor(size)
            # `coarse` has so few bits that its product with a digit is exact.
            coarse = jnp.floor(size * _COARSE) / _COARSE
            whole = part * coarse
            rounded = part * (size - coarse) + part * (rest * 2.0**digit)
            total = total + (whole - jnp.floor(whole)) + rounded
        return total - jnp.floor(total)

    def later(self, fraction: ArrayLike) -> Clock:
        """Clock advanced by a fraction of a step."""
        return replace(self, fraction=self.fraction + fraction)


def clock_at(time: ArrayLike | Clock, dtype: Any) -> Clock:
    """A clock that shows a time [s]; one that is given stays as it is."""
    if isinstance(time, Clock):
        return time
    seconds = as_array("time", time, "s", dtype=dtype)
    return Clock(jnp.zeros((), jnp.int32), seconds, jnp.ones_like(seconds))


def _quotient(a: Array, b: Array) -> tuple[Array, Array]:
    """Quotient of two numbers and its rounding error."""
    quotient = a / b
    high, low = _product(quotient, b)
    return quotient, ((a - high) - low) / b


def _product(a: Array, b: Array) -> tuple[Array, Array]:
    """Product of two numbers and its rounding error (Dekker, 1971)."""
    splitter = 2.0 ** ((jnp.finfo(a.dtype).nmant + 2) // 2) + 1

    def halves(x: Array) -> tuple[Array, Array]:
        spread = splitter * x
        high = spread - (spread - x)
        return high, x - high

    product = a * b
    (a1, a2), (b1, b2) = halves(a), halves(b)
    return product, ((a1 * b1 - product) + a1 * b2 + a2 * b1) + a2 * b2


class Schedule(ABC):
    """Base of numbers that depend on time; a subclass is a pytree.

    Stability bounds and checks of planes and axes use `largest`: it must be at least
    as large as any value, component by component.
    """

    @abstractmethod
    def __call__(self, clock: Clock) -> Any:
        """The value at a time."""

    @property
    @abstractmethod
    def largest(self) -> Any:
        """Bound on the size of every component at all times, of the same shape."""

    @property
    def largest_norm(self) -> Any:
        """Bound on the Euclidean norm of all components at all times.

        It does not depend on the axes if a subclass computes it from its values.
        """
        return norm(self.largest)


@pytree
class VectorInSpace(Schedule):
    """A schedule of vectors whose bounds need only their norm, e.g. a field in space.

    Its `largest` has the largest norm of the values, and is nonzero in every component
    in which any value is. Bounds are therefore the same if everything is rotated, and
    checks of planes see the values that may leave the plane.
    """

    schedule: Any
    """The schedule of the values."""

    def __call__(self, clock: Clock) -> Any:
        """The value at a time."""
        return self.schedule(clock)

    @property
    def largest(self) -> Any:
        """Largest absolute value of each component, scaled to the largest norm."""
        largest = self.schedule.largest
        long = norm(largest)
        nothing = long == 0
        return largest * (self.largest_norm / jnp.where(nothing, 1, long))

    @property
    def largest_norm(self) -> Any:
        """The largest norm of the schedule's vectors."""
        return self.schedule.largest_norm


def norm(values: Array, *, each: bool = False) -> Array:
    """Square root of the sum of squares.

    Args:
        values: The numbers.
        each: Whether to sum over all axes except the first.
    """
    axes = tuple(range(1, jnp.ndim(values))) if each else None
    squares = jnp.sum(values * values, axis=axes)
    nothing = squares == 0
    return jnp.where(nothing, 0, jnp.sqrt(jnp.where(nothing, 1, squares)))


Timed = Numbers | Schedule
"""A number, a vector or an array of numbers, or a schedule of them."""


def is_schedule(value: Any) -> bool:
    """Whether a value depends on time."""
    return isinstance(value, Schedule)


def depends_on_time(tree: Any) -> bool:
    """Whether there is a schedule anywhere in a pytree."""
    return any(map(is_schedule, jax.tree.leaves(tree, is_leaf=is_schedule)))


def at_clock(tree: Tree, clock: Clock) -> Tree:
    """The tree with every schedule replaced by its value."""
    return _replaced(tree, lambda schedule: schedule(clock))


def at_largest(tree: Tree) -> Tree:
    """The tree with every schedule replaced by the bound on its size."""
    return _replaced(tree, lambda schedule: schedule.largest)


def _replaced(tree: Tree, value: Callable[[Schedule], Any]) -> Tree:
    return jax.tree.map(
        lambda leaf: value(leaf) if is_schedule(leaf) else leaf,
        tree,
        is_leaf=is_schedule,
    )


def as_timed_vector(
    name: str, value: Timed, unit: str, *shapes: tuple[int, ...], **limits: Any
) -> Any:
    """Checks an argument that may depend on time and whose bounds need only its norm.

    See `as_timed` for the arguments.
    """
    checked = as_timed(name, value, unit, *shapes, **limits)
    return VectorInSpace(checked) if is_schedule(checked) else checked


def as_timed(
    name: str, value: Timed, unit: str, *shapes: tuple[int, ...], **limits: Any
) -> Any:
    """Checks an argument that may depend on time.

    Args:
        name: The argument's name, for the message.
        value: The value given for it.
        unit: SI unit, for the message.
        *shapes: Shapes that the value may have.
        **limits: Limits as in `as_array`; for values that do not depend on time.

    Raises:
        ValueError: If the value does not fit; the message names the argument.
    """
    if not isinstance(value, Schedule):
        return as_array(name, value, unit, shapes, **limits)
    kind = jnp.result_type(float)
    now = Clock(jnp.zeros((), np.int32), jnp.zeros((), kind), jnp.zeros((), kind))
    found = jax.eval_shape(value, now)
    if getattr(found, "shape", None) not in shapes:
        allowed = " or ".join(map(str, shapes))
        raise ValueError(
            f"{name} must have values of shape {allowed}, got a {type(value).__name__} "
            f"of shape {getattr(found, 'shape', None)}"
        )
    return value
