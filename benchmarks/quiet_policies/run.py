"""Returns of PPO and TRPO with and without the noise of their training.

Trains PPO and TRPO on `tracking` and `reaching` (variant "paper") with the settings of
the published grid. Each policy then acts in the same episodes with the mean of its
noisy, clipped actions, with their median, and with noise. In one run the bound on the
noise falls late in the training. Writes a record of every run into records.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from benchmarks.paper.settings import GRID
from benchmarks.shared.learners import EPISODES, add_run_arguments, returns, run_all
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import evaluate, find_algorithm, train

RECORDS = Path(__file__).with_name("records")
LATE = {"max_log_std": 2.0, "final_max_log_std": -1.0}
"""Schedule that does not matter before about three quarters of the training."""
RUNS: dict[str, tuple[str, str, dict[str, float]]] = {
    f"{task}-{algorithm}": (task, algorithm, {})
    for task in ("tracking", "reaching")
    for algorithm in ("trpo", "ppo")
} | {"tracking-trpo-to-0.37": ("tracking", "trpo", LATE)}
"""Task, algorithm, and settings that differ from those of the grid."""


def trained(name: str, seed: int, steps: int) -> dict[str, Any]:
    """The record of a run."""
    task, algorithm, schedule = RUNS[name]
    settings = dict(GRID[task][algorithm].settings) | schedule
    config = dataclasses.replace(find_algorithm(algorithm).config_type(), **settings)
    env = make(task, variant="paper")
    result = train(
        env,
        algorithm,
        steps=steps,
        seed=seed,
        config=config,
        evaluation_episodes=0,
        progress=False,
    )
    median = dataclasses.replace(result.policy, quiet_action="median")
    return {
        "task": task,
        "algorithm": algorithm,
        "seed": seed,
        "control_steps": result.summary["env_steps"],
        "return_in_training": result.summary["final_score"],
        **returns(env, result.policy),
        "return_of_median": evaluate(env, median, **EPISODES).mean,
        "action_std": result.progress[-1]["action_std"],
        "wall_s": result.summary["wall_s"],
        "settings": settings,
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks quiet_policies {name} --seeds {seed} "
        f"--steps {steps}",
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares runs, seeds and steps."""
    add_run_arguments(parser, RUNS, "RUN")


def run(args: argparse.Namespace) -> int:
    """Trains, plays and writes."""
    return run_all(args, trained, RECORDS)
