"""Quotes of records of speed and accuracy."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from benchmarks.numbers.quoting import Quote
from benchmarks.numbers.records import (
    at_least,
    cells,
    cheapest,
    column,
    digits,
    numbers,
    read,
    value,
    whole,
    word,
)
from benchmarks.shared.files import ROOT

README = "README.md"
PERFORMANCE = "docs/performance.md"
ACCURACY = "docs/accuracy.md"
SYSTEMS = "docs/systems.md"
H100 = "benchmarks/accelerator/records/h100.md"
H200 = "benchmarks/accelerator/records/h200.md"
CABLE = "MuJoCo's cable"


def quotes() -> Iterator[Quote]:
    """All quotes of this file."""
    yield from steps_of_rods()
    yield from accuracy()
    yield from beside_pyelastica()
    yield from control_steps()
    yield from operations()
    yield from beside_c()
    yield from on_a_gpu()
    yield from lanes()
    yield from systems()
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


def operations() -> Iterator[Quote]:
    """Operations of a step with each method."""
    page = "docs/choosing_a_method.md"
    found = {
        row["scene"]: f"{row['operations']:,.0f}"
        for row in read("benchmarks/costs/records/costs.json")["rows"]
    }
    arm, moving = "clamped, damped, actuated", "clamped, damped, with gravity"
    scenes = {
        "is not part of it |": ("consistent", arm),
        "stay exactly zero |": ("planar", arm),
        "twist and polar inertia (2) |": ("without twist", moving),
        "nor angular momentum |": ("pyelastica", arm),
    }
    for words, (method, full) in scenes.items():
        pair = found[f"{method}, bare"], found[f"{method}, {full}"]
        yield Quote(page, f"{words} {{}}; {{}} |", pair)
    yield Quote(
        page,
        "For that scene `consistent` needs {} operations",
        (found[f"consistent, {moving}"],),
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
        "| PPO on `tracking`, 10 million control steps, including compiling [s] "
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
