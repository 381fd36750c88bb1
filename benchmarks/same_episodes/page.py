"""A table of a planner's returns in the learners' episodes, for docs/optimum.md."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxrod.files import read_json

SAME = """
### Comparison with a planner in the same episodes

An untrained planner acts in the same episodes (`python -m benchmarks same_episodes`).
It plans one action and holds it for {hold} control steps, as the learners do. Its
return shows what the arm can achieve: if learners score less, the cause is not the
arm's reach or strength.

| column | meaning |
|---|---|
| below half | episodes in which the planner's return is below half of the ceiling |
| all seeds below half | episodes in which the policies of all seeds are below half |
| of which planned | those of them in which the planner is above half |
| half of the loss | fewest episodes that contain half of all return below the ceiling |

| task | episodes | planned | share | below half | learned | share \
| all seeds below half | of which planned | half of the loss |
|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|
"""


def same_episodes(learners: Path, folder: Path, tasks: dict[str, int]) -> str:
    """Returns of a planner in the learners' episodes; empty without records.

    Args:
        learners: holds a record of every run of the learners.
        folder: holds a record of every task that was planned.
        tasks: names and numbers, in the order of the page.
    """
    rows = ""
    hold = 0
    for task, case in tasks.items():
        file, runs = folder / f"{task}.json", sorted(learners.glob(f"{task}-*.json"))
        if not file.exists() or not runs:
            continue
        record = read_json(file)
        hold, planned = record["hold"], np.array(record["returns"])
        known = [read_json(run) for run in runs]
        most = np.array(known[0]["ceiling"])
        earned = np.array([one["returns"] for one in known])
        there = most > 0
        short = there & np.all(earned < 0.5 * most, axis=0)
        lacking = np.sort(np.maximum(most - earned.mean(axis=0), 0))[::-1]
        half = int(np.searchsorted(np.cumsum(lacking), 0.5 * lacking.sum())) + 1
        rows += (
            f"| {case} `{task}` | {most.size} | {planned.mean():,.0f} "
            f"| {planned.mean() / most.mean():.1%} "
            f"| {np.sum(there & (planned < 0.5 * most))} | {earned.mean():,.0f} "
            f"| {earned.mean() / most.mean():.1%} | {short.sum()} "
            f"| {np.sum(short & (planned >= 0.5 * most))} | {half} |\n"
        )
    return SAME.format(hold=hold) + rows if rows else ""
