"""The numbers that README and the pages quote, from their records."""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from benchmarks.numbers.quoting import Quote
from benchmarks.numbers.records import (
    at_least,
    cells,
    cheapest,
    digits,
    mean,
    numbers,
    read,
    rows,
    value,
    whole,
    word,
)
from benchmarks.shared.files import ROOT

README = "README.md"
CLAIMS = "docs/claims.md"
LEARNING = "docs/learning.md"
PERFORMANCE = "docs/performance.md"
ACCURACY = "docs/accuracy.md"
SYSTEMS = "docs/systems.md"
H100 = "benchmarks/accelerator/records/h100.md"
H200 = "benchmarks/accelerator/records/h200.md"
CABLE = "MuJoCo's cable"
CASES = {1: "tracking", 2: "reaching", 3: "structured", 4: "unstructured"}
LEARNERS = ("PPO", "TRPO", "SAC", "TD3", "DDPG")


def quotes() -> Iterator[Quote]:
    """All quotes."""
    yield from steps_of_rods()
    yield from accuracy()
    yield from beside_pyelastica()
    yield from control_steps()
    yield from tracking()
    yield from grid()
    yield from clean()
    yield from best_learners()
    yield from quiet_policies()
    yield from beside_c()
    yield from on_a_gpu()
    yield from lanes()
    yield from systems()
    yield from claims()
    yield from notebooks()


def rod_steps(mode: str, dtype: str, batch: int) -> dict[str, Any]:
    """A row of `jaxrod benchmark`."""
    for row in read("benchmarks/rod_steps/records/rod_steps.json")["rows"]:
        if (row["mode"], row["dtype"], row["batch"]) == (mode, dtype, batch):
            return dict(row)
    raise ValueError(f"rod_steps.json has no row {mode}, {dtype}, {batch}")


def steps_of_rods() -> Iterator[Quote]:
    """Steps of rods on a CPU."""
    row = rod_steps("consistent", "float32", 1024)
    yield Quote(
        README,
        "| {} million per second, {} times PyElastica's rate |",
        (
            f"{row['rod_steps_per_s'] / 1e6:.1f}",
            digits(row["times_pyelastica"]),
        ),
    )


def tuned(scene: str, rods: int, simulator: str | None = None) -> list[str]:
    """A row of a scene's page of errors and costs: jaxrod's, or of another program."""
    page = f"benchmarks/tradeoff/records/{scene}/tradeoff.md"
    return cells(page, str(rods), *([simulator] if simulator else []))


def factor(scene: str, rods: int) -> str:
    """Ratio of PyElastica's time to jaxrod's, to two digits; a bound is rounded down.

    Thousands are separated from 10,000 on, as tables of this page do.
    """
    shown = tuned(scene, rods, "PyElastica")[-1]
    ratio = value(shown.strip("> x"))
    rounded = at_least(ratio) if ">" in shown else float(f"{ratio:.2g}")
    return f"{rounded:,.0f}" if rounded >= 10_000 else f"{rounded:.0f}"


