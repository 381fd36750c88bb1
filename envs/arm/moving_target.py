"""A target sphere that wanders through a box: straight flight, bounces, new headings.

This is the published benchmark's target, including its quirks. The wall test only flips
the sign of the velocity. So a target that starts within its radius of a wall flips at
every test and does not move along that axis (30 % of episodes have such an axis).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxrod.structure import pytree


@pytree
class TargetParams:
    """Parameters of the target's motion."""

    lower: Float[Array, "3"]
    """Lower corner of the box [m]."""
    upper: Float[Array, "3"]
    """Upper corner of the box [m]."""
    radius: Float[Array, ""]
    """Radius of the sphere for the wall tests [m]."""
    speed: Float[Array, ""]
    """Constant speed of the target [m/s]."""


@pytree
class Target:
    """Position and velocity of the target."""

    position: Float[Array, "3"]
    """Centre of the sphere [m]."""
    velocity: Float[Array, "3"]
    """Velocity of the sphere [m/s]."""


def heading(key: Key[Array, ""], speed: Array) -> Float[Array, "3"]:
    """Draws a random velocity of the given speed [m/s].

    Both angles are uniform over a full turn, as published. So headings cluster around
    the z axis instead of being uniform over the sphere.
    """
    a, b = jax.random.uniform(key, (2,), maxval=2 * jnp.pi)
    return speed * jnp.stack(
        [jnp.cos(a) * jnp.sin(b), jnp.sin(a) * jnp.sin(b), jnp.cos(b)]
    )


def start(key: Key[Array, ""], params: TargetParams) -> Target:
    """Draws a target uniformly in the box, with a random heading."""
    place, turn = jax.random.split(key)
    position = jax.random.uniform(place, (3,), minval=params.lower, maxval=params.upper)
    return bounce(Target(position, heading(turn, params.speed)), params)


def bounce(target: Target, params: TargetParams) -> Target:
    """Flips the velocity along every axis on which the sphere overlaps a wall."""
    outside = (target.position - params.radius < params.lower) | (
        target.position + params.radius > params.upper
    )
    return Target(
        target.position, jnp.where(outside, -target.velocity, target.velocity)
    )


def fly(
    target: Target, params: TargetParams, dt: Array | float, n_tests: int
) -> Target:
    """Flies for `n_tests` intervals of `dt` [s]; the walls are tested after each."""
    # Unrolled: the whole flight is one small kernel, which is cheaper than a loop.
    for _ in range(n_tests):
        moved = Target(target.position + dt * target.velocity, target.velocity)
        target = bounce(moved, params)
    return target


def wander(
    key: Key[Array, ""] | None,
    target: Target,
    params: TargetParams,
    chance: Array,
    dt: Array,
) -> Target:
    """Moves the target for `dt`: after a bounce, or perhaps with a new heading.

    The walls are tested before the move, not after it. So the centre may leave the box
    by one move, and returns in the next. The returned velocity is that of this move.

    Args:
        key: Typed random key; `None` for a move without a new heading.
        target: Target before the move.
        params: Parameters of the target.
        chance: Probability of a new heading, unless the target bounces [1].
        dt: Duration of the move [s].
    """
    velocity = bounce(target, params).velocity
    if key is not None:
        draw, turn = jax.random.split(key)
        inside = jnp.all(velocity == target.velocity)
        turning = inside & (jax.random.uniform(draw) < chance)
        velocity = jnp.where(turning, heading(turn, params.speed), velocity)
    return Target(target.position + dt * velocity, velocity)
