"""Returns of a script without learning in the task `following`, and without dynamics.

The script knows the arm as five arcs of the commanded angles. In every control step it
asks for a part of the way from the tip to where the target will be, and changes the
angles by damped least squares with the arcs' Jacobian, clipped as actions are. Once on
the arm as it is, once with the tip at the end of the arcs, where it would be without
inertia and weight; on the learners' episodes, over a grid of the part,
the time ahead and the damping. It looks one step ahead, so it is no bound.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from benchmarks.following.learned import EPISODES, EPISODES_SEED, discounted
from jaxrod.envs import make
from jaxrod.envs.arm.moving_target import wander
from jaxrod.envs.soft_bodies.curved_arm import LENGTH, N_SEGMENTS
from jaxrod.envs.tasks.arm_task import distance_reward

PIECES = 4
"""Straight pieces with a joint in the middle that make a segment's arc."""
GRIDS = {
    "without dynamics": ((1.0,), (0.1,), (1e-2, 1e-1, 1.0)),
    "on the arm": ((0.2, 0.3, 0.4), (0.2, 0.3), (1e-2,)),
}
"""Part of the way [1], time ahead [s] and damping [m^2] of the least squares."""


def end_of_arcs(angles: Array, axes: Array) -> Array:
    """End of the five arcs [m]; the rows of `axes` are the directors at the base."""
    step = LENGTH / (N_SEGMENTS * PIECES)
    place = jnp.zeros(3, angles.dtype)
    for segment in range(N_SEGMENTS):
        for _ in range(PIECES):
            turn = (
                angles[0, segment] * axes[0] + angles[1, segment] * axes[1]
            ) / PIECES
            angle = jnp.sqrt(jnp.sum(turn**2) + 1e-12)
            about, cos, sin = turn / angle, jnp.cos(angle), jnp.sin(angle)
            place = place + 0.5 * step * axes[2]
            along = jnp.sum(axes * about[None, :], axis=1)[:, None] * about[None, :]
            across = jnp.stack([jnp.cross(about, axis) for axis in axes])
            axes = cos * axes + sin * across + (1 - cos) * along
            place = place + 0.5 * step * axes[2]
    return place


def player(dynamics: bool) -> Callable[..., dict[str, float]]:
    """Returns of the script, by fraction, look-ahead time and damping."""
    env = make("following")
    params = env.default_params()
    base = jnp.asarray(np.asarray(params.arm.rest.directors[:, :, 0]))

    def action(angles: Array, tip: Array, target: Any, how: Array) -> Array:
        part, ahead, damping = how
        slope = jax.jacfwd(end_of_arcs)(angles, base).reshape(3, -1)
        way = part * (target.position + ahead * target.velocity - tip)
        square = slope @ slope.T + damping * jnp.eye(3)
        change = slope.T @ jnp.linalg.solve(square, way)
        return jnp.clip(change / params.arm.largest_change, -1, 1)

    def episode(key: Array, how: Array) -> Array:
        first, others = jax.random.split(key)
        state = env.reset(first, params)[1]

        def step(state: Any, key: Array) -> tuple[Any, Array]:
            chosen = action(state.angles, state.arm.tip, state.target, how)
            _, state, reward, *_ = env.step(key, state, chosen, params)
            return state, reward

        def still(carry: Any, key: Array) -> tuple[Any, Array]:
            angles, target = carry
            chosen = action(angles, end_of_arcs(angles, base), target, how)
            angles = params.arm.turned(angles, chosen)
            target = wander(key, target, params.target, params.chance, jnp.asarray(0.1))
            way = end_of_arcs(angles, base) - target.position
            reward = distance_reward(jnp.sum(way**2), params.bonus)
            return (angles, target), reward

        keys = jax.random.split(others, env.episode_length)
        if dynamics:
            return jax.lax.scan(step, state, keys)[1]
        return jax.lax.scan(still, (state.angles, state.target), keys)[1]

    keys = jax.random.split(jax.random.key(EPISODES_SEED), EPISODES)
    play = jax.jit(jax.vmap(episode, in_axes=(0, None)))
    return lambda *how: discounted(np.asarray(play(keys, jnp.asarray(how))))


def act_by_script() -> None:
    """Prints a line for each point of the grids."""
    for name, grid in GRIDS.items():
        played = player(name == "on the arm")
        for part, ahead, damping in itertools.product(*grid):
            found = played(part, ahead, damping)
            print(
                f"{name}: part {part:g}, ahead {ahead:g} s, damping {damping:g} m^2: "
                f"{found['discounted']:.1f} from the start, "
                f"{found['discounted_from_any']:.1f} from any moment",
                flush=True,
            )
