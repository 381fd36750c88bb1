"""Schedules: ramps, sines and tables, for any number of an effect."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.time import Clock, Schedule, norm
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, is_traced, numeric


@pytree
class Ramp(Schedule):
    """Linear change from one value to another, constant before and after."""

    first: Float[Array, "..."]
    """Value up to the start."""
    last: Float[Array, "..."]
    """Value from the end on."""
    start: Float[Array, ""]
    """Time at which the change begins [s]."""
    duration: Float[Array, ""]
    """Duration of the change [s]."""

    def __call__(self, clock: Clock) -> Array:
        """The value at a time."""
        part = jnp.clip((clock.time - self.start) / self.duration, 0, 1)
        return self.first + part * (self.last - self.first)

    @property
    def largest(self) -> Array:
        """Larger absolute value of the two, component by component."""
        return jnp.maximum(jnp.abs(self.first), jnp.abs(self.last))

    @property
    def largest_norm(self) -> Array:
        """Norm of the longer value."""
        return jnp.maximum(norm(self.first), norm(self.last))


@pytree
class Sine(Schedule):
    r"""Sine $a + b \sin 2\pi (t/T + \varphi)$."""

    mean: Float[Array, "..."]
    """Mean $a$."""
    amplitude: Float[Array, "..."]
    """Amplitude $b$."""
    period: Float[Array, ""]
    """Period $T$ [s]."""
    phase: Float[Array, ""]
    r"""Phase $\varphi$, in periods [1]."""

    def __call__(self, clock: Clock) -> Array:
        """The value at the clock's time; accurate after any number of periods."""
        angle = 2 * jnp.pi * (clock.phase(self.period) + self.phase)
        return self.mean + self.amplitude * jnp.sin(angle)

    @property
    def largest(self) -> Array:
        """Sum of the absolute values of mean and amplitude."""
        return jnp.abs(self.mean) + jnp.abs(self.amplitude)

    @property
    def largest_norm(self) -> Array:
        """Larger norm of mean plus amplitude and mean minus amplitude."""
        up, down = self.mean + self.amplitude, self.mean - self.amplitude
        return jnp.maximum(norm(up), norm(down))


@pytree
class Table(Schedule):
    """Values at given times, linear in between, constant before and after."""

    times: Float[Array, " k"]
    """Times, increasing [s]."""
    values: Float[Array, "k ..."]
    """One value for each time."""

    def __call__(self, clock: Clock) -> Array:
        """The value at a time."""
        t = clock.time
        last = self.times.shape[0] - 1
        index = jnp.clip(jnp.searchsorted(self.times, t, side="right") - 1, 0, last - 1)
        before, after = self.times[index], self.times[index + 1]
        part = jnp.clip((t - before) / (after - before), 0, 1)
        return self.values[index] + part * (self.values[index + 1] - self.values[index])

    @property
    def largest(self) -> Array:
        """Largest absolute value of each component."""
        return jnp.max(jnp.abs(self.values), axis=0)

    @property
    def largest_norm(self) -> Array:
        """Norm of the longest value."""
        return jnp.max(norm(self.values, each=True))


@pytree
class Time(Schedule):
    """Time itself [s], for an effect with a formula of its own."""

    def __call__(self, clock: Clock) -> Array:
        """The time [s]."""
        return clock.time

    @property
    def largest(self) -> Array:
        """An arbitrary time, for checks of planes: time has no bound [s]."""
        return jnp.asarray(0.739)


def ramp(
    first: Numbers, last: Numbers, duration: Numbers, *, start: Numbers = 0.0
) -> Ramp:
    """Linear change from one value to another, constant before and after.

    Args:
        first: Value up to the start, in the unit of the scheduled number.
        last: Value from the end on, of the same shape.
        duration: Duration of the change, above 0 [s].
        start: Time at which the change begins [s].

    Raises:
        ValueError: If an argument is out of range or the shapes differ.
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
    """A sine about a mean.

    Args:
        amplitude: Amplitude, in the unit of the scheduled number.
        period: Period, above 0 [s].
        mean: Mean, of the same shape as the amplitude; zero by default.
        phase: Phase at time zero, in periods: 0.25 makes it a cosine.

    Raises:
        ValueError: If an argument is out of range or the shapes differ.
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
    """
    given = numeric("times", times, "s")
    if given.ndim != 1 or given.shape[0] < 2:
        raise ValueError(f"times must be two or more, got shape {given.shape}")
    if not is_traced(given) and not np.all(np.diff(given) > 0):
        raise ValueError("times must rise from each to the next")
    rows = _value("values", values)
    if rows.shape[:1] != given.shape:
        raise ValueError(
            f"values must be as many as times, {given.shape[0]}, got shape {rows.shape}"
        )
    return Table(as_array("times", times, "s", [given.shape]), rows)


def time() -> Time:
    """Time itself [s], for a field of an effect that you write.

    Time has no bound: the effect's `stability_bound` must hold at all times without it.
    """
    return Time()


def _value(name: str, value: Numbers) -> Array:
    """Checks a number or an array of numbers of any shape."""
    return as_array(name, value, "", [numeric(name, value).shape])


def _check_alike(name: str, one: Array, other_name: str, other: Array) -> None:
    if one.shape != other.shape:
        raise ValueError(
            f"{name} and {other_name} must have one shape, got {one.shape} and "
            f"{other.shape}"
        )
