"""Returns of learners in the task `following`, against the time it takes.

One learner and one seed run at a time. At intervals the clocks stop, and the policy
acts 64 episodes without noise, the same for all seeds. The record has two numbers: the
discounted return of an episode from its start, and the mean over all its steps of the
discounted return from there to its end. DisMech-RL's learning library reports the
second. A record of a run is written after every evaluation.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from benchmarks.shared.clocks import Clocks
from benchmarks.shared.files import write_record
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import find_algorithm

RECORDS = Path(__file__).with_name("records")
SEEDS = (0, 1, 2)
EPISODES = 64
EPISODES_SEED = 2
"""Seed of the counted episodes, different from that by which settings were chosen."""
POINTS = 8
"""Evaluations along a run."""
DISCOUNT = 0.99
"""Discount of the counted returns, that of DisMech-RL; a learner has its own."""
FINE = 24
"""Elements of the arm on which the policy is tried at the end."""
LEARNERS: dict[str, tuple[int, dict[str, Any]]] = {
    "dagger": (
        150_000,
        {
            "action_repeat": 1,
            "rollout_steps": 16,
            "lookahead": 3,
            "batch_size": 512,
            "gradient_steps": 64,
            "planner_steps": 30_000.0,
            "effort": 5e-2,
        },
    ),
    "ppo": (
        2_600_000,
        {
            "num_envs": 128,
            "rollout_steps": 64,
            "hidden_sizes": (128, 128),
            "discount": 0.97,
            "final_learning_rate": 1e-4,
            "initial_log_std": -0.5,
        },
    ),
}
"""Control steps, and what differs from the learner's defaults. Chosen with seed 100."""


def player(n_elements: int) -> Callable[[Any], dict[str, float]]:
    """Function that plays the episodes with a policy; `None` acts at random."""
    env = make("following", n_elements=n_elements)
    params = env.default_params()

    def episode(policy: Any, key: Array) -> tuple[Array, Array, Array]:
        def step(carry: Any, key: Array) -> tuple[Any, tuple[Array, Array, Array]]:
            observation, state = carry
            if policy is None:
                draw = jax.random.fold_in(key, 1)
                action = jax.random.uniform(draw, (env.action_size,), minval=-1.0)
            else:
                action = policy(observation[None])[0]
            observation, state, reward, _, _, info = env.step(
                key, state, action, params
            )
            return (observation, state), (reward, info["distance"], info["flagged"])

        first, others = jax.random.split(key)
        keys = jax.random.split(others, env.episode_length)
        return jax.lax.scan(step, env.reset(first, params), keys)[1]

    play = jax.jit(jax.vmap(episode, in_axes=(None, 0)))
    keys = jax.random.split(jax.random.key(EPISODES_SEED), EPISODES)

    def counted(policy: Any) -> dict[str, float]:
        rewards, distances, flagged = map(np.asarray, play(policy, keys))
        return {
            **discounted(rewards),
            "return": float(np.mean(np.sum(rewards, axis=1))),
            "median_distance": float(np.median(distances)),
            "within_5_cm": float(np.mean(distances < 0.05)),
            "flagged": float(np.mean(np.any(flagged, axis=1))),
        }

    return counted


def discounted(rewards: np.ndarray) -> dict[str, float]:
    """Discounted returns from the start and from any step, from (episodes, steps)."""
    length = rewards.shape[1]
    weights = DISCOUNT ** np.arange(length)
    # The reward of step k counts in the returns from all k + 1 moments before it.
    moments = np.cumsum(weights) / length
    return {
        "discounted": float(np.mean(rewards @ weights)),
        "discounted_deviation": float(np.std(rewards @ weights)),
        "discounted_from_any": float(np.mean(rewards @ moments)),
    }


def trained(name: str, seed: int) -> None:
    """Writes the record of a run."""
    env, learner = make("following"), find_algorithm(name)
    steps, settings = LEARNERS[name]
    config = dataclasses.replace(learner.config_type(), **settings)
    learner.validate(config, 1)
    per_update = learner.steps_per_update(config)
    updates = -(-steps // per_update)
    clocks, counted = Clocks(), player(env.n_elements)

    start = jax.jit(learner.init, static_argnums=(1, 4))
    params = env.default_params()
    state = start(jax.random.key(seed), env, config, params, updates * per_update)
    update = jax.jit(learner.update, donate_argnums=0).lower(state).compile()
    jax.block_until_ready(state)
    record: dict[str, Any] = {
        "seed": seed,
        "settings": settings,
        "compile_s": clocks.read(),
        "episodes": EPISODES,
        "rows": [],
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks following {name} --seeds {seed}",
    }
    for done in range(1, updates + 1):
        state, _ = update(state)
        if done % (updates // POINTS) and done < updates:
            continue
        jax.block_until_ready(state)
        wall, cpu = clocks.read()
        clocks.stop()
        row = {"control_steps": done * per_update, "wall_s": wall, "processor_s": cpu}
        row |= counted(learner.policy(state))
        record["rows"].append(row)
        print(f"{name} {seed}: {json.dumps(row)}", flush=True)
        if done == updates:
            record["fine"] = {"n_elements": FINE} | player(FINE)(learner.policy(state))
            print(f"{name} {seed}: {json.dumps(record['fine'])}", flush=True)
        write_record(RECORDS, f"{name}-{seed}", record)
        clocks.go()


def act_at_random() -> None:
    """Writes the returns of random actions, and the largest possible return."""
    most = discounted(np.full((1, 500), 2.0))
    found = player(make("following").n_elements)(None)
    record = {"random": found, "most": most, "episodes": EPISODES}
    record["command"] = "python -m benchmarks following random"
    print(json.dumps(record), flush=True)
    write_record(RECORDS, "random", record)
