"""Training runs of PPO on seven tasks, a folder for each seed.

Each run is a call of `jaxrod train` in a separate process. The benchmark prints its
command first. It does not replace existing runs; `--out` names another folder.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from benchmarks.shared.arguments import add_names

RECORDS = Path(__file__).with_name("records")


class Runs(NamedTuple):
    """Runs of one task that differ in their seeds."""

    seeds: tuple[int, ...]
    """Seeds of the recorded runs."""
    words: str
    """Arguments of `jaxrod train`."""
    folder: str = "ppo"
    """Name of a run's folder, before its seed."""


TASKS = {
    "tracking": Runs(
        (0, 1, 2), "--variant paper --algorithm ppo --steps 10M", "paper-ppo"
    ),
    "snake": Runs((0, 1, 2), "--steps 600k"),
    "octopus": Runs((0, 1, 2), "--steps 150k --set rollout_steps=32"),
    "gripper": Runs(
        (20, 21, 22),
        "--steps 320k --devices 2 --set num_envs=64 --set rollout_steps=32 "
        "--set epochs=8 --set minibatches=8 --set learning_rate=5e-4 "
        "--set final_learning_rate=1e-4 --set entropy_weight=0.01 "
        "--set discount=0.95 --set trace_decay=0.9 --set initial_log_std=-0.5 "
        "--no-replay",
    ),
    "lift": Runs(
        (0, 1, 2),
        "--steps 1M --set num_envs=64 --set rollout_steps=32 --set epochs=8 "
        "--set minibatches=8 --set learning_rate=5e-4 "
        "--set final_learning_rate=1e-4 --set entropy_weight=0.01 "
        "--set discount=0.95 --set trace_decay=0.9 --set initial_log_std=-0.5 "
        "--no-replay",
    ),
    "insert": Runs(
        (0, 1, 2),
        "--steps 1M --set num_envs=64 --set rollout_steps=32 --set epochs=8 "
        "--set minibatches=8 --set learning_rate=5e-4 "
        "--set final_learning_rate=1e-4 --set entropy_weight=0.01 "
        "--set discount=0.95 --set trace_decay=0.9 --set initial_log_std=-0.5 "
        "--no-replay",
    ),
    "catheter": Runs(
        (0, 1, 2),
        "--steps 200k --set num_envs=64 --set rollout_steps=32 --set epochs=8 "
        "--set minibatches=8 --set learning_rate=5e-4 "
        "--set final_learning_rate=1e-4 --set entropy_weight=0.01 "
        "--set discount=0.95 --set trace_decay=0.9 --set initial_log_std=-0.5 "
        "--no-replay",
    ),
}


def commands(task: str, seeds: list[int], out: Path) -> Iterator[list[str]]:
    """Arguments of `jaxrod` for each run of a task; by default with its seeds."""
    runs = TASKS[task]
    for seed in seeds or runs.seeds:
        folder = out / task / f"{runs.folder}-{seed}"
        yield [
            *("train", task, *runs.words.split()),
            *("--seed", str(seed), "--out", str(folder)),
        ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tasks and seeds."""
    add_names(parser, "tasks", TASKS, "TASK")
    parser.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        default=[],
        metavar="N",
        help="(default: those of the records)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=RECORDS,
        metavar="DIR",
        help="folder of the runs (default: benchmarks/training/records)",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="print the commands, run nothing"
    )


def run(args: argparse.Namespace) -> int:
    """Trains one run after another; stops at the first failure."""
    for task in args.tasks:
        for words in commands(task, args.seeds, args.out):
            print(shlex.join(["jaxrod", *words]), flush=True)
            if args.dry_run:
                continue
            code = subprocess.run([sys.executable, "-m", "jaxrod", *words]).returncode
            if code:
                return code
    return 0
