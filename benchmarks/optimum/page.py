"""Page and picture of the ceilings of tasks, from the records."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.best_learners.page import section
from benchmarks.same_episodes.page import same_episodes
from benchmarks.shared.files import ROOT
from jaxrod.files import read_json, write_atomically
from jaxrod.viz import style

RECORDS = ROOT / "benchmarks" / "optimum" / "records"
LEARNERS = ROOT / "benchmarks" / "best_learners" / "records"
SAME = ROOT / "benchmarks" / "same_episodes" / "records"
CASES = {"tracking": 1, "reaching": 2, "structured": 3, "unstructured": 4}
PLANS = ("", "held")
"""Plan of a task: the line through knots that `mpc` makes by default, or one action."""


def learners(case: int) -> list[tuple[str, float, int]]:
    """Recorded learners: name, mean noise-free return, seeds; the best of a variant."""
    found: dict[tuple[str, str], list[float]] = {}
    for folder in ("clean", "paper"):
        cells = ROOT / "benchmarks" / folder / "records" / "cells"
        for file in sorted(cells.glob("*.json")):
            cell = read_json(file)
            score = cell.get("evaluation_score")
            if cell["case"] == f"Case{case}" and score is not None:
                key = cell["algorithm"], cell["variant"]
                found.setdefault(key, []).append(score)
    best: dict[str, tuple[str, float, int]] = {}
    for (algorithm, variant), scores in found.items():
        mean = float(np.mean(scores))
        if variant not in best or mean > best[variant][1]:
            best[variant] = (f"{algorithm} ({variant})", mean, len(scores))
    return [best[variant] for variant in ("clean", "paper") if variant in best]


HEADER = """\
# How good is good: ceilings of the arm tasks

Written by `python -m benchmarks optimum`; do not edit.

How much of the highest possible return does a planner reach in each task of the arm,
and how much does a learner reach? The table compares mean returns in the variant
`clean`. `python -m benchmarks optimum TASK` measures a row. All columns but *learned*
use the same episodes (seed {seed} of `evaluate`). Their random events depend on the
duration of actions, so the ceiling of a *held* row can differ.

- **ceiling**: the return of an arm whose tip is always on the target, or as close to it
  as the arm's length allows. In `reaching` the tip also has the goal's orientation. The
  ceiling is computed for each episode. It ignores the way to the target, the clamp at
  the base and the limited strength of muscles, and no known policy reaches it. It is
  not a strict bound, because a swinging arm stretches by a few percent.
- **planned**: the return of `jaxrod.control.mpc`, without training. It plans with the
  rod itself and does not know random events in advance. In the rows *held* a plan has
  only one action (`python -m benchmarks optimum TASK_held`).
- **share**: the mean return of the planner, divided by the mean ceiling.
- **lowest share**: the lowest share of the ceiling in any episode.
- **random**: the return of random actions, redrawn as often as the planner acts.
- **learned**: the return of the best learner in each recorded grid, without exploration
  noise. The best learner is the one with the highest mean over its seeds. Learners
  acted in other episodes, and in the variant `paper` also under the published physics.
  Their shares are relative to the mean ceiling in this table.

![Shares of the ceiling](../benchmarks/optimum/records/optimum.png)

| task | episodes | ceiling | planned | share | lowest share | random | learned |
|---|---:|---:|---:|---:|---:|---:|---|
"""
TIMES = """
## Time of a plan

The table gives processor time on one core, and the time of compiling separately. To act
in real time, the planner must finish a plan within its period. In this benchmark the
simulation waits for the plan. For a single arm, lanes run those parts of a plan that
are batches (rows of the Jacobian, samples), and XLA runs the rest.

| task | period [ms] | a plan in a batch [ms] | a plan for a single arm [ms] \
| compiling [s] |
|---|---:|---:|---:|---:|
"""
SETTINGS = """
## Settings

`jaxrod.control.mpc` explains the settings. `horizon`, `replan` and `hold` count control
steps, and a control step takes 1.4 ms. The planner minimises the cost of the task
([planning](planning.md)), not its reward.

