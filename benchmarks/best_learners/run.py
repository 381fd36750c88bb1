"""Shares of the ceiling that the best learners of the arm reach.

Trains the recipe of every task (variant "clean"), or of the tasks named, with one seed
after another, in float32 on one core. Evaluates each final policy without noise on 256
episodes, and compares every return with the ceiling of its episode (`optimum`). Writes
a record of every run into records, then docs/optimum.md from all records.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
from typing import Any

import jax
import numpy as np

import jaxrod
from benchmarks.optimum.page import CASES, LEARNERS, write_pages
from benchmarks.optimum.run import SEED, Bound
from benchmarks.shared.arguments import add_names
from benchmarks.shared.clocks import Clocks
from benchmarks.shared.files import write_record
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import evaluate, find_algorithm, warm_start

SEEDS = {
    "tracking": (5, 6, 7, 8, 9),
    "reaching": (0, 1, 2, 3, 4),
    "structured": (0, 1, 2, 3, 4),
    "unstructured": (0, 1, 2, 3, 4),
}
"""Untouched ones: others had served shorter runs of `tracking`."""
EPISODES = {"tracking": 256, "reaching": 256, "structured": 4, "unstructured": 4}
"""Nothing is random in the last two: all episodes are the same."""
EPISODES_SEED = 2
"""Seed of the counted episodes, different from that by which settings were chosen."""

Stage = tuple[str, int, dict[str, Any]]
"""A learner, its control steps, and what differs from its defaults."""

CLIMB: dict[str, Any] = {
    "hidden_sizes": (128, 128),
    "action_repeat": 8,
    "rollout_steps": 32,
    "discount": 0.93,
    "learning_rate": 3e-4,
    "initial_log_std": -1.5,
}
"""PPO from where a policy that imitates a planner is."""
MAZE: dict[str, Any] = {
    "action_repeat": 3,
    "rollout_steps": 64,
    "discount": 0.985,
    "trace_decay": 0.96,
}
"""PPO among obstacles, as `jaxrod reproduce --variant clean` has it."""
RECIPES: dict[str, tuple[Stage, ...]] = {
    "tracking": (
        ("dagger", 1_000_000, {"plan_iterations": 2}),
        ("ppo", 40_000_000, CLIMB),
    ),
    "reaching": (
        ("dagger", 1_500_000, {"short_steps": 1.0e9, "short_length": 480.0}),
        ("ppo", 12_000_000, CLIMB | {"learning_rate": 2e-4}),
    ),
    "structured": (("ppo", 1_200_000, MAZE),),
    "unstructured": (("ppo", 2_400_000, MAZE),),
}
"""Learners of a task in sequence; each starts from the policy of the one before."""


def trained(task: str, seed: int, programs: dict[int, tuple[Any, float]]) -> Any:
    """The record of a run.

    Args:
        task: its name.
        seed: The seed of every stage.
        programs: Compiled updates of the task's stages, and the processor time of
            compiling [s], which counts in every run. Missing ones are added.
    """
    env, episodes = make(task, variant="clean"), EPISODES[task]
    policy: Any = None
    stages = []
    for number, (name, steps, settings) in enumerate(RECIPES[task]):
        learner = find_algorithm(name)
        config = dataclasses.replace(learner.config_type(), **settings)
        if policy is not None:
            # PPO decides more often than the imitator, whose actions are held longer.
            held = dataclasses.replace(policy, action_repeat=config.action_repeat)
            learner = warm_start(learner, held)
        learner.validate(config, 1)
        per_update = learner.steps_per_update(config)
        updates = -(-steps // per_update)
        start = jax.jit(learner.init, static_argnums=(1, 4))
        clocks = Clocks()
        params = env.default_params()
        state = start(jax.random.key(seed), env, config, params, updates * per_update)
        jax.block_until_ready(state)
        begun = clocks.read()[1]
        if number not in programs:
            compiled = jax.jit(learner.update, donate_argnums=0).lower(state).compile()
            programs[number] = compiled, clocks.read()[1] - begun
        update, compiling = programs[number]
        clocks = Clocks()
        for _ in range(updates):
            state, _ = update(state)
        policy = jax.block_until_ready(learner.policy(state))
        stages.append(
            {
                "algorithm": name,
                "settings": settings,
                "control_steps": updates * per_update,
                "compile_processor_s": begun + compiling,
                "processor_s": begun + compiling + clocks.read()[1],
                # On the episodes that settings are chosen by.
                "score": evaluate(
                    env, policy, episodes=min(64, episodes), seed=SEED
                ).mean,
            }
        )
        print(f"{task} {seed}: {json.dumps(stages[-1])}", flush=True)
    found = evaluate(env, policy, episodes=episodes, seed=EPISODES_SEED)
    most = evaluate(Bound(env), policy, episodes=episodes, seed=EPISODES_SEED)
    return {
        "task": task,
        "case": CASES[task],
        "seed": seed,
        "stages": stages,
        "episodes_seed": EPISODES_SEED,
        "returns": np.asarray(found.returns).tolist(),
        "ceiling": np.asarray(most.returns).tolist(),
        "flagged": int(found.flagged.sum()),
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks best_learners {task} --seeds {seed}",
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tasks and seeds."""
    add_names(parser, "tasks", RECIPES, "TASK")
    parser.add_argument("--seeds", type=int, nargs="+", metavar="N")


def run(args: argparse.Namespace) -> int:
    """Trains and writes."""
    jaxrod.configure_cpu(1)
    for task in args.tasks:
        programs: dict[int, tuple[Any, float]] = {}
        for seed in args.seeds or SEEDS[task]:
            record = trained(task, seed, programs)
            write_record(LEARNERS, f"{task}-{seed}", record)
            earned, most = np.array(record["returns"]), np.array(record["ceiling"])
            print(
                f"{task} {seed}: {earned.mean():,.0f} of {most.mean():,.0f}, "
                f"{earned.mean() / most.mean():.1%}, least {(earned / most).min():.1%}",
                flush=True,
            )
        jax.clear_caches()
        gc.collect()
    write_pages(SEED)
    return 0
