"""Returns of TRPO without the noise of its training.

TRPO on `tracking` (variant "paper") with the settings of the published grid. The bound
on the logarithm of the standard deviation falls from 0 to a number, or is so large that
it does not matter (`none`). Each policy then acts the same episodes without noise, and
with the noise that it had at the end. Writes a record of every run into records.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import jaxrod
from benchmarks.paper.settings import GRID
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import write_record
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import TRPOConfig, evaluate, train, with_noise

RECORDS = Path(__file__).with_name("records")
SEEDS = (0, 1, 2)
STEPS = 10_000_000
EPISODES = 64
EPISODES_SEED = 2
"""Seed of the counted episodes."""
SCHEDULES: dict[str, dict[str, float]] = {
    "none": {},
    "to-0.37": {"max_log_std": 0.0, "final_max_log_std": -1.0},
    "to-0.14": {"max_log_std": 0.0, "final_max_log_std": -2.0},
}
"""Settings by schedule, named after the standard deviation at the end."""


def trained(name: str, seed: int, steps: int) -> dict[str, Any]:
    """The record of a run."""
    settings = dict(GRID["tracking"]["trpo"].settings) | SCHEDULES[name]
    config = dataclasses.replace(TRPOConfig(), **settings)
    env = make("tracking", variant="paper")
    result = train(
        env,
        "trpo",
        steps=steps,
        seed=seed,
        config=config,
        evaluation_episodes=0,
        progress=False,
    )
    played = {"episodes": EPISODES, "seed": EPISODES_SEED}
    quiet = evaluate(env, result.policy, **played)
    noisy = evaluate(env, with_noise(result.policy), **played)
    return {
        "schedule": name,
        "seed": seed,
        "control_steps": result.summary["env_steps"],
        "return_in_training": result.summary["final_score"],
        "return_without_noise": quiet.mean,
        "return_with_noise": noisy.mean,
        "action_std": result.progress[-1]["action_std"],
        "wall_s": result.summary["wall_s"],
        "settings": settings,
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks quiet_policies {name} --seeds {seed} "
        f"--steps {steps}",
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares schedules, seeds and steps."""
    add_names(parser, "schedules", SCHEDULES, "SCHEDULE")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, metavar="N")
    parser.add_argument("--steps", type=int, default=STEPS, help="control steps")


def run(args: argparse.Namespace) -> int:
    """Trains, plays and writes."""
    jaxrod.configure_cpu(1)
    for name in args.schedules:
        for seed in args.seeds:
            record = trained(name, seed, args.steps)
            write_record(RECORDS, f"{name}-{seed}-{args.steps}", record)
            print(json.dumps(record), flush=True)
    return 0
