"""The tables of `benchmarks/best_learners.py`, a section of docs/optimum.md."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

SECTION = """
## What the best learner of each task earns

`python -m benchmarks.best_learners` trains the learners that are known to bring a task
furthest, one after the other where there are two: the second begins with the policy of
the first (`jaxrod.training.beginning_with`). What is left acts {episodes} episodes
without noise (seed {seed} of `evaluate`; settings were chosen by seeds from 100 on and
by other episodes, those of seed 1). Nothing is random in `structured` and
`unstructured`: there all episodes are the same. **Share**: mean reward over mean
ceiling, of the same episodes; **from the mean**: the seed that is furthest from the
mean of all; **least share**: of all episodes of all seeds, each of its own ceiling;
**below half**: episodes that earn less than half of it. Episodes whose ceiling is not
positive, goals far out of reach, count in the scores alone. Times are of training,
compiling included.

| task | learners | seeds | score | share | of a seed | from the mean | least share \
| below half | processor [s] |
|---|---|---:|---:|---:|---:|---:|---:|---:|---:|
"""
EVERY = """
### Every seed

| task | seed | score | share | least share | below half | no ceiling | flagged \
| score of the first | processor [s] | of it compiling [s] |
|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|
"""


def section(folder: Path, tasks: dict[str, int]) -> str:
    """The section, from the records in a folder; empty where there are none.

    Args:
        folder: holds a record of every run.
        tasks: names and numbers, in the order in which they are told.
    """
    known = [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]
    if not known:
        return ""
    first = known[0]
    told = SECTION.format(episodes=len(first["returns"]), seed=first["episodes_seed"])
    every, settings = EVERY, "\nSettings that are not the defaults:\n\n"
    for task, case in tasks.items():
        runs = [record for record in known if record["task"] == task]
        if not runs:
            continue
        seeds = [_seed(run) for run in runs]
        scores = np.array([seed["score"] for seed in seeds])
        shares = [seed["share"] for seed in seeds]
        away = np.max(np.abs(scores / scores.mean() - 1))
        below = sum(seed["below"] for seed in seeds)
        counted = sum(seed["counted"] for seed in seeds)
        stages = runs[0]["stages"]
        names = ", then ".join(
            f"`{stage['algorithm']}` {stage['control_steps']:,}" for stage in stages
        )
        told += (
            f"| {case} `{task}` | {names} | {len(runs)} "
            f"| {scores.mean():,.0f} ({scores.min():,.0f} to {scores.max():,.0f}) "
            f"| {np.mean(shares):.1%} | {min(shares):.1%} to {max(shares):.1%} "
            f"| {away:.1%} | {min(seed['least'] for seed in seeds):.1%} "
            f"| {below} of {counted} | {np.mean([s['processor'] for s in seeds]):.0f} "
            "|\n"
        )
        for run, seed in zip(runs, seeds, strict=True):
            before = f"{run['stages'][0]['score']:,.0f}" if len(stages) > 1 else "—"
            every += (
                f"| {case} `{task}` | {run['seed']} | {seed['score']:,.0f} "
                f"| {seed['share']:.1%} | {seed['least']:.1%} | {seed['below']} "
                f"| {len(run['returns']) - seed['counted']} | {run['flagged']} "
                f"| {before} | {seed['processor']:.0f} "
                f"| {seed['compiling']:.0f} |\n"
            )
        for stage in stages:
            chosen = json.dumps(stage["settings"])
            settings += f"- `{stage['algorithm']}` in `{task}`: {chosen}\n"
    note = (
        '\n"Score of the first" is that of the first learner\'s policy in 64 episodes '
        "of seed 1.\n"
    )
    machines = sorted({record["machine"] for record in known})
    return told + every + note + f"\nMeasured on: {'; '.join(machines)}.\n" + settings


def _seed(run: dict[str, Any]) -> dict[str, Any]:
    """What a run comes to."""
    earned, most = np.array(run["returns"]), np.array(run["ceiling"])
    there = most > 0
    shares = earned[there] / most[there]
    return {
        "score": float(earned.mean()),
        "share": float(earned.mean() / most.mean()),
        "least": float(shares.min()),
        "below": int(np.sum(shares < 0.5)),
        "counted": int(there.sum()),
        "processor": sum(stage["processor_s"] for stage in run["stages"]),
        "compiling": sum(stage["compile_processor_s"] for stage in run["stages"]),
    }
