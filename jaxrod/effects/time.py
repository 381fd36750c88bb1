r"""Effect parameters that depend on time, and a clock that stays exact.

Any number or array in a field of an effect may be replaced by a `Schedule`. At every
step the schedule is replaced by its value, so that hooks see plain numbers. Scenes
without a schedule have no clock, so schedules cost them nothing.
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
from jaxrod.validation import Numbers, as_array, is_traced, numeric

Tree = TypeVar("Tree")

_DIGIT = 10
"""Bits per digit of the step count, which `Clock.phase` splits into digits."""
_COARSE = 4096
"""Parts of a period to which fractions are rounded. They are few enough that a number
of parts times a digit is exact in float32."""


@pytree
class Clock:
    """Time as a count of steps, so that it loses no digits in long runs.

    Example:
        >>> dt = jnp.float32(1 / 1024)
        >>> clock = schedules.Clock(jnp.int32(512), jnp.float32(0.0), dt)
        >>> float(clock.time), float(clock.later(1024).time)
        (0.5, 1.5)
        >>> late = replace(clock, step=jnp.int32(2_048_000_512))  # after 23 days
        >>> float(late.phase(jnp.float32(2.0)))
        0.25
    """

    step: Int[Array, ""]
    """Number of whole steps since time zero."""
    fraction: Float[Array, ""]
    """Time since the end of the last whole step, in steps; may be above 1 [1]."""
    dt: Float[Array, ""]
    """Step size [s]."""

    @property
    def time(self) -> Float[Array, ""]:
        """Time [s], rounded; use `phase` for a period that repeats many times."""
        return (self.step.astype(self.dt.dtype) + self.fraction) * self.dt

    def phase(self, period: Array) -> Float[Array, "..."]:
        """Fraction of the current period that has passed at this time, from 0 to 1 [1].

        The error is a few round-offs, however many periods have passed. The step count
        is processed digit by digit, and the number of periods per step is computed to
        twice the precision.

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
        """Clock advanced by `fraction` steps."""
        return replace(self, fraction=self.fraction + fraction)


def clock_at(time: ArrayLike | Clock, dtype: Any) -> Clock:
    """Clock that shows a given time [s]; a given clock is returned unchanged."""
    if isinstance(time, Clock):
        return time
    seconds = as_array("time", time, "s", dtype=dtype)
    return Clock(jnp.zeros((), jnp.int32), seconds, jnp.ones_like(seconds))


def _quotient(a: Array, b: Array) -> tuple[Array, Array]:
    """Quotient `a / b` and the rounding error that must be added to it."""
    quotient = a / b
    high, low = _product(quotient, b)
    return quotient, ((a - high) - low) / b


