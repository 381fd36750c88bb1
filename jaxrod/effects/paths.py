r"""Paths: schedules of places and orientations, with their rates.

A driven end needs the velocity and the acceleration of its path: they are derivatives
of the schedule, by JAX.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.time import Clock, Schedule, as_timed, is_schedule
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    join_quaternion,
    multiply_quaternions,
    split_quaternion,
)
from jaxrod.structure import pytree


@pytree
class Placed:
    """A position with its velocity and acceleration."""

    position: Float[Array, "3"]
    """Position, world frame [m]."""
    velocity: Float[Array, "3"]
    """Velocity, world frame [m/s]."""
    acceleration: Float[Array, "3"]
    """Acceleration, world frame [m/s^2]."""


@pytree
class Path(Schedule):
    """Positions along a path, from a schedule of displacements."""

    start: Float[Array, "3"]
    """Position at zero displacement [m]."""
    displacement: Any
    """Schedule of displacements from there `(3,)` [m]."""

    def __call__(self, clock: Clock) -> Placed:
        """Position, velocity and acceleration at a time."""

        def place(clock: Clock) -> Array:
            return self.start + self.displacement(clock)

        def rate(clock: Clock) -> Array:
            return _rate(place, clock)[1]

        position, velocity = _rate(place, clock)
        return Placed(position, velocity, _rate(rate, clock)[1])

    @property
    def largest(self) -> Placed:
        """Position with the largest displacement along every axis, at rest."""
        still = jnp.zeros_like(self.start)
        return Placed(self.start + self.displacement.largest, still, still)


@pytree
class Turned:
    """An orientation with its angular velocity and acceleration."""

    orientation: Float[Array, "4"]
    """Unit quaternion (w, x, y, z), material to world."""
    angular_velocity: Float[Array, "3"]
    """Angular velocity, world frame [rad/s]."""
    angular_acceleration: Float[Array, "3"]
    """Angular acceleration, world frame [rad/s^2]."""


@pytree
class Turning(Schedule):
    """Orientations that turn about a fixed axis."""

    start: Float[Array, "4"]
    """Orientation at angle zero (w, x, y, z)."""
    axis: Float[Array, "3"]
    """Unit vector along the axis, world frame."""
    angle: Any
    """Schedule of the angle [rad]."""

    def __call__(self, clock: Clock) -> Turned:
        """Orientation, angular velocity and acceleration at a time."""

        def rate_at(clock: Clock) -> Array:
            return _rate(self.angle, clock)[1]

        angle, rate = _rate(self.angle, clock)
        faster = _rate(rate_at, clock)[1]
        return Turned(self._turned(angle), rate * self.axis, faster * self.axis)

    @property
    def largest(self) -> Turned:
        """Orientation at an arbitrary angle if it turns: whole turns would not show."""
        largest = self.angle.largest
        angle = jnp.where(largest == 0, 0, jnp.asarray(0.739, largest.dtype))
        still = jnp.zeros_like(self.axis)
        return Turned(self._turned(angle), still, still)

    def _turned(self, angle: Array) -> Array:
        # Not `rotation_exp`, which allows one turn at most: walls may wind rods up
        # further.
        half = 0.5 * angle
        x, y, z = vectors.scale(jnp.sin(half), vectors.split(self.axis))
        start = split_quaternion(self.start)
        return join_quaternion(multiply_quaternions((jnp.cos(half), x, y, z), start))


@pytree
class _Constant(Schedule):
    """A schedule with a constant value."""

    value: Array

    def __call__(self, clock: Any) -> Array:
        return self.value

    @property
    def largest(self) -> Array:
        return jnp.abs(self.value)


def schedule_of(name: str, value: Any, unit: str, shape: tuple[int, ...]) -> Schedule:
    """Schedule, or a constant as a schedule; checked as in `as_timed`."""
    checked = as_timed(name, value, unit, shape)
    return checked if is_schedule(checked) else _Constant(checked)


def _rate(schedule: Any, clock: Clock) -> tuple[Any, Any]:
    """Value of a schedule and its time derivative."""

    def at(fraction: Array) -> Any:
        return schedule(replace(clock, fraction=fraction))

    value, change = jax.jvp(at, (clock.fraction,), (1 / clock.dt,))
    return value, change
