"""A target that wanders through a box, and may turn at any time with equal chance.

Its centre may leave the box by one move, and comes back in the next: the walls are
tested before a move, not after it. A new heading takes effect with the next move, so
the current velocity is that of the last move.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from jaxrod.envs.arm.moving_target import Target, TargetParams, bounce, heading


def wander(
    key: Key[Array, ""] | None,
    target: Target,
    params: TargetParams,
    chance: Array,
    dt: Array,
) -> Target:
    """One move: away from a wall it has crossed, or possibly in a new direction.

    Args:
        key: Typed random key; `None` for a move without a new heading.
        target: Target before the move.
        params: Parameters of the target.
        chance: Probability of a new heading, unless the target is behind a wall [1].
        dt: Duration of the move [s].
    """
    velocity = bounce(target, params).velocity
    if key is not None:
        draw, turn = jax.random.split(key)
        inside = jnp.all(velocity == target.velocity)
        turning = inside & (jax.random.uniform(draw) < chance)
        velocity = jnp.where(turning, heading(turn, params.speed), velocity)
    return Target(target.position + dt * velocity, velocity)
