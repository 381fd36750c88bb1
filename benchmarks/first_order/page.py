"""Page and picture of learning by gradients, from the records."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from benchmarks.shared.files import ROOT
from jaxrod.files import read_json, write_atomically
from jaxrod.viz.style import BLUE, GREEN, ORANGE, charts

RECORDS = ROOT / "benchmarks" / "first_order" / "records"
CASES = {"tracking": 1, "reaching": 2}
COLOURS = {"ppo": ORANGE, "dagger": BLUE, "shac": GREEN}
BASELINE = "ppo"

HEADER = """\
# Learning by gradients

Written by `python -m benchmarks first_order`; do not edit.

This page compares two learners. `dagger` ([algorithms](algorithms.md)) trains a network
to imitate a planner, and the planner differentiates the simulation. `ppo` learns from
rewards alone. Both learn Cases 1 and 2 in the variant `clean`, in float32 on one core.
A score is the mean return of a policy without noise. All policies act in the same
{episodes} episodes (seed 1 of `evaluate`).

The table gives means over the seeds, and the smallest and largest score in brackets.
Times are those of training: they include compiling, but not evaluation. Other programs
ran on the same machine, so trust processor time more than wall-clock time. **Model
steps** are the control steps that the planner simulates, in addition to those in which
the policy acts. They do not include backward passes.

![Score against steps and time](../benchmarks/first_order/records/first_order.png)

"""
TRIED = """
## Other runs

The policies of these runs act in the same episodes:

- `dagger` in `reaching` with 1,000,000 control steps: seeds 0 to 4 reach 5,965, 5,906,
  5,822, 6,328 and 5,841, in 82 to 92 s of processor time.
- `dagger` in `tracking` with `plan_iterations` 1 instead of 2: seed 0 reaches 8,854
  after 1,007,616 control steps.
- `shac` in `reaching` with its default settings: seed 0 reaches 1,159 after 2,002,944
  control steps and 80 s of processor time, of which compiling takes 51 s. PPO reaches
  more in less time. We tried no other settings of `shac` on arms, and did not try
  `tracking`.

`python -m benchmarks first_order TASK:ALGORITHM --seeds 0` repeats a run.
"""
COLUMNS = (
    "task",
    "learner",
    "seeds",
    "score",
    "control steps",
    "model steps",
    "processor [s]",
    "of which compiling [s]",
    "wall-clock [s]",
)
REACHED = """
## Cost of PPO's final score

How much does `dagger` need to reach the mean of PPO's final scores? For each seed we
take the first evaluation with at least this score. The table gives means over the seeds
that reach it, and the largest value in brackets. A share is the mean divided by the
mean of PPO's whole runs.

"""
REACHED_COLUMNS = (
    "task",
    "learner",
    "PPO's score",
    "seeds that reach it",
    "control steps",
    "share",
    "processor [s]",
    "share",
    "wall-clock [s]",
    "share",
)
SEEDS = """
## Every seed