def accuracy() -> Iterator[Quote]:
    """Cost at an error of one per cent."""
    one, batch = (value(tuned("swing", n)[-1]) for n in (1, 256))
    theirs = tuned("swing", 1, "PyElastica")
    elements = tuned("swing", 1)[1].partition("n = ")[2].partition(",")[0]
    yield Quote(
        README,
        "| {} ms per second of motion, with {} elements in a plane, scaled inertia and "
        "float32. PyElastica takes {} times as long, with {} elements in space and "
        "float64 |",
        (f"{1e3 * one:.2g}", elements, factor("swing", 1), theirs[2]),
    )
    yield Quote(
        ACCURACY,
        "n = {}, dt = {} ms, planar, scaled inertia, float32 | {} ms | {} ms "
        "| {} s (n = {}) | > {} s (n = {}: {} %) |",
        (
            elements,
            f"{1e3 * value(numbers(tuned('swing', 1)[1])[1]):g}",
            f"{1e3 * one:.2g}",
            f"{1e3 * batch:.2g}",
            theirs[5],
            theirs[2],
            tuned("swing", 1, CABLE)[5],
            tuned("swing", 1, CABLE)[2],
            f"{100 * value(tuned('swing', 1, CABLE)[4]):.2g}",
        ),
    )
    for scene in ("swing", "rope"):
        pair = factor(scene, 1), factor(scene, 256)
        yield Quote(ACCURACY, f"| {scene} | {{}} | {{}} |", pair)
    yield Quote(
        ACCURACY,
        "| tracking | more than {} | more than {} |",
        (factor("tracking", 1), factor("tracking", 256)),
    )
    one, batch = (value(tuned("rope", n)[-1]) for n in (1, 256))
    yield Quote(
        ACCURACY,
        "| {} ms | {} ms (in space) | {} s (n = {}, the fewest tried) "
        "| {} ms (n = {}) |",
        (
            f"{1e3 * one:.2g}",
            f"{1e3 * batch:.2g}",
            tuned("rope", 1, "PyElastica")[5],
            tuned("rope", 1, "PyElastica")[2],
            f"{1e3 * value(tuned('rope', 1, CABLE)[5]):.2g}",
            tuned("rope", 1, CABLE)[2],
        ),
    )
    one, batch = (value(tuned("tracking", n)[-1]) for n in (1, 256))
    theirs = tuned("tracking", 1, "PyElastica")
    yield Quote(
        ACCURACY,
        "n = 24, dt = 0.35 ms, float32 | {} ms | {} ms | > {} s (n = {}: {} %) |",
        (
            f"{1e3 * one:.2g}",
            f"{1e3 * batch:.2g}",
            theirs[5],
            theirs[2],
            f"{100 * value(theirs[4]):.2g}",
        ),
    )
    yield Quote(
        ACCURACY,
        "n = 10, dt = 0.77 ms, planar, scaled inertia, float32 | {} ms | {} ms |",
        tuple(f"{1e3 * value(tuned('slam', n)[-1]):.2g}" for n in (1, 256)),
    )
    row = cells("docs/material.md", "cable that swings from a pin, under its weight")
    yield Quote(ACCURACY, "has a relative error of {} instead of {}", (row[3], row[2]))
    found = read("benchmarks/tuned_systems/records/tuned_systems.json")["scenes"]
    names = {
        "two hinged rods": "hinged",
        "a ball that hits a rod": "ball_on_rod",
        "a rope that falls over a cylinder": "draped_rope",
        "a gripper": "gripper",
    }
    page = (ROOT / ACCURACY).read_text(encoding="utf-8")
    for title, name in names.items():
        (line,) = [x for x in page.splitlines() if x.startswith(f"| {title},")]
        setting = line.split("|")[2].strip()
        row = found[name]
        yield Quote(
            ACCURACY,
            f"{setting} | {{}} | {{}} | {{}} | {{}} s |",
            (
                f"{row['stated']:.4f}",
                f"{row['true']:.4f}",
                f"{row['ratio']:.3f}",
                f"{row['processor_s']:.0f}",
            ),
        )


def beside_pyelastica() -> Iterator[Quote]:
    """Agreement with PyElastica."""
    text = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
    found = [
        float(line.split("|")[3])
        for line in text.splitlines()
        if line.startswith("| PyElastica mode after 1000 steps, positions [m]")
    ]
    yield Quote(README, "positions agree to {} m", (f"{max(found):.0e}",))


def speed(task: str, variant: str) -> float:
    """Control steps per second of a task, with 256 environments on each core."""
    for row in read("benchmarks/environments/records/environments.json")["rows"]:
        if (row["task"], row["variant"]) == (task, variant):
            return float(row["control_steps_per_s"][-1])
    raise ValueError(f"environments.json has no row {task}, {variant}")


