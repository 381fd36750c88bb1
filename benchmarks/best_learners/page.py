"""Tables of the returns of the best learners, a section of docs/optimum.md."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxrod.files import read_json

SECTION = """
## Best learner of each task

`python -m benchmarks best_learners` trains the best learner that we know for each task.
If a row names two learners, the second starts from the policy of the first
(`jaxrod.training.warm_start`). In `tracking` and `reaching` the final policy acts
without noise in {episodes} episodes (seed {seed} of `evaluate`). In `structured` and
`unstructured` nothing is random. All their episodes are identical, so a few suffice.

We chose the settings by runs with seed 100 in other episodes (seed 1). Exceptions are
the earlier settings of `dagger` ([seed 0](first_order.md)), those of PPO in the
obstacle tasks ([seed 10](../benchmarks/clean/tried.md)), and those listed below.

| column | meaning |
|---|---|
| learners | each learner with its number of control steps |
| score | mean over the seeds, with the smallest and largest in brackets |
| share | mean return divided by the mean ceiling of the same episodes |
| shares of the seeds | smallest and largest share of a seed |
| largest deviation | of a seed's score from the mean of all seeds |
| lowest share | the lowest share of the ceiling in any episode of any seed |
| below half | episodes with a return below half of their ceiling |

If a target is so far out of reach that the ceiling is not positive, the episode counts
in the scores but in no share. Times are those of training, including compiling.

| task | learners | seeds | score | share | shares of the seeds | largest deviation \
| lowest share | below half | processor [s] |
|---|---|---:|---:|---:|---:|---:|---:|---:|---:|
"""
EVERY = """
### Every seed

"No ceiling" is the number of episodes whose ceiling is not positive. "Flagged" is the
number of episodes that a health flag marked. "First learner" is the score of the first
learner's policy, in the 64 episodes of seed 1.

| task | seed | score | share | lowest share | below half | no ceiling | flagged \
| first learner | processor [s] | of which compiling [s] |
|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|
"""
TRIED = """
Other runs of the same kind follow. Their policies act in the 64 episodes of seed 1,
unless noted:

- `tracking`, seeds 0 to 4 in the episodes of the table: with PPO for 20,000,000 control
  steps the mean score is 12,591 (12,275 to 12,872), or 91.8% of the ceilings. 22 of
  1,275 episodes are below half. With 600,000 control steps of `dagger` and then
  10,000,000 of PPO, the mean score is 12,440 (12,227 to 12,523), or 90.7%.
- `tracking`, seed 100: `dagger` reaches 11,482. From there PPO reaches 12,753 after
  5,000,000 control steps. With four `epochs` instead of eight it reaches 12,642 after
  10,000,000. With episodes of 1500 control steps for both learners (`short_length`),
  more targets start so close to a wall that they never move away from it. `dagger` then
  reaches 11,015, and PPO 12,646 after 6,000,000.
- `tracking`, seed 100, PPO alone, with `action_repeat` 4, `rollout_steps` 64,
  `discount` 0.97 and two layers of 128: it reaches 11,599 after 4,000,000 of 20,000,000
  control steps and 67 s of processor time. We stopped the run there.
- `reaching`, seed 0 in the episodes of the table: with 600,000 control steps of
  `dagger` and then 6,000,000 of PPO (`learning_rate` 3e-4) the score is 6,055. In the
  64 episodes `dagger` alone [reaches 6,295](first_order.md) with 1,500,000 control
  steps, as a mean of five seeds. The table above shows the gain by PPO for each seed.
- `reaching`, seed 100: `dagger` reaches 5,401. With 5,000,000 further control steps PPO
  reaches 6,546. At first its score falls, to 4,726 after a third of these steps,
  because its value function is untrained.
- `structured` and `unstructured`, seed 100: PPO with 3,000,000 control steps reaches
  6,990 and 6,981.
"""


def section(folder: Path, tasks: dict[str, int]) -> str:
    """The section, from the records in a folder; empty without records.

    Args:
        folder: holds a record of every run.
        tasks: names and numbers, in the order of the page.
    """
    known = [read_json(file) for file in sorted(folder.glob("*.json"))]
    if not known:
        return ""
    first = known[0]
    told = SECTION.format(
        episodes=max(len(record["returns"]) for record in known),
        seed=first["episodes_seed"],
    )
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
    machines = sorted({record["machine"] for record in known})
    return told + every + f"\nMeasured on: {'; '.join(machines)}.\n" + settings + TRIED


def _seed(run: dict[str, Any]) -> dict[str, Any]:
    """Result of a run."""
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
