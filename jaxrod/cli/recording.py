"""Recording of one episode of a policy, as a replay."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from jaxrod.envs import Environment, OneEpisode, held_for
from jaxrod.envs.drawing import drawable, missing, replay, snapshots
from jaxrod.structure import pytree
from jaxrod.viz import Replay

FRAMES_PER_SECOND = 60.0


@pytree
class Frame:
    """A recorded moment of an episode, or several along a leading axis."""

    state: Any
    """State of the environment."""
    reward: Float[Array, "*frames"]
    """Mean reward per control step since the previous frame."""
    running: Bool[Array, "*frames"]
    """Whether the episode was still running when the interval to this frame began."""


def record(
    env: Environment,
    policy: Any,
    *,
    seconds: float | None = None,
    seed: int = 0,
    title: str = "",
) -> Replay:
    """Plays an episode and records its frames at up to 60 Hz.

    Args:
        env: The environment.
        policy: Function observation -> action, a pytree, or a
            `jaxrod.envs.MemoryPolicy`; its actions are held for its `action_repeat`
            control steps, if it has one.
        seconds: Length of the recording [s]; None for a whole episode. The end of the
            episode always ends the recording.
        seed: Seed of the episode.
        title: Heading of the replay.

    Raises:
        ValueError: The environment cannot be drawn, or `seconds` is not positive.
    """
    if not drawable(env):
        raise ValueError(missing(env))
    if seconds is not None and not 0 < seconds < float("inf"):
        raise ValueError(f"seconds must be positive and finite, got {seconds} s")
    period = env.control_period
    params = env.default_params()
    steps = env.episode_length
    if seconds is not None:
        steps = min(steps, max(1, round(seconds / period)))
    stride = min(steps, math.ceil(1 / (FRAMES_PER_SECOND * period)))
    play = _play(policy, params, jax.random.key(seed), env, steps // stride, stride)
    frames: Frame = jax.tree.map(
        lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), *play
    )
    seen = jax.device_get(snapshots(env, frames.state, params))
    reward, running = np.asarray(frames.reward), np.asarray(frames.running)
    # A rod that is no longer finite cannot be drawn; the frames before can.
    nodes = seen.positions.reshape(len(running), -1)
    sound = running & np.isfinite(nodes).all(axis=1)
    count = len(sound) if sound.all() else int(np.argmin(sound))
    return replay(
        jax.tree.map(lambda leaf: leaf[:count], seen),
        np.arange(count) * stride * period,
        {
            "reward": reward[:count],
            "return": np.cumsum(reward[:count], dtype=float) * stride,
        },
        title,
    )


@partial(jax.jit, static_argnames=("env", "count", "stride"))
def _play(
    policy: Any,
    params: Any,
    key: Key[Array, ""],
    env: Any,
    count: int,
    stride: int,
) -> tuple[Frame, Frame]:
    """Plays an episode; returns its first frame and `count` more, stacked.

    Args:
        policy: The policy, of either kind.
        params: Parameters of the environment.
        key: Typed random key.
        env: The environment.
        count: Number of frames after the first.
        stride: Control steps between two frames.
    """
    start_key, step_key = jax.random.split(key)
    observation, start = env.reset(start_key, params)
    acting, repeat = OneEpisode(policy), held_for(policy)

    def step(carry: tuple[Any, ...], index: Array) -> tuple[tuple[Any, ...], Array]:
        observation, state, action, memory, running = carry
        action, memory = jax.lax.cond(
            index % repeat == 0,
            lambda _, memory: acting.act(memory, observation, state),
            lambda *held: held,
            action,
            memory,
        )
        seen, moved, reward, terminated, truncated, _ = env.step(
            jax.random.fold_in(step_key, index), state, action, params
        )
        observation, state = jax.tree.map(
            lambda new, old: jnp.where(running, new, old),
            (seen, moved),
            (observation, state),
        )
        reward = jnp.where(running, reward, 0)
        # These may be Python's own False, whose ~ is -1.
        running = running & jnp.logical_not(terminated | truncated)
        return (observation, state, action, memory, running), reward

    def frame(carry: tuple[Any, ...], index: Array) -> tuple[tuple[Any, ...], Frame]:
        running = carry[-1]
        indices = index * stride + jnp.arange(stride)
        carry, rewards = jax.lax.scan(step, carry, indices)
        return carry, Frame(carry[1], jnp.mean(rewards), running)

    running = jnp.ones((), bool)
    memory = acting.init(observation, start)
    action, _ = jax.eval_shape(acting.act, memory, observation, start)
    carry = observation, start, jnp.zeros(action.shape, action.dtype), memory, running
    _, frames = jax.lax.scan(frame, carry, jnp.arange(count))
    reward = jnp.zeros_like(frames.reward[0])
    return Frame(start, reward, running), frames
