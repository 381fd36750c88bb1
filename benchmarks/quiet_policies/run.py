"""Returns of TRPO without the noise of its training.

Trains TRPO on `tracking` or `reaching` (variant "paper") with the settings of the
published grid. The bound on the logarithm of the standard deviation falls from 0 to a
number, or is too large to matter (`none`). Each policy is then evaluated on the same
episodes without noise, and with the noise that it had at the end. Writes a record of
every run into records.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from benchmarks.paper.settings import GRID
from benchmarks.shared.learners import add_run_arguments, returns, run_all
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import TRPOConfig, train

RECORDS = Path(__file__).with_name("records")
LATE = {"max_log_std": 2.0, "final_max_log_std": -1.0}
"""Schedule that does not matter before about three quarters of the training."""
RUNS: dict[str, tuple[str, dict[str, float]]] = {
    "none": ("tracking", {}),
    "to-0.37": ("tracking", {"max_log_std": 0.0, "final_max_log_std": -1.0}),
    "to-0.14": ("tracking", {"max_log_std": 0.0, "final_max_log_std": -2.0}),
    "late-to-0.37": ("tracking", LATE),
    "reaching-none": ("reaching", {}),
    "reaching-late-to-0.37": ("reaching", LATE),
}
"""Task and settings by schedule, named after the standard deviation at the end."""


def trained(name: str, seed: int, steps: int) -> dict[str, Any]:
    """The record of a run."""
    task, schedule = RUNS[name]
    settings = dict(GRID[task]["trpo"].settings) | schedule
    config = dataclasses.replace(TRPOConfig(), **settings)
    env = make(task, variant="paper")
    result = train(
        env,
        "trpo",
        steps=steps,
        seed=seed,
        config=config,
        evaluation_episodes=0,
        progress=False,
    )
    return {
        "task": task,
        "schedule": name,
        "seed": seed,
        "control_steps": result.summary["env_steps"],
        "return_in_training": result.summary["final_score"],
        **returns(env, result.policy),
        "action_std": result.progress[-1]["action_std"],
        "wall_s": result.summary["wall_s"],
        "settings": settings,
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks quiet_policies {name} --seeds {seed} "
        f"--steps {steps}",
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares schedules, seeds and steps."""
    add_run_arguments(parser, RUNS, "SCHEDULE")


def run(args: argparse.Namespace) -> int:
    """Trains, plays and writes."""
    return run_all(args, trained, RECORDS)