| task | learner | seed | score | standard deviation of its episodes | flagged |
|---|---|---:|---:|---:|---:|
"""


Cells = dict[tuple[str, str], list[dict[str, Any]]]
"""Records of the runs of each task and learner."""


def recorded() -> Cells:
    """The records there are."""
    records = [read_json(file) for file in sorted(RECORDS.glob("*.json"))]
    return {
        (task, name): found
        for task in CASES
        for name in COLOURS
        if (found := [r for r in records if _of(r) == (task, name)])
    }


def write_pages() -> None:
    """Writes the page and its picture from the records there are."""
    cells = recorded()
    if not cells:
        return
    write_atomically(ROOT / "docs" / "first_order.md", text(cells).encode())
    picture(cells)


def text(cells: Cells) -> str:
    """The page of records."""
    records = [record for runs in cells.values() for record in runs]
    page = HEADER.format(episodes=records[0]["episodes"]) + _head(COLUMNS)
    reached, seeds = REACHED + _head(REACHED_COLUMNS), SEEDS
    for (task, name), runs in cells.items():
        head = f"| {CASES[task]} `{task}` | `{name}` "
        last = [run["rows"][-1] for run in runs]
        page += (
            f"{head}| {len(runs)} | {_spread(row['return'] for row in last)} "
            f"| {_mean(last, 'control_steps'):,.0f} "
            f"| {_mean(last, 'model_steps'):,.0f} "
            f"| {_mean(last, 'processor_s'):.0f} "
            f"| {_mean(runs, 'compile_processor_s'):.0f} "
            f"| {_mean(last, 'wall_s'):.0f} |\n"
        )
        for run, row in zip(runs, last, strict=True):
            seeds += (
                f"{head}| {run['seed']} | {row['return']:,.0f} "
                f"| {row['deviation']:,.0f} | {row['flagged']:.0%} |\n"
            )
        if name != BASELINE and (task, BASELINE) in cells:
            reached += head + _reached(runs, cells[task, BASELINE])
    machines = sorted({record["machine"] for record in records})
    reached += f"\nMeasured on: {'; '.join(machines)}.\n"
    settings = "\n## Settings that are not the defaults\n\n"
    for (task, name), runs in cells.items():
        told = {json.dumps(run["settings"]) for run in runs}
        settings += f"- `{name}` in `{task}`: {', '.join(sorted(told))}\n"
    return page + reached + seeds + settings + TRIED


def _reached(runs: list[dict[str, Any]], baseline: list[dict[str, Any]]) -> str:
    """The end of a row: what it takes to score as the baseline does in the end."""
    ends = [run["rows"][-1] for run in baseline]
    score = _mean(ends, "return")
    firsts = [
        next((row for row in run["rows"] if row["return"] >= score), None)
        for run in runs
    ]
    there = [row for row in firsts if row is not None]
    line = f"| {score:,.0f} | {len(there)} of {len(runs)} "
    for key in ("control_steps", "processor_s", "wall_s"):
        if there:
            share = _mean(there, key) / _mean(ends, key)
            line += f"| {_spread((r[key] for r in there), least=False)} | {share:.2f} "
        else:
            line += "| — | — "
    return line + "|\n"


def _head(columns: tuple[str, ...]) -> str:
    """The first two lines of a table, numbers to the right from the third column."""
    rule = "|---|---" + "|---:" * (len(columns) - 2)
    return f"| {' | '.join(columns)} |\n{rule}|\n"


def _of(record: dict[str, Any]) -> tuple[str, str]:
    return record["task"], record["algorithm"]


def _mean(rows: list[dict[str, Any]], key: str) -> float:
    return float(np.mean([row[key] for row in rows]))


def _spread(values: Iterable[float], *, least: bool = True) -> str:
    """Mean, and the smallest and the largest, or the largest alone, in brackets."""
    found = np.array(list(values))
    smallest = f"{found.min():,.0f} to " if least else ""
    return f"{found.mean():,.0f} ({smallest}{found.max():,.0f})"


def picture(cells: Cells) -> None:
    """Score against control steps and processor time, every seed."""
    tasks = [task for task in CASES if any(cell[0] == task for cell in cells)]
    figure, panels = charts(9, 3.2 * len(tasks), len(tasks), 2)
    for left, right in panels:
        right.sharey(left)
        right.tick_params(labelleft=False)
    axes_of = {"control_steps": "control steps", "processor_s": "processor time [s]"}
    for (task, name), runs in cells.items():
        for axes, (key, words) in zip(
            panels[tasks.index(task)], axes_of.items(), strict=True
        ):
            for number, run in enumerate(runs):
                axes.plot(
                    [row[key] for row in run["rows"]],
                    [row["return"] for row in run["rows"]],
                    color=COLOURS[name],
                    linewidth=1,
                    label=None if number else name,
                )
            axes.set_xscale("log" if key == "control_steps" else "linear")
            axes.set_xlabel(words)
    for task, row in zip(tasks, panels, strict=True):
        row[0].set_ylabel(f"{task}: return without noise")
        row[0].legend()
    figure.savefig(RECORDS / "first_order.png", metadata={"Software": None})
