"""A hand that moves freely in a box, and the smooth path of a held end.

A hand has coordinates: here x, y and z of the place that it holds. Those of a catheter
are a way and two angles, and the path has them in place of x, y and z. Actions set the
velocity of each coordinate, as a share of its largest velocity. Velocities change
linearly in time over a control step, no faster than the acceleration allows. The hand
brakes in time, so that no coordinate leaves its range.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.paths import Placed
from jaxrod.effects.time import Clock, Schedule
from jaxrod.structure import pytree


@pytree
class Hand:
    """Range, velocity and acceleration of the coordinates of a hand."""

    lower: Float[Array, " coordinates"]
    """Smallest value of each coordinate [m]."""
    upper: Float[Array, " coordinates"]
    """Largest value of each coordinate [m]."""
    speed: Float[Array, " coordinates"]
    """Largest velocity of each coordinate, either way [m/s]."""
    acceleration: Float[Array, " coordinates"]
    """Largest acceleration of each coordinate, either way [m/s^2]."""

    def place(self, coordinates: Float[Array, " coordinates"]) -> Float[Array, "3"]:
        """Position of the held end, world frame [m]."""
        return coordinates

    def reaching(self, point: Float[Array, "3"]) -> Float[Array, " coordinates"]:
        """Coordinates, within their ranges, that hold the end at or near a point.

        Args:
            point: Position, world frame [m].
        """
        return jnp.clip(point, self.lower, self.upper)

    def moved(
        self,
        coordinates: Float[Array, " coordinates"],
        velocity: Float[Array, " coordinates"],
        action: Float[Array, " coordinates"],
        period: Array,
    ) -> tuple[Float[Array, " coordinates"], Float[Array, " coordinates"]]:
        r"""Returns coordinates and velocities after a control step.

        The velocity $v'$ after the step is the commanded one, at most $aT$ away from
        $v$. It also leaves room to brake: with the distance $d$ from the end of the
        range ahead, $d - (v + v')T/2 \geq v'^2/2a$. Braking at $a$ never violates this,
        so the acceleration is never exceeded.

        Args:
            coordinates: Coordinates before the step.
            velocity: Their velocities before the step.
            action: Commanded velocities as shares of the largest; clipped to [-1, 1].
            period: Duration T of the step [s].
        """
        change = self.acceleration * period
        wanted = self.speed * jnp.clip(action, -1, 1)
        after = jnp.clip(wanted, velocity - change, velocity + change)
        most = self._braking(self.upper - coordinates, velocity, period)
        least = -self._braking(coordinates - self.lower, -velocity, period)
        after = jnp.clip(after, least, most)
        return coordinates + 0.5 * period * (velocity + after), after

    def _braking(self, room: Array, velocity: Array, period: Array) -> Array:
        """Largest velocity after a step from which braking stops within `room`."""
        half = 0.5 * period
        left = room - half * velocity
        # It is a square while there is room to brake; round-off may make it negative.
        squared = half**2 + 2 * left / self.acceleration
        moving = squared > 0
        root = jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1)), 0)
        return self.acceleration * (root - half)


@pytree
class Glide(Schedule):
    """Path of a held end over a control step: cubic, with given ends and velocities.

    It is exact for a hand whose velocity changes linearly.
    """

    first: Float[Array, "3"]
    """Position as the step begins, world frame [m]."""
    last: Float[Array, "3"]
    """Position as it ends, world frame [m]."""
    first_velocity: Float[Array, "3"]
    """Velocity as it begins, world frame [m/s]."""
    last_velocity: Float[Array, "3"]
    """Velocity as it ends, world frame [m/s]."""
    duration: Float[Array, ""]
    """Duration of the step [s]."""

    def __call__(self, clock: Clock) -> Placed:
        """Position, velocity and acceleration at the time of a clock."""
        part = clock.time / self.duration
        mean = (self.last - self.first) / self.duration
        bend = 3 * mean - 2 * self.first_velocity - self.last_velocity
        twist = self.first_velocity + self.last_velocity - 2 * mean
        way = self.first_velocity + part * (bend + part * twist)
        faster = 2 * bend + 6 * part * twist
        return Placed(
            position=self.first + self.duration * part * way,
            velocity=self.first_velocity + part * (2 * bend + 3 * part * twist),
            acceleration=faster / self.duration,
        )

    @property
    def largest(self) -> Placed:
        """Larger absolute value of both positions, and rates of zero for checks."""
        still = jnp.zeros_like(self.first)
        far = jnp.maximum(jnp.abs(self.first), jnp.abs(self.last))
        return Placed(far, still, still)
