"""Quotes of records of learners."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from benchmarks.numbers.quoting import Quote
from benchmarks.numbers.records import (
    CASES,
    LEARNERS,
    cells,
    digits,
    mean,
    numbers,
    published,
    read,
    rows,
    value,
    whole,
)
from benchmarks.shared.files import ROOT

README = "README.md"
CLAIMS = "docs/claims.md"
LEARNING = "docs/learning.md"


def quotes() -> Iterator[Quote]:
    """All quotes of this file."""
    yield from tracking()
    yield from grid()
    yield from clean()
    yield from best_learners()
    yield from quiet_policies()


def every_run(title: str, runs: list[Any], steps: str, score: str) -> Quote:
    """A row in the table of all runs of PPO on the published task."""
    scores = [float(run[score]) for run in runs]
    (made,) = {int(run[steps]) for run in runs}
    return Quote(
        LEARNING,
        f"{title} | {{}} | {{}} | {{}} | {{}} | {{}} |",
        (whole(made), *map(whole, [*scores, mean(scores)])),
    )


def tracking() -> Iterator[Quote]:
    """PPO on the published task."""
    folder = "benchmarks/training/records/tracking"
    runs = [read(f"{folder}/paper-ppo-{seed}/summary.json") for seed in range(3)]
    paper = published(1, "PPO")
    scores = [run["final_score"] for run in runs]
    minutes = [run["wall_s"] / 60 for run in runs]
    score, std = float(paper["final_mean"]), float(paper["final_std"])
    hours = f"{float(paper['wall_hours']):.1f}"
    yield Quote(
        README,
        "return {} after {} minutes; the paper reports {} after {} hours",
        (whole(mean(scores)), f"{mean(minutes):.1f}", whole(score), hours),
    )
    four = [*scores, mean(scores)]
    yield Quote(
        LEARNING,
        "| final score | {} | {} | {} | {} | {} ± {} |",
        (*map(whole, four), whole(score), whole(std)),
    )
    four = [*minutes, mean(minutes)]
    yield Quote(
        LEARNING,
        "| wall-clock | {} min | {} min | {} min | {} min | {} h |",
        (*(f"{one:.1f}" for one in four), hours),
    )
    yield every_run(
        "25 November 2026 | two, AMD EPYC", runs, "env_steps", "final_score"
    )
    for words, key in (("without", "loop_steps_per_s"), ("with", "steps_per_s")):
        rates = [run[key] for run in runs]
        yield Quote(
            LEARNING,
            f"| control steps per second, {words} compiling "
            "| {} | {} | {} | {} |",
            tuple(whole(one, 100) for one in (*rates, mean(rates))),
        )


def grid() -> Iterator[Quote]:
    """The published grid."""
    walls, ratios = {}, {}
    for case, task in CASES.items():
        shown = []
        for learner in LEARNERS:
            runs = rows(
                "benchmarks/paper/records/results.csv",
                case=f"Case{case}",
                algorithm=learner,
            )
            paper = published(case, learner)
            wall = mean(float(run["wall_s"]) for run in runs)
            walls[case, learner] = wall / 60
            ratios[case, learner] = 3600 * float(paper["wall_hours"]) / wall
            shown.append(whole(mean(float(run["final_score"]) for run in runs)))
            shown.append(whole(float(paper["final_mean"])))
        yield Quote(
            LEARNING,
            f"| {case} `{task}` |" + " {} ({}) |" * len(LEARNERS),
            tuple(shown),
        )
    yield Quote(
        LEARNING,
        "Averaged over three seeds, a run takes {} to {} minutes",
        (f"{min(walls.values()):.1f}", f"{max(walls.values()):.1f}"),
    )
    policy = [r for (_, name), r in ratios.items() if name in ("PPO", "TRPO")]
    others = [r for (_, name), r in ratios.items() if name not in ("PPO", "TRPO")]
    yield Quote(
        LEARNING,
        "Runs of PPO and TRPO are {} to {} times as fast as in the paper. Runs of the "
        "other learners are {} to {} times as fast",
        tuple(whole(x) for x in (min(policy), max(policy), min(others), max(others))),
    )
    yield Quote(
        CLAIMS,
        "runs are {} to {} times as fast",
        (whole(min(ratios.values())), whole(max(ratios.values()))),
    )
    runs = rows("benchmarks/paper/records/results.csv", case="Case1", algorithm="PPO")
    yield every_run("one, AMD EPYC", runs, "env_steps", "final_score")


def clean() -> Iterator[Quote]:
    """The grid in the library's own physics."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    folder = ROOT / "benchmarks" / "clean" / "records" / "cells"
    for file in sorted(folder.glob("*.json")):
        record = read(str(file.relative_to(ROOT)))
        found[record["case"], record["algorithm"]].append(record)
    every = [record for runs in found.values() for record in runs]
    yield Quote(
        LEARNING,
        "marked any of the {} complete training episodes",
        (whole(sum(record["episodes"] for record in every)),),
    )
    for (case, learner), runs in found.items():
        scores = [run["final_score"] for run in runs]
        quiet = [run["evaluation_score"] for run in runs]
        title = f"Case {case[-1]} `{CASES[int(case[-1])]}`"
        shown = mean(scores), min(scores), max(scores), min(quiet), max(quiet)
        yield Quote(
            LEARNING,
            f"| {title} | {learner} | {{}} ({{}} to {{}}) | {{}} to {{}} |",
            tuple(map(whole, shown)),
        )


def best_learners() -> Iterator[Quote]:
    """The best learner of each task, from the page that its program writes."""
    page = "docs/optimum.md"
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    planned = []
    for case, task in ((1, "tracking"), (2, "reaching")):
        (line,) = [x for x in lines if x.startswith(f"| {case} `{task}` | `dagger` ")]
        row = line.split("|")
        steps = sum(map(value, numbers(row[2])))
        least, most = numbers(row[6])
        below, episodes = numbers(row[9])
        yield Quote(
            LEARNING,
            f"| `{task}` | DAgger, then PPO from its policy | {{}} | {{}} "
            "| {} % ({} to {} %) | {} of {} |",
            (
                digits(steps / 1e6, 3).removesuffix(".0"),
                row[10].strip(),
                numbers(row[5])[0],
                least,
                most,
                below,
                whole(value(episodes)),
            ),
        )
        planned.append(numbers(cells(page, f"{case} `{task}`", "256")[3])[0])
    yield Quote(
        LEARNING,
        "It reaches {} % of the ceiling in `tracking` and {} % in `reaching`",
        tuple(planned),
    )


def quiet_policies() -> Iterator[Quote]:
    """Returns with and without the noise of the training."""
    keys = ("in_training", "without_noise", "of_median", "with_noise")
    for task in ("tracking", "reaching"):
        for learner in ("trpo", "ppo"):
            name = f"{task}-{learner}-{{}}-10000000"
            runs = [
                read(f"benchmarks/quiet_policies/records/{name.format(seed)}.json")
                for seed in range(3)
            ]
            if (task, learner) == ("tracking", "ppo"):
                yield every_run(
                    "one, Intel Xeon", runs, "control_steps", "return_in_training"
                )
            shown = [run[f"return_{key}"] for key in keys for run in runs]
            yield Quote(
                LEARNING,
                f"| `{task}`, {learner.upper()} |" + " {}; {}; {} |" * len(keys),
                tuple(map(whole, shown)),
            )
