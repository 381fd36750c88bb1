"""Many whole runs at once: training as one pure function, vectorised."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

from jaxrod.envs import Environment
from jaxrod.training.algorithm import Algorithm
from jaxrod.training.runs.contract import resolve, updates_of
from jaxrod.training.settings import check_steps
from jaxrod.validation import check_count, check_seed


def train_seeds(
    env: Environment,
    algorithm: str | Algorithm = "ppo",
    *,
    steps: int,
    seeds: Sequence[int] = (0, 1, 2),
    config: Any = None,
    env_params: Any = None,
) -> tuple[Any, dict[str, Array]]:
    """Trains one run per seed, all in one program and without touching the host.

    Suitable for small tasks and studies; for a long run use `jaxrod.training.train`.
    Under vectorisation both branches of a condition are computed, so restarts add a
    small cost to every step.

    Args:
        env: The environment.
        algorithm: A name, an import path `module:NAME`, or an `Algorithm`.
        steps: Number of control steps of each run, rounded up to whole updates.
        seeds: The seeds.
        config: Settings of the algorithm, None for its defaults.
        env_params: Parameters of the environment, None for its defaults.

    Returns:
        The train states, with a leading axis of seeds, and metrics of shape (seeds,
        updates): those of the algorithm, `episodes` (number of complete episodes that
        ended in the update) and `episode_return_mean` (mean over these; NaN if there
        are none).

    Raises:
        ValueError: An argument or a setting is invalid.
    """
    learner, config = resolve(algorithm, config)
    learner.validate(config, 1)
    steps = check_count("steps", steps, 1)
    if not isinstance(seeds, Sequence):
        raise ValueError(f"seeds must be a sequence of integers, got {seeds!r}")
    if not seeds:
        raise ValueError("seeds must hold at least one seed, got none")
    seeds = [check_seed(seed, "seeds") for seed in seeds]
    per_update = updates_of(learner, config)
    updates = check_steps(steps, per_update)
    params = env.default_params() if env_params is None else env_params

    def update(state: Any, _: None) -> tuple[Any, dict[str, Array]]:
        state, metrics = learner.update(state)
        episodes = metrics.episodes
        count: Int[Array, ""] = jnp.sum(episodes.finished)
        earned = jnp.sum(jnp.where(episodes.finished, episodes.episode_return, 0))
        mean = jnp.where(count > 0, earned / jnp.maximum(count, 1), jnp.nan)
        return state, {
            **metrics.scalars,
            "episodes": count,
            "episode_return_mean": mean,
        }

    def run(key: Key[Array, ""]) -> tuple[Any, dict[str, Array]]:
        state = learner.init(key, env, config, params, updates * per_update)
        return jax.lax.scan(update, state, length=updates)

    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
    return jax.jit(jax.vmap(run))(keys)
