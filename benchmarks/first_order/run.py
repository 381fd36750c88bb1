"""Learning by gradients of the simulation compared with learning by rewards.

Trains PPO, DAgger and SHAC on the tasks `tracking` and `reaching` (variant "clean"), or
the cells that you name, with one seed after another, in float32 on one core. At
intervals it stops the clocks and evaluates the policy without noise, on the same
episodes for all. Writes a record of every run into records, and docs/first_order.md
with its picture from all records. `--pages` trains nothing and writes the page from the
records.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
from typing import Any

import jax
import numpy as np

import jaxrod
from benchmarks.first_order.page import RECORDS, write_pages
from benchmarks.shared.arguments import add_names
from benchmarks.shared.clocks import Clocks
from benchmarks.shared.files import write_record
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import evaluate, find_algorithm

SEEDS = (0, 1, 2, 3, 4)
EPISODES = 64
EPISODES_SEED = 1
"""Seed of the episodes on which policies are evaluated: that of `jaxrod evaluate`."""
POINTS = 8
"""Evaluations along a run, about; PPO's recorded runs have twice as many."""
STEPS: dict[str, dict[str, int]] = {
    "tracking": {"ppo": 10_000_000, "dagger": 1_000_000, "shac": 2_000_000},
    "reaching": {"ppo": 10_000_000, "dagger": 1_500_000, "shac": 2_000_000},
}
"""Control steps of a run."""
SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "tracking": {"ppo": {}, "dagger": {"plan_iterations": 2}, "shac": {}},
    "reaching": {
        "ppo": {},
        "dagger": {"short_steps": 1.0e9, "short_length": 480.0},
        "shac": {},
    },
}
"""Settings that differ from the learners' defaults."""


def trained(task: str, algorithm: str, seed: int, steps: int) -> dict[str, Any]:
    """The record of a run."""
    env = make(task, variant="clean")
    learner = find_algorithm(algorithm)
    config = dataclasses.replace(learner.config_type(), **SETTINGS[task][algorithm])
    learner.validate(config, 1)
    per_update = learner.steps_per_update(config)
    updates = -(-steps // per_update)
    chunk = max(1, updates // POINTS)
    clocks = Clocks()

    params = env.default_params()
    start = jax.jit(learner.init, static_argnums=(1, 4))
    state = start(jax.random.key(seed), env, config, params, updates * per_update)
    update = jax.jit(learner.update, donate_argnums=0)
    update = update.lower(state).compile()
    jax.block_until_ready(state)
    compiling = clocks.read()

    rows, simulated, done = [], 0.0, 0
    while done < updates:
        metrics = None
        for _ in range(min(chunk, updates - done)):
            state, metrics = update(state)
            simulated += float(metrics.scalars.get("model_steps", 0.0))
            done += 1
        wall, cpu = clocks.read()
        clocks.stop()
        found = evaluate(
            env, learner.policy(state), episodes=EPISODES, seed=EPISODES_SEED
        )
        rows.append(
            {
                "control_steps": done * per_update,
                "model_steps": simulated,
                "wall_s": wall,
                "processor_s": cpu,
                "return": found.mean,
                "deviation": found.standard_deviation,
                "flagged": float(found.flagged_fraction),
            }
        )
        print(
            f"{task} {algorithm} {seed}: {done * per_update:,} steps, {wall:.0f} s, "
            f"processor {cpu:.0f} s, {found.mean:,.0f}",
            flush=True,
        )
        clocks.go()
    return {
        "task": task,
        "algorithm": algorithm,
        "seed": seed,
        "settings": SETTINGS[task][algorithm],
        "compile_s": compiling[0],
        "compile_processor_s": compiling[1],
        "episodes": EPISODES,
        "returns": np.asarray(found.returns).tolist(),
        "rows": rows,
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks first_order {task}:{algorithm} "
        f"--seeds {seed}",
    }


CELLS = [f"{task}:{name}" for task, known in STEPS.items() for name in known]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the cells and seeds."""
    add_names(parser, "cells", CELLS, "TASK:ALGORITHM")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, metavar="N")
    parser.add_argument(
        "--pages", action="store_true", help="write the page from the records"
    )


def run(args: argparse.Namespace) -> int:
    """Trains and writes."""
    jaxrod.configure_cpu(1)
    for seed in args.seeds:
        for cell in () if args.pages else args.cells:
            task, name = cell.split(":")
            record = trained(task, name, seed, STEPS[task][name])
            write_record(RECORDS, f"{task}-{name}-{seed}", record)
            jax.clear_caches()
            gc.collect()
    write_pages()
    return 0
