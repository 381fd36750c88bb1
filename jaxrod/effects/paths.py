r"""Schedules of positions and orientations together with their time derivatives.

A driven end needs the velocity and the acceleration of its path. JAX computes both by
differentiating the schedule.
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
    """A position with its velocity and acceleration at one time."""

    position: Float[Array, "3"]
    """Position, world frame [m]."""
    velocity: Float[Array, "3"]
    """Velocity, world frame [m/s]."""
    acceleration: Float[Array, "3"]
    """Acceleration, world frame [m/s^2]."""


@pytree
class Path(Schedule):
    """Schedule of a position: a fixed point plus a scheduled displacement."""

    start: Float[Array, "3"]
    """Position at zero displacement, world frame [m]."""
    displacement: Any
    """Schedule of the displacement from `start`, world frame `(3,)` [m]."""

    def __call__(self, clock: Clock) -> Placed:
        """Position, velocity and acceleration at the time of a clock."""

        def place(clock: Clock) -> Array:
            return self.start + self.displacement(clock)

        return place_and_rates(place, clock)

    @property
    def largest(self) -> Placed:
        """Position with the largest displacement along every axis, and zero rates."""
        still = jnp.zeros_like(self.start)
        return Placed(self.start + self.displacement.largest, still, still)


@pytree
class Orbit(Schedule):
    """Schedule of a position that turns about an axis, which itself is displaced."""

    start: Float[Array, "3"]
    """Position at zero displacement and angle, world frame [m]."""
    displacement: Any
    """Schedule of the displacement of the axis, world frame `(3,)` [m]."""
    about: Float[Array, "3"]
    """Point on the axis at zero displacement, world frame [m]."""
    axis: Float[Array, "3"]
    """Unit vector along the axis of rotation, world frame."""
    angle: Any
    """Schedule of the angle of rotation [rad]."""

    def __call__(self, clock: Clock) -> Placed:
        """Position, velocity and acceleration at the time of a clock."""

        def place(clock: Clock) -> Array:
            return self._at(self.displacement(clock), self.angle(clock))

        return place_and_rates(place, clock)

    @property
    def largest(self) -> Placed:
        """Position for checks that motion stays in a plane, see `Turning.largest`."""
        angle = _telling_angle(self.angle.largest)
        still = jnp.zeros_like(self.start)
        return Placed(self._at(self.displacement.largest, angle), still, still)

    def _at(self, displacement: Array, angle: Array) -> Array:
        axis = vectors.split(self.axis)
        arm = vectors.split(self.start - self.about)
        along = vectors.scale(vectors.dot(axis, arm), axis)
        across = vectors.subtract(arm, along)
        turned = vectors.add(
            vectors.scale(jnp.cos(angle), across),
            vectors.scale(jnp.sin(angle), vectors.cross(axis, across)),
        )
        return self.about + displacement + vectors.join(vectors.add(along, turned))


@pytree
class Turned:
    """An orientation with its angular velocity and acceleration at one time."""

    orientation: Float[Array, "4"]
    """Unit quaternion (w, x, y, z), material to world."""
    angular_velocity: Float[Array, "3"]
    """Angular velocity, world frame [rad/s]."""
    angular_acceleration: Float[Array, "3"]
    """Angular acceleration, world frame [rad/s^2]."""


@pytree
class Turning(Schedule):
    """Schedule of an orientation that rotates about a fixed axis."""

    start: Float[Array, "4"]
    """Orientation at angle zero, unit quaternion (w, x, y, z), material to world."""
    axis: Float[Array, "3"]
    """Unit vector along the axis of rotation, world frame."""
    angle: Any
    """Schedule of the angle of rotation [rad]."""

    def __call__(self, clock: Clock) -> Turned:
        """Orientation, angular velocity and acceleration at the time of a clock."""

        def rate_at(clock: Clock) -> Array:
            return _rate(self.angle, clock)[1]

        angle, rate = _rate(self.angle, clock)
        faster = _rate(rate_at, clock)[1]
        return Turned(self._turned(angle), rate * self.axis, faster * self.axis)

    @property
    def largest(self) -> Turned:
        """Orientation for checks that motion stays in a plane; the rates are zero.

        The angle is zero if it is zero at all times, and otherwise arbitrary. The
        largest angle is not used, because it could be a whole turn, which looks like no
        rotation.
        """
        angle = _telling_angle(self.angle.largest)
        still = jnp.zeros_like(self.axis)
        return Turned(self._turned(angle), still, still)

    def _turned(self, angle: Array) -> Array:
        # Not `rotation_exp`, which allows one turn at most: walls may wind rods up by
        # more.
        half = 0.5 * angle
        x, y, z = vectors.scale(jnp.sin(half), vectors.split(self.axis))
        start = split_quaternion(self.start)
        return join_quaternion(multiply_quaternions((jnp.cos(half), x, y, z), start))


@pytree
class _Constant(Schedule):
    """A schedule whose value is constant."""

    value: Array

    def __call__(self, clock: Any) -> Array:
        return self.value

    @property
    def largest(self) -> Array:
        return jnp.abs(self.value)


def schedule_of(name: str, value: Any, unit: str, shape: tuple[int, ...]) -> Schedule:
    """Validates an argument and returns it as a schedule, even if it is constant."""
    checked = as_timed(name, value, unit, shape)
    return checked if is_schedule(checked) else _Constant(checked)


def _telling_angle(largest: Array) -> Array:
    """Zero if the largest angle is zero, else an angle that looks like no other."""
    return jnp.where(largest == 0, 0, jnp.asarray(0.739, largest.dtype))


def place_and_rates(place: Any, clock: Clock) -> Placed:
    """Value of a function of a clock, with its first and second time derivative."""

    def rate(clock: Clock) -> Array:
        # `_rate` returns a pair of anything.
        change: Array = _rate(place, clock)[1]
        return change

    position, velocity = _rate(place, clock)
    return Placed(position, velocity, _rate(rate, clock)[1])


def _rate(schedule: Any, clock: Clock) -> tuple[Any, Any]:
    """Value of a schedule at the time of a clock, and its time derivative."""

    def at(fraction: Array) -> Any:
        return schedule(replace(clock, fraction=fraction))

    value, change = jax.jvp(at, (clock.fraction,), (1 / clock.dt,))
    return value, change
