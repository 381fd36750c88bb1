"""Returns of learners, planners and a script in the task `following`.

Learners (`dagger`, `ppo`) train with one seed after another. `random` draws random
actions. Planners (`held-3`, `line-10` and others; `planned` runs all) plan with a model
of the arm. `script` moves straight towards the target. All run in float32 on one core,
on the same episodes. Writes a record of every run except the script's into records.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import jaxrod
from benchmarks.following.learned import (
    EPISODES,
    LEARNERS,
    SEEDS,
    act_at_random,
    trained,
)
from benchmarks.following.planned import PLANNERS, plan
from benchmarks.following.script import act_by_script
from benchmarks.shared.arguments import add_names


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the policies and planners."""
    known = (*LEARNERS, "random", "script", "planned", *PLANNERS)
    add_names(parser, "who", known, "WHO", default=LEARNERS)
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=SEEDS, metavar="N", help="of learners"
    )
    parser.add_argument(
        "--episodes",
        type=int,
        default=16,
        choices=range(1, EPISODES + 1),
        metavar="N",
        help="of planners (16)",
    )


def run(args: argparse.Namespace) -> int:
    """Trains, plans, plays and writes."""
    jaxrod.configure_cpu(1)

    def learn(name: str) -> None:
        for seed in args.seeds:
            trained(name, seed)

    def plan_all() -> None:
        for name in PLANNERS:
            plan(name, args.episodes)

    players: dict[str, Callable[[], None]] = {
        **{name: lambda name=name: learn(name) for name in LEARNERS},
        **{name: lambda name=name: plan(name, args.episodes) for name in PLANNERS},
        "planned": plan_all,
        "random": act_at_random,
        "script": act_by_script,
    }
    for name in args.who:
        players[name]()
    return 0