def _product(a: Array, b: Array) -> tuple[Array, Array]:
    """Product `a b` and the rounding error that must be added to it (Dekker, 1971)."""
    splitter = 2.0 ** ((jnp.finfo(a.dtype).nmant + 2) // 2) + 1

    def halves(x: Array) -> tuple[Array, Array]:
        spread = splitter * x
        high = spread - (spread - x)
        return high, x - high

    product = a * b
    (a1, a2), (b1, b2) = halves(a), halves(b)
    return product, ((a1 * b1 - product) + a1 * b2 + a2 * b1) + a2 * b2


class Schedule(ABC):
    """Base class of numbers that depend on time; a subclass is a pytree.

    Stability bounds, and checks that motion stays in a plane, use `largest`. Every
    component of it must be at least as large as the absolute value of that component at
    any time.

    Example:
        >>> @extend.pytree
        ... class Pulse(schedules.Schedule):
        ...     size: jax.Array
        ...     end: jax.Array  # [s]
        ...
        ...     def __call__(self, clock):
        ...         return jnp.where(clock.time < self.end, self.size, 0.0)
        ...
        ...     @property
        ...     def largest(self):
        ...         return jnp.abs(self.size)
        >>> pull = jaxrod.end_load(Pulse(jnp.array([2.0, 0.0, 0.0]), 0.1))
        >>> scene = jaxrod.make_scene(rod, pull)
        >>> [scene.at(t).effects[0].force.tolist() for t in (0.0, 0.2)]
        [[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """

    @abstractmethod
    def __call__(self, clock: Clock) -> Any:
        """Value of the schedule at the time of a clock."""

    @property
    @abstractmethod
    def largest(self) -> Any:
        """Upper bound of the absolute value of each component at all times."""

    @property
    def largest_norm(self) -> Any:
        """Upper bound of the Euclidean norm of the value at all times.

        By default it is the norm of `largest`, which depends on the axes. A subclass
        may compute it from its own values, so that it does not depend on the axes.
        """
        return norm(self.largest)

    def resampled_along(self, old: Any, new: Any) -> Schedule:
        """Schedule interpolated at other arc lengths, for values that vary along a rod.

        Args:
            old: Arc lengths of the present values [m].
            new: Arc lengths of the new values [m].

        Raises:
            ValueError: If it cannot be resampled; a subclass may override this.
        """
        raise ValueError(
            "a schedule of numbers along a rod cannot be resampled to another number "
            "of elements"
        )


@pytree
class VectorInSpace(Schedule):
    """A schedule of vectors of which bounds need only the norm, e.g. a magnetic field.

    `largest` is scaled so that its norm is the largest norm of the values. Bounds are
    therefore unchanged if everything is rotated. A component of `largest` is zero only
    if that component of the values is zero at all times. Checks that motion stays in a
    plane rely on this.
    """

    schedule: Any
    """Schedule of the vectors."""

    def __call__(self, clock: Clock) -> Any:
        """Vector at the time of a clock."""
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
    """Square root of the sum of squares, with gradient zero where it is zero.

    Args:
        values: The numbers.
        each: Whether to sum over all axes except the first.
    """
    axes = tuple(range(1, jnp.ndim(values))) if each else None
    squares = jnp.sum(values * values, axis=axes)
    nothing = squares == 0
    return jnp.where(nothing, 0, jnp.sqrt(jnp.where(nothing, 1, squares)))


Scheduled = Any
"""Field of an effect that is a schedule or numbers in a scene, and numbers in hooks."""
Timed = Numbers | Schedule
"""A number, a vector or an array of numbers, or a schedule of them."""


def is_schedule(value: Any) -> bool:
    """Whether a value is a schedule, so that it depends on time."""
    return isinstance(value, Schedule)


def depends_on_time(tree: Any) -> bool:
    """Whether there is a schedule anywhere in a pytree."""
    return any(map(is_schedule, jax.tree.leaves(tree, is_leaf=is_schedule)))


def at_clock(tree: Tree, clock: Clock) -> Tree:
    """Pytree with every schedule replaced by its value at the time of a clock."""
    # Compiled, because a schedule takes many operations. Where something is traced,
    # `jit` would hide the numbers that are known.
    value = _called if is_traced(tree, clock) else jax.jit(_called)
    return _replaced(tree, lambda schedule: value(schedule, clock))


def _called(schedule: Schedule, clock: Clock) -> Any:
    return schedule(clock)


def at_largest(tree: Tree) -> Tree:
    """Pytree with every schedule replaced by its bound `Schedule.largest`."""
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
    """Validates a vector that may be a schedule and returns an array or a schedule.

    It is for vectors of which stability bounds need only the norm: a schedule becomes a
    `VectorInSpace`. The arguments are those of `as_timed`.
    """
    checked = as_timed(name, value, unit, *shapes, **limits)
    return VectorInSpace(checked) if is_schedule(checked) else checked


def as_timed(
    name: str, value: Timed, unit: str, *shapes: tuple[int, ...], **limits: Any
) -> Any:
    """Validates an argument that may be a schedule; returns an array or the schedule.

    Args:
        name: The argument's name, for the message.
        value: The argument's value.
        unit: SI unit, for the message.
        *shapes: Shapes that the value may have.
        **limits: Limits as in `as_array`; applied to constant values only.

    Raises:
        ValueError: If the value does not fit; the message names the argument.
    """
    if not isinstance(value, Schedule):
        if callable(value):
            raise ValueError(
                f"{name} must be real numbers{f' in {unit}' if unit else ''} or a "
                f"schedule of them, got {value!r:.80}: jaxrod.schedules has ramp, sine "
                "and table, and Schedule for a function of your own"
            )
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


@pytree
class Ramp(Schedule):
    """Linear change from one value to another, constant before and after.

    Example:
        >>> pull = schedules.ramp((0.0, 0.0, 0.0), (4.0, 0.0, 0.0), duration=2.0)
        >>> scene = jaxrod.make_scene(rod, jaxrod.end_load(pull))
        >>> [float(scene.at(t).effects[0].force[0]) for t in (0.0, 1.0, 9.0)]
        [0.0, 2.0, 4.0]
    """

    first: Float[Array, "..."]
    """Value before the change."""
    last: Float[Array, "..."]
    """Value after the change."""
    start: Float[Array, ""]
    """Time at which the change begins [s]."""
    duration: Float[Array, ""]
    """Duration of the change [s]."""

    def __call__(self, clock: Clock) -> Array:
        """Value at the time of a clock."""
        part = jnp.clip((clock.time - self.start) / self.duration, 0, 1)
        return self.first + part * (self.last - self.first)

    @property
    def largest(self) -> Array:
        """Larger absolute value of `first` and `last`, component by component."""
        return jnp.maximum(jnp.abs(self.first), jnp.abs(self.last))

    @property
    def largest_norm(self) -> Array:
        """Larger norm of `first` and `last`."""
        return jnp.maximum(norm(self.first), norm(self.last))


@pytree
class Sine(Schedule):
    r"""Sine $a + b \sin 2\pi (t/T + \varphi)$.

    Example:
        >>> shake = schedules.sine((0.0, 0.0, 2.0), period=4.0)
        >>> scene = jaxrod.make_scene(rod, jaxrod.gravity(shake))
        >>> scene.at(1.0).effects[0].acceleration.tolist()
        [0.0, 0.0, 2.0]
        >>> shake.largest.tolist()  # for stability bounds
        [0.0, 0.0, 2.0]
    """

    mean: Float[Array, "..."]
    """Mean $a$."""
    amplitude: Float[Array, "..."]
    """Amplitude $b$."""
    period: Float[Array, ""]
    """Period $T$ [s]."""
    phase: Float[Array, ""]
    r"""Phase $\varphi$, in periods [1]."""

    def __call__(self, clock: Clock) -> Array:
        """Value at the time of a clock, accurate after any number of periods."""
        angle = 2 * jnp.pi * (clock.phase(self.period) + self.phase)
        return self.mean + self.amplitude * jnp.sin(angle)

    @property
    def largest(self) -> Array:
        """Bound `|a| + |b|` of each component."""
        return jnp.abs(self.mean) + jnp.abs(self.amplitude)

    @property
    def largest_norm(self) -> Array:
        """Larger norm of mean plus amplitude and mean minus amplitude."""
        up, down = self.mean + self.amplitude, self.mean - self.amplitude
        return jnp.maximum(norm(up), norm(down))


@pytree
class Table(Schedule):
    """Values at given times, linear in between, constant before and after.

    Example:
        >>> pull = schedules.table([0.0, 1.0, 3.0], [0.0, 2.0, 4.0])
        >>> tendon = actuation.tendon(rod, (0.01, 0.0), tension=pull)
        >>> scene = jaxrod.make_scene(rod, tendon)
        >>> [float(scene.at(t).effects[0].tension) for t in (0.5, 2.0, 9.0)]
        [1.0, 3.0, 4.0]
    """

    times: Float[Array, " k"]
    """Times of the values, increasing [s]."""
    values: Float[Array, "k ..."]
    """One value for each time."""

    def __call__(self, clock: Clock) -> Array:
        """Value at the time of a clock, by linear interpolation."""
        t = clock.time
        last = self.times.shape[0] - 1
        index = jnp.clip(jnp.sum(self.times <= t) - 1, 0, last - 1)
        before, after = self.times[index], self.times[index + 1]
        part = jnp.clip((t - before) / (after - before), 0, 1)
        return self.values[index] + part * (self.values[index + 1] - self.values[index])

    @property
    def largest(self) -> Array:
        """Largest absolute value of each component in the table."""
        return jnp.max(jnp.abs(self.values), axis=0)

    @property
    def largest_norm(self) -> Array:
        """Largest norm of the values in the table."""
        return jnp.max(norm(self.values, each=True))


@pytree
class Time(Schedule):
    """Time itself [s], for an effect that evaluates its own formula."""

    def __call__(self, clock: Clock) -> Array:
        """Time that a clock shows [s]."""
        return clock.time

    @property
    def largest(self) -> Array:
        """An arbitrary time other than zero, for checks of planar motion [s].

        It is not a bound: time has none.
        """
        return jnp.asarray(0.739)


def ramp(
    first: Numbers, last: Numbers, duration: Numbers, *, start: Numbers = 0.0
) -> Ramp:
    """Linear change from one value to another, constant before and after.

    Args:
        first: Value before the change, in the unit of the scheduled number.
        last: Value after the change, of the same shape.
        duration: Duration of the change, above 0 [s].
        start: Time at which the change begins [s].

    Raises:
        ValueError: If an argument is out of range or the shapes differ.

    Example:
        >>> pull = schedules.ramp(0.0, 4.0, duration=2.0)
        >>> tendon = actuation.tendon(rod, (0.01, 0.0), tension=pull)
        >>> scene = jaxrod.make_scene(rod, tendon)
        >>> [float(scene.at(t).effects[0].tension) for t in (0.0, 1.0, 9.0)]
        [0.0, 2.0, 4.0]
    """
    one, other = _value("first", first), _value("last", last)
    _check_alike("first", one, "last", other)
    return Ramp(
        first=one,
        last=other,
        start=as_array("start", start, "s"),
        duration=as_array("duration", duration, "s", positive=True),
    )


def sine(
    amplitude: Numbers,
    period: Numbers,
    *,
    mean: Numbers | None = None,
    phase: Numbers = 0.0,
) -> Sine:
    """Sine about a mean value.

    Args:
        amplitude: Amplitude, in the unit of the scheduled number.
        period: Period, above 0 [s].
        mean: Mean, of the same shape as the amplitude; zero by default.
        phase: Phase at time zero, in periods: 0.25 makes it a cosine.

    Raises:
        ValueError: If an argument is out of range or the shapes differ.

    Example:
        >>> shake = schedules.sine((0.0, 0.0, 2.0), period=4.0, mean=(0.0, 0.0, -10.0))
        >>> scene = jaxrod.make_scene(rod, jaxrod.gravity(shake))
        >>> [float(scene.at(t).effects[0].acceleration[2]) for t in (0.0, 1.0)]
        [-10.0, -8.0]
    """
    size = _value("amplitude", amplitude)
    middle = jnp.zeros_like(size) if mean is None else _value("mean", mean)
    _check_alike("amplitude", size, "mean", middle)
    return Sine(
        mean=middle,
        amplitude=size,
        period=as_array("period", period, "s", positive=True),
        phase=as_array("phase", phase, ""),
    )


def table(times: Numbers, values: Numbers) -> Table:
    """Values at given times, linear in between, constant before and after.

    Args:
        times: Times, at least two, increasing `(k,)` [s].
        values: One value for each time `(k, ...)`, in the unit of the scheduled number.

    Raises:
        ValueError: If the times do not increase, or the number of values differs.

    Example:
        >>> moments = [0.0, 1.0, 3.0]
        >>> pulls = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]  # [N]
        >>> load = jaxrod.end_load(schedules.table(moments, pulls))
        >>> scene = jaxrod.make_scene(rod, load)
        >>> [scene.at(t).effects[0].force.tolist() for t in (0.5, 2.0)]
        [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    given = numeric("times", times, "s")
    if given.ndim != 1 or given.shape[0] < 2:
        raise ValueError(f"times must be at least two, got shape {given.shape}")
    if not is_traced(given) and not np.all(np.diff(given) > 0):
        raise ValueError("times must increase")
    rows = _value("values", values)
    if rows.shape[:1] != given.shape:
        raise ValueError(
            f"values must have one entry for each of {given.shape[0]} times, got shape "
            f"{rows.shape}"
        )
    return Table(as_array("times", times, "s", [given.shape]), rows)


def time() -> Time:
    """Time itself [s], for a field of an effect that you write.

    Time has no bound: the effect's `stability_bound` must hold at all times without it.

    Example:
        >>> @extend.pytree
        ... class Chirp(extend.Effect):
        ...     now: extend.Leaf  # [s]
        ...
        ...     def loads(self, rod, motion):
        ...         z = jnp.full_like(motion.position[2], jnp.sin(self.now**2))
        ...         return extend.Loads(forces=(0 * z, 0 * z, z))
        >>> scene = jaxrod.make_scene(rod, Chirp(schedules.time()))
        >>> float(scene.at(2.5).effects[0].now)
        2.5
    """
    return Time()


def _value(name: str, value: Numbers) -> Array:
    """Validates a number or an array of any shape and returns it as an array."""
    return as_array(name, value, "", [numeric(name, value).shape])


def _check_alike(name: str, one: Array, other_name: str, other: Array) -> None:
    if one.shape != other.shape:
        raise ValueError(
            f"{name} and {other_name} must have the same shape, got {one.shape} and "
            f"{other.shape}"
        )
