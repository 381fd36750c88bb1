"""Lets a planner act the very episodes in which the best learners fell short.

    python -m benchmarks.same_episodes [tracking reaching]

Randomness of an episode depends on how long actions are held, so the planner of
`benchmarks.optimum` that plans one action holds it as long as the learners hold theirs.
Writes a record for each task into benchmarks/optimum/same_episodes, then
docs/optimum.md. In float32 on one core.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np

import jaxrod
from benchmarks.best_learners import CLIMB, EPISODES, EPISODES_SEED
from benchmarks.optimum import HELD, SEED
from benchmarks.optimum_page import SAME, write_pages
from jaxrod.control import mpc
from jaxrod.envs import make
from jaxrod.files import write_atomically
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
        "command": f"python -m benchmarks.same_episodes {task}",
    }


def main(arguments: list[str]) -> int:
    """Plans and writes."""
    jaxrod.configure_cpu(1)
    if unknown := set(arguments) - set(TASKS):
        raise SystemExit(f"tasks are {', '.join(TASKS)}; got {', '.join(unknown)}")
    SAME.mkdir(parents=True, exist_ok=True)
    for task in arguments or TASKS:
        record = planned(task)
        write_atomically(
            SAME / f"{task}.json", (json.dumps(record, indent=1) + "\n").encode()
        )
        print(f"{task}: {np.mean(record['returns']):,.0f}", flush=True)
    write_pages(SEED)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
