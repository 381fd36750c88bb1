"""Returns of random actions and of a task's script.

Random actions are uniform in [-1, 1] and change in every control step; they act in 256
episodes. The script is the task's `scripted_action`, which acts in 16 episodes. All
runs use single precision, as training does.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

import jaxrod
from jaxrod.envs import VectorEnvironment, make
from jaxrod.envs.wrappers import EpisodeRecord

RANDOM_EPISODES, SCRIPTED_EPISODES = 256, 16


def played(env: Any, episodes: int, scripted: bool) -> EpisodeRecord:
    """First complete episode of each environment of a batch."""
    batch, params = VectorEnvironment(env), env.default_params()

    def action(state: Any, key: Array) -> Array:
        if scripted:
            return env.scripted_action(state, params)
        return jax.random.uniform(key, (env.action_size,), minval=-1.0)

    @jax.jit
    def play(key: Array) -> EpisodeRecord:
        start = batch.reset(key, episodes, params)

        def step(state: Any, number: Array) -> tuple[Any, EpisodeRecord]:
            keys = jax.random.split(jax.random.fold_in(key, number), episodes)
            state, outcome = batch.step(
                state, jax.vmap(action)(state.states, keys), params
            )
            return state, outcome.episodes

        _, records = jax.lax.scan(step, start, jnp.arange(env.episode_length))
        first = jnp.argmax(records.finished, axis=0)
        return jax.tree.map(
            lambda leaf: jnp.take_along_axis(leaf, first[None], axis=0)[0], records
        )

    return play(jax.random.key(0))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tasks."""
    parser.add_argument("tasks", nargs="*", metavar="TASK", default=["snake"])


def run(args: argparse.Namespace) -> int:
    """Prints a line for each task and baseline."""
    jaxrod.configure_cpu()
    for task in args.tasks:
        env = make(task)
        for scripted in (False, True):
            count = SCRIPTED_EPISODES if scripted else RANDOM_EPISODES
            record = played(env, count, scripted)
            name = "scripted" if scripted else "random"
            print(
                f"{task} {name}: return {float(jnp.mean(record.episode_return)):.1f} "
                f"± {float(jnp.std(record.episode_return)):.1f}, "
                f"length {float(jnp.mean(record.length)):.0f}, "
                f"flagged {float(jnp.mean(record.flagged)):.1%}",
                flush=True,
            )
    return 0
