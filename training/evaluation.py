"""Evaluation of a policy: complete episodes, acted without noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod.envs import Environment, EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.envs.action_repeat import repeating
from jaxrod.training.policy import held_for
from jaxrod.validation import check_seed


@dataclass(frozen=True)
class Evaluation:
    """One entry per episode."""

    returns: Float[np.ndarray, " episodes"]
    """Sums of the rewards."""
    lengths: Int[np.ndarray, " episodes"]
    """Control steps."""
    flagged: Bool[np.ndarray, " episodes"]
    """Whether a numerical health flag ended the episode."""

    @property
    def mean(self) -> float:
        """Mean return."""
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
    policy: Callable[[Array], Array],
    *,
    episodes: int = 16,
    seed: int = 0,
    env_params: Any = None,
) -> Evaluation:
    """Runs complete episodes side by side.

    Args:
        env: the environment.
        policy: observations (episodes, observation_size) -> actions; a `Policy`,
            whose actions are held for its `action_repeat` control steps, or any
            other function of that kind, called at every control step.
        episodes: number of episodes.
        seed: seed of their randomness.
        env_params: parameters of the environment, None for its own.

    Raises:
        ValueError: `episodes` is below 1, or `seed` is not one.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    check_seed(seed)
    params = env.default_params() if env_params is None else env_params
    env = repeating(env, held_for(policy))
    if not jax.tree.leaves(policy) or callable(jax.tree.leaves(policy)[0]):
        # A plain function: part of the program. A `Policy` is an argument of it.
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
    policy: Callable[[Array], Array],
    params: Any,
    env: Environment,
    episodes: int,
) -> EpisodeRecord:
    batch = VectorEnvironment(env)
    state = batch.reset(key, episodes, params)
    record = EpisodeRecord(
        finished=jnp.zeros(episodes, bool),
        episode_return=state.episode_return,
        length=state.elapsed,
        flagged=jnp.zeros(episodes, bool),
    )

    def running(carry: tuple[VectorState, EpisodeRecord]) -> Bool[Array, ""]:
        return ~jnp.all(carry[1].finished)

    def step(
        carry: tuple[VectorState, EpisodeRecord],
    ) -> tuple[VectorState, EpisodeRecord]:
        state, record = carry
        action = jnp.clip(policy(state.observation), -1, 1)
        state, outcome = batch.step(state, action, params)
        first = outcome.episodes.finished & ~record.finished
        record = jax.tree.map(
            lambda new, old: jnp.where(first, new, old), outcome.episodes, record
        )
        return state, record

    return jax.lax.while_loop(running, step, (state, record))[1]
