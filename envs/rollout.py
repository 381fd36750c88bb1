"""Rollouts of one environment, with reverse-mode gradients that need little memory.

Reverse mode through a plain loop stores the intermediate values of every step. Here the
steps are grouped into blocks of about the square root of their number. Only the states
between blocks are stored. The states within a block are recomputed by one more forward
pass, one block at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Key

from jaxrod.envs.memory_policy import MemoryPolicy, OneEpisode, has_memory, held_for
from jaxrod.envs.protocol import Environment
from jaxrod.structure import pytree
from jaxrod.validation import check_count


@pytree
class Rollout:
    """Results of a rollout, with the reward of every control step.

    Example:
        >>> env = envs.make("trivial")
        >>> params = env.default_params()
        >>> start = env.reset(jax.random.key(0), params)
        >>> result = envs.rollout(env, start, jnp.zeros((30, 1)), params)
        >>> result.reward.shape, bool(result.running[18]), bool(result.running[19])
        ((30,), True, False)
        >>> env.episode_length
        20
    """

    observation: Float[Array, " observation"]
    """Observation after the last step, or at the end of the episode."""
    state: Any
    """State after the last step, or at the end of the episode."""
    reward: Float[Array, " steps"]
    """Reward of every control step; zero once the episode has ended."""
    running: Bool[Array, " steps"]
    """Whether the episode was still running after each control step."""
    collected: Any
    """Results of `collect` for every state, stacked along a new first axis."""


def rollout(
    env: Environment,
    start: tuple[Float[Array, " observation"], Any],
    act: Float[Array, "steps action"] | Callable[[Array], Array] | MemoryPolicy,
    params: Any,
    steps: int | None = None,
    *,
    key: Key[Array, ""] | None = None,
    collect: Callable[[Any], Any] | None = None,
) -> Rollout:
    r"""Simulates one environment for many steps; pure, differentiable, for `jax.vmap`.

    The gradient equals that of a plain loop. It needs the memory of about
    $2 \sqrt{n}$ states for $n$ steps. Once the episode has ended, by the task or by the
    time limit, the state does not change any more and rewards are zero.

    Args:
        env: The environment.
        start: Observation and state, as `env.reset` returns them.
        act: Actions in [-1, 1] of every control step, or a policy: a function of one
            observation, or a `MemoryPolicy`, with a batch of one. A policy's actions
            are clipped, and held for its `action_repeat`.
        params: Traced parameters.
        steps: Number of control steps, at least 1; required for a policy.
        key: Random key: step k draws from `fold_in(key, k)`. By default
            `jax.random.key(0)`, for tasks whose steps are not random.
        collect: Function of a state; its results are stored for every step.

    Returns:
        The last observation and state, and the rewards of all steps.

    Raises:
        ValueError: `steps` is missing, below 1, or not the number of the actions.

    Example:
        >>> env = envs.make("trivial")
        >>> params = env.default_params()
        >>> start = env.reset(jax.random.key(0), params)
        >>> result = envs.rollout(env, start, lambda seen: -5.0 * seen, params, steps=9)
        >>> round(float(abs(result.observation[0])), 3)  # it arrives
        0.0
    """
    given = None if callable(act) or has_memory(act) else jnp.asarray(act)
    if given is not None:
        if given.ndim != 2 or given.shape[1] != env.action_size:
            raise ValueError(
                "actions must have the shape (steps, action_size), here (steps, "
                f"{env.action_size}); got {given.shape}"
            )
        if steps is not None and steps != given.shape[0]:
            raise ValueError(
                f"steps is {steps}, but there are {given.shape[0]} actions"
            )
        steps = given.shape[0]
    elif steps is None:
        raise ValueError("steps must be given for a policy")
    steps = check_count("steps", steps, 1)
    key = jax.random.key(0) if key is None else key
    policy = None if given is not None else OneEpisode(act)
    repeat = 1 if given is not None else held_for(act)

    def step(carry: Any, now: tuple[Array, Any]) -> tuple[Any, Any]:
        observation, state, held, running = carry
        index, action = now
        if policy is not None:
            held = lax.cond(
                index % repeat == 0,
                lambda held: policy.act(held[1], observation, state),
                lambda held: held,
                held,
            )
            action = held[0]
        seen, moved, reward, terminated, truncated, _ = env.step(
            jax.random.fold_in(key, index), state, action, params
        )
        observation, state = jax.tree.map(
            lambda new, old: jnp.where(running, new, old),
            (seen, moved),
            (observation, state),
        )
        reward = jnp.where(running, reward, 0)
        # These may be Python's own False, whose ~ is -1.
        running = running & jnp.logical_not(terminated | truncated)
        kept = None if collect is None else collect(state)
        return (observation, state, held, running), (reward, running, kept)

    observation, state = start
    held = None
    if policy is not None:
        memory = policy.init(observation, state)
        made, _ = jax.eval_shape(policy.act, memory, observation, state)
        held = jnp.zeros(made.shape, made.dtype), memory
    carry = observation, state, held, jnp.ones((), bool)
    carry, (reward, running, collected) = _scanned(
        step, carry, (jnp.arange(steps), given), steps
    )
    return Rollout(carry[0], carry[1], reward, running, collected)


def _scanned(step: Any, carry: Any, along: Any, length: int) -> tuple[Any, Any]:
    """Runs `lax.scan` as two nested, checkpointed loops of about sqrt(length) steps.

    `step`, `carry` and `along` are the function, first carry and inputs of the scan. A
    third loop runs the remaining steps. Gradients need the memory of about
    2 sqrt(length) carries instead of `length`.
    """
    remembered = jax.checkpoint(step, prevent_cse=False)
    block = max(1, math.isqrt(length))
    blocks, rest = divmod(length, block)
    first = jax.tree.map(
        lambda leaf: jnp.reshape(
            leaf[: blocks * block], (blocks, block, *leaf.shape[1:])
        ),
        along,
    )

    def stretch(carry: Any, along: Any) -> tuple[Any, Any]:
        return lax.scan(remembered, carry, along)

    carry, made = lax.scan(
        jax.checkpoint(stretch, prevent_cse=False), carry, first, length=blocks
    )
    made = jax.tree.map(
        lambda leaf: jnp.reshape(leaf, (blocks * block, *leaf.shape[2:])), made
    )
    if rest:
        last = jax.tree.map(lambda leaf: leaf[blocks * block :], along)
        carry, more = lax.scan(remembered, carry, last)
        made = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), made, more)
    return carry, made
