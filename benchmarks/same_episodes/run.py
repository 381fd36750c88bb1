"""Returns of a planner in the episodes of the best learners.

The planner is that of `optimum` with a single action. It holds this action for as long
as the learners hold theirs, because the random events of an episode depend on that
time. Runs in float32 on one core. Writes a record for each task into records, then
docs/optimum.md.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

import jaxrod
from benchmarks.best_learners.run import CLIMB, EPISODES, EPISODES_SEED
from benchmarks.optimum.page import SAME, write_pages
from benchmarks.optimum.run import HELD, SEED
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import write_record
from jaxrod.control import mpc
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import evaluate

TASKS = ("tracking", "reaching")


def planned(task: str) -> dict[str, Any]:
    """The record of a task."""
    held = CLIMB["action_repeat"]
    policy = mpc(make(task, variant="clean"), **HELD | {"hold": held, "replan": held})
    found = evaluate(
        make(task, variant="clean"),
        policy,
        episodes=EPISODES[task],
        seed=EPISODES_SEED,
    )
    return {
        "task": task,
        "episodes_seed": EPISODES_SEED,
        "hold": held,
        "returns": np.asarray(found.returns).tolist(),
        "flagged": int(found.flagged.sum()),
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks same_episodes {task}",
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tasks."""
    add_names(parser, "tasks", TASKS, "TASK")


def run(args: argparse.Namespace) -> int:
    """Plans and writes."""
    jaxrod.configure_cpu(1)
    for task in args.tasks:
        record = planned(task)
        write_record(SAME, task, record)
        print(f"{task}: {np.mean(record['returns']):,.0f}", flush=True)
    write_pages(SEED)
    return 0
