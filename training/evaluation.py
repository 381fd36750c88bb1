"""Evaluation of a policy: complete episodes, without exploration noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod.envs import (
    Environment,
    EpisodeRecord,
    MemoryPolicy,
    VectorEnvironment,
    VectorState,
    held_for,
    remembering,
)
from jaxrod.envs.memory_policy import has_memory
from jaxrod.envs.registry import check_object
from jaxrod.envs.wrappers import repeating
from jaxrod.validation import check_seed


@dataclass(frozen=True)
class Evaluation:
    """Results of an evaluation, with one entry per episode.

    Example:
        >>> found = training.Evaluation(
        ...     returns=np.array([10.0, 14.0]),
        ...     lengths=np.array([20, 20]),
        ...     flagged=np.array([False, False]),
        ... )
        >>> found.mean, found.standard_deviation, found.flagged_fraction
        (12.0, 2.0, 0.0)
    """

    returns: Float[np.ndarray, " episodes"]
    """Return of each episode: the undiscounted sum of its rewards."""
    lengths: Int[np.ndarray, " episodes"]
    """Length of each episode [control steps]."""
    flagged: Bool[np.ndarray, " episodes"]
    """Whether a numerical health flag ended the episode, such as a non-finite state."""

    @property
    def mean(self) -> float:
        """Mean of the returns."""
        return float(np.mean(self.returns))

    @property
    def standard_deviation(self) -> float:
        """Standard deviation of the returns."""
        return float(np.std(self.returns))

    @property
    def flagged_fraction(self) -> float:
        """Fraction of the episodes that a health flag ended."""
        return float(np.mean(self.flagged))


def evaluate(
    env: Environment,
    policy: Callable[[Array], Array] | MemoryPolicy,
    *,
    episodes: int = 16,
    seed: int = 0,
    env_params: Any = None,
) -> Evaluation:
    """Runs complete episodes of a policy in parallel and returns their results.

    Args:
        env: The environment.
        policy: Function from observations (episodes, observation_size) to actions
            (episodes, action_size). The actions of a `Policy` are held for its
            `action_repeat` control steps; any other function is called at every control
            step. Or a `jaxrod.envs.MemoryPolicy`, which also reads the states and keeps
            a memory.
        episodes: Number of episodes.
        seed: Seed of the random numbers.
        env_params: Parameters of the environment, None for its defaults.

    Raises:
        ValueError: `episodes` is below 1, `seed` is not a valid seed, or the policy has
            shapes instead of numbers.

    Example:
        >>> env = envs.make("trivial")
        >>> best = lambda seen: jnp.clip(-5.0 * seen, -1.0, 1.0)
        >>> found = training.evaluate(env, best, episodes=256)
        >>> round(found.mean, 1), round(env.optimal_return, 1)
        (19.8, 19.7)
    """
    check_object(env)
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    check_seed(seed)
    if any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in jax.tree.leaves(policy)):
        raise ValueError(
            "policy must have numbers, got shapes alone: untrained_policy makes "
            "numbers if it is given a seed, such as seed=0"
        )
    params = env.default_params() if env_params is None else env_params
    env = repeating(env, held_for(policy))
    plain = not has_memory(policy)
    if plain and (not jax.tree.leaves(policy) or callable(jax.tree.leaves(policy)[0])):
        # A plain function is part of the program. A `Policy` is an argument of it.
        policy = jax.tree_util.Partial(policy)
    record = _episodes(jax.random.key(seed), policy, params, env, episodes)
    return Evaluation(
        np.asarray(record.episode_return),
        np.asarray(record.length),
        np.asarray(record.flagged),
    )


@partial(jax.jit, static_argnums=(3, 4))
def _episodes(
    key: Key[Array, ""],
    policy: Callable[[Array], Array] | MemoryPolicy,
    params: Any,
    env: Environment,
    episodes: int,
) -> EpisodeRecord:
    batch, acting = VectorEnvironment(env), remembering(policy)
    state = batch.reset(key, episodes, params)
    # The memory is not reset where an episode ends, because the episodes that follow do
    # not count.
    memory = acting.init(state.observation, state.states)
    record = EpisodeRecord(
        finished=jnp.zeros(episodes, bool),
        episode_return=state.episode_return,
        length=state.elapsed,
        flagged=jnp.zeros(episodes, bool),
    )

    def running(carry: tuple[VectorState, Any, EpisodeRecord]) -> Bool[Array, ""]:
        return ~jnp.all(carry[2].finished)

    def step(
        carry: tuple[VectorState, Any, EpisodeRecord],
    ) -> tuple[VectorState, Any, EpisodeRecord]:
        state, memory, record = carry
        action, memory = acting.act(memory, state.observation, state.states)
        state, outcome = batch.step(state, jnp.clip(action, -1, 1), params)
        first = outcome.episodes.finished & ~record.finished
        record = jax.tree.map(
            lambda new, old: jnp.where(first, new, old), outcome.episodes, record
        )
        return state, memory, record

    return jax.lax.while_loop(running, step, (state, memory, record))[2]
