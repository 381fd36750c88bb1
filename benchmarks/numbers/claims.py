"""Quotes on the page of claims."""

from __future__ import annotations

import re
from collections.abc import Iterator

from benchmarks.numbers.quoting import Quote
from benchmarks.numbers.records import (
    CASES,
    LEARNERS,
    cells,
    column,
    digits,
    mean,
    published,
    rows,
    value,
    whole,
)
from benchmarks.numbers.speed import CABLE, H100, PERFORMANCE, SYSTEMS, factor, tuned
from benchmarks.shared.files import ROOT

CLAIMS = "docs/claims.md"


def quotes() -> Iterator[Quote]:
    """All quotes of this file."""
    page = "benchmarks/c_programs/records/rods.md"
    over = [[value(x) for x in column(page, "elements", index)] for index in (5, 6)]
    yield Quote(
        CLAIMS,
        "takes {} to {} times as long as C; XLA takes {} to {} times as long",
        (
            f"{min(over[0]):.1f}",
            f"{max(over[0]):.2f}",
            f"{min(over[1]):.1f}",
            f"{max(over[1]):.1f}",
        ),
    )
    ratios = [value(x) for x in column(PERFORMANCE, "scene, batch of 256", 3)]
    yield Quote(
        CLAIMS,
        "{} to {} times as fast, 256 rods",
        (f"{min(ratios):.1f}", f"{max(ratios):.1f}"),
    )
    head = "rods of 20 elements"
    kinds, ratios = column(H100, head, 1), [value(x) for x in column(H100, head, 4)]
    single = [r for r, kind in zip(ratios, kinds, strict=True) if kind == "float32"]
    yield Quote(
        CLAIMS,
        "{} to {} times as fast, {} to {} rods, float32",
        (
            digits(min(single)),
            digits(max(single)),
            column(H100, head, 0)[0],
            column(H100, head, 0)[-1],
        ),
    )
    yield Quote(
        CLAIMS,
        "{} times (swing) and {} times (rope) less than PyElastica; {} times less than "
        "MuJoCo's cable (rope)",
        (
            factor("swing", 1),
            factor("rope", 1),
            tuned("rope", 1, CABLE)[-1].removesuffix(" x"),
        ),
    )
    steps = column(SYSTEMS, "scene | PyElastica", 2)
    single = [value(step.partition(": ")[2].strip(" x")) for step in steps]
    yield Quote(
        CLAIMS,
        "{} to {} times as fast for a single scene",
        (whole(min(single)), whole(max(single))),
    )
    text = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8").splitlines()
    laws = [x for x in text if x.startswith("| ") and not x.startswith("| Feature")]
    yield Quote(CLAIMS, "| {} rows, all within their bars |", (whole(len(laws)),))
    text = (ROOT / PERFORMANCE).read_text(encoding="utf-8").splitlines()
    (median,) = [x for x in text if x.startswith("| ") and "median" in x]
    apart = [cell.strip() for cell in median.strip("|").split("|")]
    yield Quote(
        CLAIMS,
        "median difference {} times (scenes) and {} times (systems) that of one ulp",
        (apart[1], apart[2]),
    )
    yield Quote(
        CLAIMS,
        "relative error {} in reverse and {} in forward mode",
        tuple(
            cells("docs/gradients.md", f"{mode} mode, error, float64")[1]
            for mode in ("reverse", "forward")
        ),
    )
    yield Quote(
        CLAIMS,
        "| {} m in half a second (planar) |",
        (cells("docs/validation.md", "planar: creep within half a second [m]")[2],),
    )
    record = (ROOT / "tests" / "mutants" / "record.md").read_text(encoding="utf-8")
    (by_hand, drawn) = (
        [int(x) for x in found]
        for found in re.findall(
            r"(\d+) run: (\d+) killed, \d+ survived, (\d+) equivalent", record
        )
    )
    yield Quote(
        CLAIMS,
        "{} of {} faults chosen by hand; {} of {} drawn at random",
        tuple(
            str(x)
            for run, killed, equal in (by_hand, drawn)
            for x in (killed, run - equal)
        ),
    )
    scores = [
        (mean(float(run["final_score"]) for run in runs), published(case, learner))
        for case in CASES
        for learner in LEARNERS
        for runs in [
            rows(
                "benchmarks/paper/records/results.csv",
                case=f"Case{case}",
                algorithm=learner,
            )
        ]
    ]
    above = [score for score, paper in scores if score > float(paper["final_mean"])]
    yield Quote(
        CLAIMS,
        "{} of {} mean scores are higher",
        (str(len(above)), str(len(scores))),
    )
    scores = [
        cells("docs/first_order.md", f"{case} `{task}`", f"`{learner}`")[3].split()[0]
        for case, task in ((2, "reaching"), (1, "tracking"))
        for learner in ("dagger", "ppo")
    ]
    yield Quote(
        CLAIMS,
        "returns of {} and {} in `reaching`; of {} and {} in `tracking`",
        tuple(scores),
    )
    both = [
        cells("docs/optimum.md", f"{case} `{task}`", "256")
        for case, task in ((1, "tracking"), (2, "reaching"))
    ]
    yield Quote(
        CLAIMS,
        "in `tracking` {} and {}, in `reaching` {} and {}",
        tuple(row[index] for row in both for index in (5, 2)),
    )
    yield Quote(
        CLAIMS,
        "{} mm (root mean square) in nine poses",
        (cells("docs/twin.md", "all 9 others")[5],),
    )