| task | {} |
|---|{}
"""
NAMES = (
    "method",
    "shape",
    "horizon",
    "knots",
    "replan",
    "hold",
    "iterations",
    "first",
    "starts",
    "effort",
    "smoothness",
)


def recorded() -> list[dict[str, Any]]:
    """The records there are."""
    return [
        read_json(file)
        for task in CASES
        for plan in PLANS
        if (file := RECORDS / f"{task}{plan and '_' + plan}.json").exists()
    ]


def write_pages(seed: int) -> None:
    """Writes the page and its picture from the records."""
    records = recorded()
    if not records:
        return
    write_atomically(ROOT / "docs" / "optimum.md", text(records, seed).encode())
    picture(records)


def text(records: list[dict[str, Any]], seed: int) -> str:
    """The page of records."""
    page = HEADER.format(seed=seed)
    times = TIMES
    settings = SETTINGS.format(" | ".join(NAMES), "---:|" * len(NAMES))
    for record in records:
        planned, ceiling = np.array(record["mpc"]), np.array(record["ceiling"])
        mean = ceiling.mean()
        known = "; ".join(
            f"{name} {score:,.0f} ({score / mean:.1%}, {seeds} seeds)"
            for name, score, seeds in learners(record["case"])
        )
        flagged = record["mpc_flagged"]
        title = f"{record['case']} `{record['task']}`{_spaced(record['plan'])}"
        page += (
            f"| {title} | {record['episodes']} "
            f"| {mean:,.0f} | {planned.mean():,.0f}"
            f"{f', {flagged} flagged' if flagged else ''} "
            f"| {planned.mean() / mean:.1%} | {np.min(planned / ceiling):.1%} "
            f"| {np.mean(record['random']):,.0f} | {known} |\n"
        )
        times += (
            f"| {title} | {record['period_ms']:.1f} "
            f"| {record['plan_ms']:.1f} | {record['single_plan_ms']:.1f} "
            f"| {record['compile_s']:.0f} |\n"
        )
        values = " | ".join(_shown(record["settings"][name]) for name in NAMES)
        settings += f"| {title} | {values} |\n"
    machines = sorted({record["machine"] for record in records})
    measured_on = f"\nMeasured on: {'; '.join(machines)}.\n"
    page += section(LEARNERS, CASES) + same_episodes(LEARNERS, SAME, CASES)
    return page + times + measured_on + settings


def _spaced(plan: str) -> str:
    return f", {plan}" if plan else ""


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def picture(records: list[dict[str, Any]]) -> None:
    """Bars of the shares of the ceiling."""
    figure, ((axes,),) = style.charts(8, 3.6)
    own = {(r["task"], r["plan"]): r for r in records}
    tasks = [task for task in CASES if any(r["task"] == task for r in records)]
    some = [next(r for r in records if r["task"] == task) for task in tasks]
    kinds: list[tuple[str, str, list[float]]] = [
        ("random", style.GRID, [_share(r, np.mean(r["random"])) for r in some]),
        *(
            (f"learned {words}", colour, [_share(r, _learned(r, words)) for r in some])
            for words, colour in (("(paper)", style.ORANGE), ("(clean)", style.PURPLE))
        ),
    ]
    for plan, colour in zip(PLANS, (style.BLUE, style.GREEN), strict=True):
        found = [own.get((task, plan)) for task in tasks]
        shares = [_share(r, np.mean(r["mpc"])) if r else np.nan for r in found]
        kinds.append(("planned" + _spaced(plan), colour, shares))
    for place, (name, colour, shares) in enumerate(kinds):
        bars = axes.bar(
            np.arange(len(tasks)) + 0.17 * (place - 2),
            np.maximum(np.nan_to_num(shares), 0),
            0.15,
            color=colour,
            label=name,
        )
        words = ["" if np.isnan(share) else f"{share:.0f}" for share in shares]
        axes.bar_label(bars, words, fontsize=8)
    axes.set_xticks(range(len(tasks)), tasks)
    axes.set_ylabel("share of the ceiling [%]")
    axes.set_ylim(0, 112)
    axes.axhline(100, color="black", linewidth=0.8)
    axes.legend(ncols=5, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes.grid(visible=False, axis="x")
    figure.savefig(RECORDS / "optimum.png", metadata={"Software": None})


def _share(record: dict[str, Any], earned: Any) -> float:
    return float(100 * earned / np.mean(record["ceiling"]))


def _learned(record: dict[str, Any], variant: str) -> float:
    scores = [s for name, s, _ in learners(record["case"]) if variant in name]
    return scores[0] if scores else float("nan")