def control_steps() -> Iterator[Quote]:
    """Control steps of whole tasks."""
    yield Quote(
        README,
        "| {} per second; variant `paper`: {} |",
        (
            whole(speed("tracking", "clean"), 1000),
            whole(speed("tracking", "paper"), 1000),
        ),
    )


def published(case: int, learner: str) -> dict[str, str]:
    """The paper's result of a cell."""
    (row,) = rows(
        "benchmarks/paper/published.csv",
        case=f"Case{case}",
        algorithm=learner,
        in_figure="1",
    )
    return row


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
        "none of the {} complete training episodes",
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
    text = (ROOT / page).read_text(encoding="utf-8")
    table = text.partition("| least share | below half | processor [s] |")[2]
    lines = {
        line.split("|")[1].strip().split()[1].strip("`"): line.split("|")
        for line in table.partition("###")[0].splitlines()
        if line.startswith("| ") and "`" in line
    }
    for task in ("tracking", "reaching"):
        row = lines[task]
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
    planned = [
        [cell.strip() for cell in line.split("|")]
        for line in text.partition("### Comparison with a planner")[2].splitlines()
        if line.startswith(("| 1 `tracking`", "| 2 `reaching`"))
    ][:2]
    yield Quote(
        LEARNING,
        "It reaches {} % of the ceiling in `tracking` and {} % in `reaching`",
        tuple(numbers(row[4])[0] for row in planned),
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


def beside_c() -> Iterator[Quote]:
    """Rods, joints and batches beside C."""
    page = "benchmarks/c_programs/records/rods.md"
    every = []
    for n in ("20", "50", "200", "1000"):
        one, two = (cells(page, n, f"float{bits}") for bits in (32, 64))
        yield Quote(
            PERFORMANCE,
            f"| {n} | {{}} | {{}} | {{}} | {{}} | {{}} | {{}} |",
            (*one[2:5], *two[2:5]),
        )
        every += [one, two]
    rows_over_c = [value(row[5]) for row in every]
    xla_over_c = [value(row[6]) for row in every]
    yield Quote(
        PERFORMANCE,
        "A rod in rows takes {} to {} times as long as a C program written for that "
        "rod. XLA takes {} to {} times as long",
        (
            f"{min(rows_over_c):.1f}",
            f"{max(rows_over_c):.2f}",
            f"{min(xla_over_c):.1f}",
            f"{max(xla_over_c):.1f}",
        ),
    )
    page = "benchmarks/c_programs/records/systems.md"
    names = {
        "two rods of 20 elements, a joint": "two rods of 20 elements, a joint",
        "two ropes of 51 that cross, `crossing_contact`": (
            "two ropes of 51, `crossing_contact`"
        ),
        "two ropes of 51 that cross, `rod_contact`": "two ropes of 51, `rod_contact`",
        "a coil of 100 that touches itself, `crossing_contact`": (
            "a coil of 100, `crossing_contact`"
        ),
        "a plectoneme of 150, `rod_contact`": "a plectoneme of 150, `rod_contact`",
    }
    for title, name in names.items():
        row = cells(page, name, "float64")
        yield Quote(
            PERFORMANCE, f"| {title} | {{}} | {{}} | {{}} | {{}} |", tuple(row[2:6])
        )
    page = "benchmarks/c_batches/records/batches.md"
    text = (ROOT / page).read_text(encoding="utf-8").partition("## Rows beside")[2]
    for line in text.splitlines():
        row = [cell.strip() for cell in line.strip("|").split("|")]
        if len(row) > 1 and row[1].startswith("float"):
            yield Quote(
                PERFORMANCE,
                f"| {row[0]} | {row[1]} |" + " {} |" * 5,
                tuple(row[2:7]),
            )


def millions(cell: str, count: int = 3) -> str:
    """A rate in millions, without decimals from a hundred on."""
    number = value(cell) / 1e6
    return f"{number:.0f}" if number >= 10 else digits(number, count)


def on_a_gpu() -> Iterator[Quote]:
    """Rods and tasks on GPUs."""
    rates = cells(H100, "4,096", "float32")
    yield Quote(
        README,
        "a batch of 4,096 rods of 20 elements makes {} million time steps per second, "
        "{} times as many as with XLA",
        (millions(rates[2]), word(value(rates[4]))),
    )
    for batch in ("1,024", "4,096", "65,536", "1,048,576"):
        shown = []
        for dtype in ("float32", "float64"):
            shown += map(millions, cells(H100, batch, dtype)[2:4])
        text = f"| {batch} |" + " {} |" * 4
        if batch in ("1,024", "4,096", "65,536"):
            task = cells(H100, "tracking", batch)
            shown += [f"{value(cell) / 1e6:.1f}" for cell in task[2:4]]
            text += " {} | {} |"
        yield Quote(PERFORMANCE, text, tuple(shown))
    gradients = [
        line.split("|")
        for line in (ROOT / H100).read_text(encoding="utf-8").splitlines()
        if line.startswith("| 1,024 | float32 |")
    ][1]
    yield Quote(
        PERFORMANCE,
        "| gradients of 200 steps, batch of 1,024, float32 [per second] | {} | {} |",
        (whole(value(gradients[3]), 1000), whole(value(gradients[4]), 100)),
    )
    yield Quote(
        PERFORMANCE,
        "| first call: gradients [s] | {} | {} |",
        (gradients[6].strip(), gradients[7].strip()),
    )
    head = "rods of 20 elements"
    firsts = [[value(x) for x in column(H100, head, index)] for index in (5, 6)]
    yield Quote(
        PERFORMANCE,
        "| first call: rods [s] | {} to {} | {} to {} |",
        tuple(f"{pick(times):.1f}" for times in firsts for pick in (min, max)),
    )
    alone = 1e6 / value(cells(H100, "1", "float32")[2])
    on_cpu = value(cells("benchmarks/c_programs/records/rods.md", "20", "float32")[3])
    yield Quote(
        PERFORMANCE,
        "takes {} us a step on the GPU and {} us in [rows on a CPU]",
        (digits(alone), digits(on_cpu)),
    )
    ropes = cells(H100, "256xropes", "float32")
    yield Quote(
        PERFORMANCE,
        "float32 [million element-steps/s] | {} | {} |",
        (millions(ropes[2]), millions(ropes[3])),
    )
    yield Quote(
        PERFORMANCE, "| first call: ropes [s] | {} | {} |", (ropes[5], ropes[6])
    )
    warps, xla = cells(H100, "warps"), cells(H100, "XLA")
    yield Quote(
        PERFORMANCE,
        "| PPO on `tracking`, 10 million control steps, compiling included [s] "
        "| {} | {} |",
        (warps[2], xla[2]),
    )
    yield Quote(
        PERFORMANCE,
        "it made {} million rod-steps per second with 4,096 rods and {} million with "
        "a million",
        tuple(
            millions(cells(H200, batch, "float32")[2])
            for batch in ("4,096", "1,048,576")
        ),
    )


def lanes() -> Iterator[Quote]:
    """Sentences about the tables that `python -m benchmarks lanes` writes."""
    base = cells(PERFORMANCE, "n = 20, clamped, damped, actuated")
    double = cells(PERFORMANCE, "n = 20, float64")
    long = cells(PERFORMANCE, "n = 100")
    ours, theirs = value(base[1]), value(base[2])
    yield Quote(
        PERFORMANCE,
        "they compute {} million elements a second at n = 20, and {} million at "
        "n = 100. XLA loops over elements and gets faster, from {} to {} million.",
        (
            whole(20 * ours),
            whole(100 * value(long[1])),
            whole(20 * theirs),
            whole(100 * value(long[2])),
        ),
    )
    yield Quote(
        PERFORMANCE,
        "lanes take {} times as long, and XLA {} times",
        (f"{ours / value(double[1]):.1f}", f"{theirs / value(double[2]):.1f}"),
    )
    ratios = [
        value(ratio)
        for head in ("scene", "elements")
        for ratio in column(PERFORMANCE, f"{head}, batch of 256", 3)
    ]
    yield Quote(
        "docs/supported_versions.md",
        "batches on CPUs take {} to {} times as long",
        (word(min(ratios)), word(max(ratios))),
    )


def systems() -> Iterator[Quote]:
    """Systems beside PyElastica at equal accuracy."""
    found = {}
    for scene in ("snake", "joint"):
        page = f"benchmarks/system_accuracy/records/{scene}.csv"
        found[scene] = [
            cheapest(page, who, 0.01)["cost"] for who in ("jaxrod", "pyelastica")
        ]
    yield Quote(
        ACCURACY,
        "jaxrod needs {} s of processor time per simulated second and PyElastica {} s",
        tuple(f"{cost:.2g}" for cost in found["snake"]),
    )
    yield Quote(
        ACCURACY,
        "For the joint jaxrod needs {} s and PyElastica {} s",
        tuple(f"{cost:.2g}" for cost in found["joint"]),
    )
    ratios = [theirs / ours for ours, theirs in found.values()]
    yield Quote(
        SYSTEMS,
        "PyElastica needs {} times as much processor time for the snake's speed, and "
        "{} times as much for the motion of the two rods",
        tuple(whole(ratio) for ratio in ratios),
    )


def column(page: str, head: str, index: int) -> list[str]:
    """A column of the table of a page that has this first cell in its head."""
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    (begin,) = [n for n, line in enumerate(lines) if line.startswith(f"| {head} |")]
    table = itertools.takewhile(lambda line: line.startswith("|"), lines[begin + 2 :])
    return [line.split("|")[index + 1].strip() for line in table]


def claims() -> Iterator[Quote]:
    """The page of claims."""
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
    steps = column(SYSTEMS, "scene | PyElastica, a step [us]", 2)
    single = [value(step.partition(": ")[2].strip(" x")) for step in steps]
    yield Quote(
        CLAIMS,
        "{} to {} times as fast for a single scene",
        (whole(min(single)), whole(max(single))),
    )
    text = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8").splitlines()
    laws = [x for x in text if x.startswith("| ") and not x.startswith("| Feature")]
    yield Quote(CLAIMS, "| {} rows, all within their bars |", (whole(len(laws)),))
    apart = cells(PERFORMANCE, "median of apart over one ulp's")
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
    text = (ROOT / "docs" / "optimum.md").read_text(encoding="utf-8")
    table = text.partition("### Comparison with a planner")[2]
    both = [line.split("|") for line in table.splitlines() if line.startswith("| ")]
    yield Quote(
        CLAIMS,
        "in `tracking` {} and {}, in `reaching` {} and {}",
        tuple(row[index].strip() for row in both[1:3] for index in (6, 3)),
    )
    yield Quote(
        CLAIMS,
        "{} mm (root mean square) in nine poses",
        (cells("docs/twin.md", "all 9 others")[5],),
    )


def printed(notebook: str) -> str:
    """All that a notebook printed."""
    return "\n".join(
        "".join(output.get("text", []))
        for cell in read(notebook)["cells"]
        for output in cell.get("outputs", [])
    )


def notebooks() -> Iterator[Quote]:
    """Sentences of notebooks about what their cells print."""
    notebook = "notebooks/02_where_should_it_go.ipynb"
    solved = re.findall(
        r"Solution by (\w+).*\n    at the end distance \[m\]: (\S+),", printed(notebook)
    )
    ends = {solver: 1e3 * float(distance) for solver, distance in solved}
    yield Quote(
        notebook,
        "Levenberg-Marquardt ends {} mm from the target, and Adam {} mm",
        (f"{ends['levenberg_marquardt']:.2f}", f"{ends['adam']:.0f}"),
    )
    notebook = "notebooks/06_how_good_is_good.ipynb"
    (score,) = re.findall(r"PPO: (\S+)", printed(notebook))
    yield Quote(notebook, "A learner scores {}.", (score,))
