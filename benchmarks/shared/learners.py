"""Runs of learners with several seeds, one after another, with a record of each."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jaxrod
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import write_record
from jaxrod.envs import Environment
from jaxrod.training import evaluate, with_noise

SEEDS = (0, 1, 2)
STEPS = 10_000_000
EPISODES = {"episodes": 64, "seed": 2}
"""Number of episodes that count, and their seed, which no training used."""


def add_run_arguments(
    parser: argparse.ArgumentParser, known: Iterable[str], metavar: str
) -> None:
    """Declares the names of runs, seeds and steps."""
    add_names(parser, "names", known, metavar)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, metavar="N")
    parser.add_argument("--steps", type=int, default=STEPS, help="control steps")


def returns(env: Environment, policy: Any) -> dict[str, float]:
    """Mean returns of a policy in the counted episodes, without and with its noise.

    A policy that learned without noise has no return with noise.
    """
    quiet = evaluate(env, policy, **EPISODES)
    found = {
        "return_without_noise": quiet.mean,
        "flagged": quiet.flagged_fraction,
    }
    if policy.action_std is None:
        return found
    return found | {
        "return_with_noise": evaluate(env, with_noise(policy), **EPISODES).mean
    }


def run_all(
    args: argparse.Namespace,
    trained: Callable[[str, int, int], dict[str, Any]],
    records: Path,
) -> int:
    """Trains with every name and seed on one core, and writes a record of each run.

    Args:
        args: Arguments of `add_run_arguments`.
        trained: Function (name, seed, control steps) -> record.
        records: Folder of the records.
    """
    jaxrod.configure_cpu(1)
    for name in args.names:
        for seed in args.seeds:
            record = trained(name, seed, args.steps)
            write_record(records, f"{name}-{seed}-{args.steps}", record)
            shown = {key: record[key] for key in record if key != "rows"}
            print(json.dumps(shown), flush=True)
    return 0
