"""Schedules: ramps, sines and tables, for wherever an effect takes a number."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.time import Clock, Schedule, norm
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, is_traced, numeric


@pytree
class Ramp(Schedule):
    """From one value to another in a straight line, and constant before and after."""

    first: Float[Array, "..."]
    """Value up to the start."""
    last: Float[Array, "..."]
    """Value from the end on."""
    start: Float[Array, ""]
    """When it leaves the first value [s]."""
    duration: Float[Array, ""]
    """How long it takes [s]."""

    def __call__(self, clock: Clock) -> Array:
        """The value at a time."""
        part = jnp.clip((clock.time - self.start) / self.duration, 0, 1)
        return self.first + part * (self.last - self.first)

    @property
    def largest(self) -> Array:
        """The larger of both values."""
        return jnp.maximum(jnp.abs(self.first), jnp.abs(self.last))

    @property
    def largest_norm(self) -> Array:
        """The longer of both values."""
        return jnp.maximum(norm(self.first), norm(self.last))


@pytree
class Sine(Schedule):
    r"""$a + b \sin 2\pi (t/T + \varphi)$."""

    mean: Float[Array, "..."]
    """$a$."""
    amplitude: Float[Array, "..."]
    """$b$."""
    period: Float[Array, ""]
    """$T$ [s]."""
    phase: Float[Array, ""]
    r"""$\varphi$, in periods [1]."""

    def __call__(self, clock: Clock) -> Array:
        """The value at a time, as exact after a million periods as in the first."""
        angle = 2 * jnp.pi * (clock.phase(self.period) + self.phase)
        return self.mean + self.amplitude * jnp.sin(angle)

    @property
    def largest(self) -> Array:
        """Mean and amplitude together."""
        return jnp.abs(self.mean) + jnp.abs(self.amplitude)

    @property
    def largest_norm(self) -> Array:
        """The longer of mean plus and mean less amplitude."""
        up, down = self.mean + self.amplitude, self.mean - self.amplitude
        return jnp.maximum(norm(up), norm(down))


@pytree
class Table(Schedule):
    """Values at given times, straight lines between, constant before and after."""

    times: Float[Array, " k"]
    """Rising [s]."""
    values: Float[Array, "k ..."]
    """One for each."""

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
        """The largest of all values."""
        return jnp.max(jnp.abs(self.values), axis=0)

    @property
    def largest_norm(self) -> Array:
        """The longest of all values."""
        return jnp.max(norm(self.values, each=True))


@pytree
class Time(Schedule):
    """Time itself [s]: for an effect with a formula of its own."""

    def __call__(self, clock: Clock) -> Array:
        """The time [s]."""
        return clock.time

    @property
    def largest(self) -> Array:
        """Any moment, for checks of planes: time has no bound [s]."""
        return jnp.asarray(0.739)


def ramp(
    first: Numbers, last: Numbers, duration: Numbers, *, start: Numbers = 0.0
) -> Ramp:
    """A straight line from one value to another, constant before and after.

    Args:
        first: Value up to the start, in the unit of what is scheduled.
        last: Value from the end on, of the same shape.
        duration: How long it takes, above 0 [s].
        start: When it begins [s].

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
        amplitude: In the unit of what is scheduled.
        period: Above 0 [s].
        mean: Of the same shape as the amplitude; zero by default.
        phase: At time zero, in periods: 0.25 makes it a cosine.

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
    """Values at given times: straight lines between, constant before and after.

    Args:
        times: At least two, rising `(k,)` [s].
        values: One for each `(k, ...)`, in the unit of what is scheduled.

    Raises:
        ValueError: If the times do not rise, or there are not as many values.
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
    """Time itself [s], for a field of an effect of your own.

    Time has no bound: the effect's `stability_bound` must hold at all times without it.
    """
    return Time()


def _value(name: str, value: Numbers) -> Array:
    """A number or an array of numbers of any shape."""
    return as_array(name, value, "", [numeric(name, value).shape])


def _check_alike(name: str, one: Array, other_name: str, other: Array) -> None:
    if one.shape != other.shape:
        raise ValueError(
            f"{name} and {other_name} must have one shape, got {one.shape} and "
            f"{other.shape}"
        )
