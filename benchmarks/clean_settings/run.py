"""Accuracy of the `clean` tasks' settings: docs/clean_settings.md.

Compares each task, with its numbers of elements and of time steps, with a converged
reference, under recorded actions of three seeds. Then asks `jaxrod.tune` for the
cheapest setting with an error within 1 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import jaxrod
from benchmarks.clean_settings.problem import CleanTask, clean_problem, recorded_actions
from benchmarks.shared.files import ROOT
from jaxrod.envs import make
from jaxrod.files import write_atomically
from jaxrod.installation.machine import processor_and_versions
from jaxrod.tradeoff import Reference, Setting, measure, reference, tune

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
An arm observed at eleven nodes can only have multiples of ten elements. The obstacle
tasks have more elements. The strongest actions stretch the arm twofold, and with fewer
elements a cylinder could pass between two contact points (`benchmarks/extremes`). In
the obstacle tasks the ends of the arm have no contact faces.
"""


def own_setting(task: CleanTask, plane: str | None) -> Setting:
    """Default setting of the task."""
    reductions = ("planar",) if plane else ()
    step = task.control_period / task.substeps
    return Setting(task.n_elements, step, reductions=reductions)


def row(name: str, seed: int) -> str:
    """A task under the actions of one seed."""
    task = make(name, variant="clean")
    problem = clean_problem(task, recorded_actions(task, seed))
    exact: Reference = reference(problem, REFERENCE_ELEMENTS)
    one = measure(problem, own_setting(task, problem.plane), exact, batches=())
    return (
        f"| {name} | {seed} | {task.n_elements} | {task.substeps} "
        f"| {one.error:.2%} | {exact.error:.3%} |"
    )


def choice(name: str) -> str:
    """Setting that `tune` chooses for a task, with the first seed."""
    task = make(name, variant="clean")
    problem = clean_problem(task, recorded_actions(task, SEEDS[0]))
    found = tune(problem, max_error=TOLERANCE, elements=ELEMENTS, batch=BATCH)
    assert found.met and found.setting.dt is not None
    substeps = round(task.control_period / found.setting.dt)
    words = ", ".join((found.setting.dtype, *found.setting.reductions))
    return (
        f"| {name} | {found.setting.n_elements} | {substeps} | {words} "
        f"| {found.error:.2%} | {1e3 * found.wall_s_per_sim_s:.2g} |"
    )


def lines() -> Iterator[str]:
    """The page."""
    machine = f"Measured on: {processor_and_versions()}"
    yield HEADER.format(machine=machine, n=REFERENCE_ELEMENTS)
    yield "| task | seed | elements | steps | error | of the reference |"
    yield "|---|---:|---:|---:|---:|---:|"
    for name in TASKS:
        for seed in SEEDS if name != "tracking" else SEEDS[:1]:
            yield row(name, seed)
    yield ""
    yield f"Choices of `jaxrod.tune` for {TOLERANCE:.0%}, for {BATCH} arms at once:"
    yield ""
    yield "| task | elements | steps | how | error | cost [ms/s] |"
    yield "|---|---:|---:|---|---:|---:|"
    yield from map(choice, TASKS)
    yield ""
    yield FOOTER.rstrip()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Takes no arguments."""


def run(args: argparse.Namespace) -> int:
    """Measures and writes the page."""
    jaxrod.configure_cpu(1)
    page = []
    for line in lines():
        print(line, flush=True)
        page.append(line)
    target = ROOT / "docs" / "clean_settings.md"
    write_atomically(target, ("\n".join(page) + "\n").encode())
    return 0
