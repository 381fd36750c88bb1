"""A hand at the end of a robot's arm, whose coordinates are those of the joints."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import RobotArm
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array

_TRIES = 40
"""Corrections of the search for coordinates that reach a point."""
_DAMPING = 1e-3
"""Damping of these corrections, beside squares of lever arms [m^2]."""


@pytree
class RobotHand:
    """A hand whose coordinates are those of a robot's joints; made by `robot_hand`.

    It is a hand for the parameters of `lift`, in place of one that moves freely.

    Example:
        >>> with open("crane.xml", "w") as file:
        ...     _ = file.write('''<mujoco><worldbody><body name="hook">
        ...         <joint name="z" type="slide" axis="0 0 1" range="0 0.5"/>
        ...     </body></worldbody></mujoco>''')
        >>> arm = jaxrod.robot_arm("crane.xml", "hook")
        >>> free = envs.make("lift").default_params().hand
        >>> hand = envs.robot_hand(arm, free)
        >>> hand.reaching(jnp.array([0.0, 0.0, 0.25])).round(3).tolist()
        [0.25]
    """

    joints: Any
    """Ranges, velocities and accelerations of the joints."""
    arm: RobotArm
    """Kinematics of the arm."""
    lowest: Float[Array, ""]
    """Height below which the hand stops, world frame [m]."""

    def place(self, coordinates: Float[Array, " joints"]) -> Float[Array, "3"]:
        """Position of the hand, world frame [m]."""
        return self.arm.pose(coordinates)[0]

    def reaching(self, point: Float[Array, "3"]) -> Float[Array, " joints"]:
        """Coordinates, within their ranges, that bring the hand to or near a point.

        Damped corrections begin in the middle of all ranges.

        Args:
            point: Position, world frame [m].
        """

        def corrected(_: Any, coordinates: Array) -> Array:
            slopes = jax.jacfwd(self.place)(coordinates)
            away = point - self.place(coordinates)
            square = slopes.T @ slopes + _DAMPING * jnp.eye(len(coordinates))
            change = jnp.linalg.solve(square, slopes.T @ away)
            return jnp.clip(coordinates + change, self.arm.lower, self.arm.upper)

        middle = 0.5 * (self.arm.lower + self.arm.upper)
        found: Array = jax.lax.fori_loop(0, _TRIES, corrected, middle)
        return found

    def moved(
        self,
        coordinates: Float[Array, " joints"],
        velocity: Float[Array, " joints"],
        action: Float[Array, " joints"],
        period: Array,
    ) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
        """Coordinates and velocities of the joints after a control step.

        Velocities change linearly, no faster than the acceleration allows, and joints
        brake before the ends of their ranges. All joints stop where they are if the
        hand would come below its lowest height.
        """
        after, rates = self.joints.moved(coordinates, velocity, action, period)
        low = self.place(after)[2] < self.lowest
        return jnp.where(low, coordinates, after), jnp.where(low, 0, rates)


def robot_hand(
    arm: RobotArm,
    free: Any,
    *,
    speed: Numbers = 1.5,
    acceleration: Numbers = 7.5,
    lowest: Numbers = 0.0,
) -> RobotHand:
    """Makes a hand for the parameters of `lift` from the arm of a robot.

    Actions are then velocities of the joints. The arm must have three of them, because
    the task has three actions.

    Args:
        arm: The arm; all its joints need limits.
        free: The hand that it replaces: `params.hand` of the task.
        speed: Largest velocity of each joint, or of all, above 0 [rad/s, m/s].
        acceleration: Their largest acceleration, above 0 [rad/s^2, m/s^2].
        lowest: Height below which the hand stops, world frame [m].

    Raises:
        ValueError: A joint has no limits, or a number is out of range.

    Example:
        >>> with open("crane.xml", "w") as file:
        ...     _ = file.write('''<mujoco><worldbody><body name="hook" pos="0 0 0.4">
        ...         <joint name="x" type="slide" axis="1 0 0" range="-0.4 0.4"/>
        ...         <joint name="y" type="slide" axis="0 1 0" range="-0.4 0.4"/>
        ...         <joint name="z" type="slide" axis="0 0 1" range="-0.39 0.5"/>
        ...     </body></worldbody></mujoco>''')
        >>> arm = jaxrod.robot_arm("crane.xml", "hook")
        >>> env = envs.make("lift")
        >>> params = env.default_params()
        >>> hand = envs.robot_hand(arm, params.hand, lowest=0.005)
        >>> params = replace(params, hand=hand)
        >>> observation, state = env.reset(jax.random.key(0), params)
        >>> round(float(state.body.positions[2, 0]), 3)  # the hand holds the rope
        0.01
    """
    kind = arm.places.dtype
    shapes = [(), arm.lower.shape]
    if not bool(jnp.all(jnp.isfinite(arm.lower) & jnp.isfinite(arm.upper))):
        raise ValueError(f"all joints need limits, got {arm.joints} with {arm.lower}")

    def each(name: str, value: Numbers, unit: str) -> Array:
        given = as_array(name, value, unit, shapes, positive=True, dtype=kind)
        return jnp.broadcast_to(given, arm.lower.shape)

    joints = dataclasses.replace(
        free,
        lower=arm.lower,
        upper=arm.upper,
        speed=each("speed", speed, "rad/s"),
        acceleration=each("acceleration", acceleration, "rad/s^2"),
    )
    return RobotHand(joints, arm, as_array("lowest", lowest, "m", dtype=kind))
