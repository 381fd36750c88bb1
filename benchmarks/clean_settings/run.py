"""Accuracy of the `clean` tasks' settings: docs/clean_settings.md.

Compares each task, with its numbers of elements and of time steps, with a converged
reference, under recorded actions of three seeds. Then asks `jaxrod.tune` for the
cheapest setting with an error within 1 %.
Writes a record into records, and the page from it. `--pages` measures
nothing and writes the page from the record.
"""

from __future__ import annotations

import argparse
from typing import Any

import jaxrod
from benchmarks.clean_settings.problem import CleanTask, clean_problem, recorded_actions
from benchmarks.shared.arguments import add_pages_only
from benchmarks.shared.files import ROOT, write_record
from jaxrod.envs import make
from jaxrod.files import read_json, write_atomically
from jaxrod.installation.machine import processor_and_versions
from jaxrod.tradeoff import Reference, Setting, measure, reference, tune

RECORDS = ROOT / "benchmarks" / "clean_settings" / "records"
TASKS = ("reaching", "structured", "tracking", "unstructured")
SEEDS = (0, 1, 2)
REFERENCE_ELEMENTS = 80
ELEMENTS = (10, 20, 30, 40, 50, 60, 80)
"""Those an environment may have: its arm is observed at eleven nodes."""
TOLERANCE = 0.01
BATCH = 256
HEADER = """\
# How accurate the clean tasks are

Written by `python -m benchmarks clean_settings`; do not edit. The arm of every task's
`clean` variant is simulated under one second of recorded actions
(`benchmarks.clean_settings.problem`). Actions in `tracking` are those of a trained
policy, a third of them at their limits. Actions in `reaching` are random and redrawn
every 0.1 s. Those in the two obstacle tasks are the same at 0.3 of full strength: at
full strength, arms that differ by round-off soon diverge. The error is the root mean
square over time of the tip's distance from a reference, in lengths of the arm. The
reference has {n} elements at an eighth of the stable step, in float64. The task has its
default number of elements, in float32, and its default number of steps for each control
step of 1.4 ms.
{machine}, one core.
"""
FOOTER = """\
`tracking` and `reaching` use the cheapest setting within 1 % that `jaxrod.tune` finds.
The arm is observed at eleven equally spaced nodes, so its number of elements must be a
multiple of ten. The obstacle tasks have more elements. The strongest actions stretch
the arm twofold, and with fewer elements a cylinder could pass between two contact
points (`benchmarks/extremes`). In the obstacle tasks the ends of the arm have no
contact faces.
"""


def own_setting(task: CleanTask, plane: str | None) -> Setting:
    """Default setting of the task."""
    reductions = ("planar",) if plane else ()
    step = task.control_period / task.substeps
    return Setting(task.n_elements, step, reductions=reductions)


def row(name: str, seed: int) -> dict[str, Any]:
    """A task under the actions of one seed."""
    task = make(name, variant="clean")
    problem = clean_problem(task, recorded_actions(task, seed))
    exact: Reference = reference(problem, REFERENCE_ELEMENTS)
    one = measure(problem, own_setting(task, problem.plane), exact, batches=())
    return {
        "task": name,
        "seed": seed,
        "elements": task.n_elements,
        "steps": task.substeps,
        "error": one.error,
        "error_of_reference": exact.error,
    }


def choice(name: str) -> dict[str, Any]:
    """Setting that `tune` chooses for a task, with the first seed."""
    task = make(name, variant="clean")
    problem = clean_problem(task, recorded_actions(task, SEEDS[0]))
    found = tune(problem, max_error=TOLERANCE, elements=ELEMENTS, batch=BATCH)
    assert found.met and found.setting.dt is not None
    substeps = round(task.control_period / found.setting.dt)
    return {
        "task": name,
        "elements": found.setting.n_elements,
        "steps": substeps,
        "how": [found.setting.dtype, *found.setting.reductions],
        "error": found.error,
        "cost_s_per_s": found.wall_s_per_sim_s,
    }


def row_line(row: dict[str, Any]) -> str:
    """A row of the table of errors."""
    return (
        f"| {row['task']} | {row['seed']} | {row['elements']} | {row['steps']} "
        f"| {row['error']:.2%} | {row['error_of_reference']:.3%} |"
    )


def choice_line(row: dict[str, Any]) -> str:
    """A row of the table of choices."""
    return (
        f"| {row['task']} | {row['elements']} | {row['steps']} "
        f"| {', '.join(row['how'])} | {row['error']:.2%} "
        f"| {1e3 * row['cost_s_per_s']:.2g} |"
    )


def page(record: dict[str, Any]) -> str:
    """The page of a record."""
    machine = f"Measured on: {record['machine']}"
    lines = [
        HEADER.format(machine=machine, n=REFERENCE_ELEMENTS),
        "| task | seed | elements | steps | error | of the reference |",
        "|---|---:|---:|---:|---:|---:|",
        *map(row_line, record["rows"]),
        "",
        f"Choices of `jaxrod.tune` for {TOLERANCE:.0%}, for {BATCH} arms at once:",
        "",
        "| task | elements | steps | how | error | cost [ms/s] |",
        "|---|---:|---:|---|---:|---:|",
        *map(choice_line, record["choices"]),
        "",
        FOOTER.rstrip(),
    ]
    return "\n".join(lines) + "\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares whether to measure."""
    add_pages_only(parser)


def run(args: argparse.Namespace) -> int:
    """Measures, and writes the record and the page."""
    if not args.pages:
        jaxrod.configure_cpu(1)
        record: dict[str, Any] = {"machine": processor_and_versions()}
        record |= {"rows": [], "choices": []}
        for name in TASKS:
            for seed in SEEDS if name != "tracking" else SEEDS[:1]:
                record["rows"].append(row(name, seed))
                print(row_line(record["rows"][-1]), flush=True)
        for name in TASKS:
            record["choices"].append(choice(name))
            print(choice_line(record["choices"][-1]), flush=True)
        write_record(RECORDS, "clean_settings", record)
    found = read_json(RECORDS / "clean_settings.json")
    write_atomically(ROOT / "docs" / "clean_settings.md", page(found).encode())
    return 0
