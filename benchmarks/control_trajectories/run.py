"""Solvers of trajectories, their iterations and time: docs/control.md.

In `reach` every solver moves the tip of an arm of 20 elements to a point 0.6 m away in
1 s, in float32. In `swing` a soft pendulum and a soft pole on a cart swing up and get a
push, with feedback and without. Rows that are not measured do not change.

Times are processor time of one core. The tables list the first call, which compiles,
and the next call separately.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

import jaxrod
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import ROOT, example
from benchmarks.shared.page_tables import measured_table
from jaxrod import control
from jaxrod.envs import actuated_arm

PAGE = ROOT / "docs" / "control.md"
TARGET = (0.4, 0.6, 0.2)
HEADS = {
    "reach": (
        "| reach, 20 elements | iterations | tip from the target [mm] "
        "| tip speed [m/s] | first call [s] | next [s] |\n"
        "|---|---:|---:|---:|---:|---:|"
    ),
    "swing": (
        "| swing-up by `ilqr` | iterations | tip from upright [mm] "
        "| pushed, with feedback [mm] | without [mm] | first call [s] | next [s] |\n"
        "|---|---:|---:|---:|---:|---:|---:|"
    ),
}


def timed(solve: Callable[[], control.Solution]) -> tuple[control.Solution, float]:
    """A solution, and the processor time it took [s]."""
    begun = time.process_time()
    found = solve()
    return found, time.process_time() - begun


def reach_rows() -> Iterable[str]:
    """A row for each solver."""
    problem = control.reach(actuated_arm(20), TARGET)
    solvers: dict[str, Callable[[], control.Solution]] = {
        "`levenberg_marquardt`": lambda: control.levenberg_marquardt(
            problem, iterations=5
        ),
        "`levenberg_marquardt`, by columns": lambda: control.levenberg_marquardt(
            problem, iterations=5, mode="forward"
        ),
        "`adam`": lambda: control.adam(problem, iterations=150),
    }
    for name, solve in solvers.items():
        (found, first), (_, second) = timed(solve), timed(solve)
        distance, speed = (series[-1] for series in found.readouts.values())
        yield (
            f"| {name} | {found.iterations} | {1e3 * distance:.2f} | {speed:.3f} | "
            f"{first:.1f} | {second:.2f} |"
        )


def swing_rows() -> Iterable[str]:
    """A row for each rod that swings up."""
    for name, member in (("soft_pendulum", None), ("soft_cart_pole", "rod")):
        rod_up = example(name)
        (found, first), (_, second) = timed(rod_up.swing_up), timed(rod_up.swing_up)

        def missed(states: Any, member: str | None = member, top: Any = rod_up) -> Any:
            rod = states if member is None else states[member]
            tip = np.asarray(rod.tip[-1])
            return 1e3 * np.linalg.norm(tip - np.array([0, 0, top.LENGTH]))

        ends = [
            missed(control.rolled_out(found.problem, policy, rod_up.pushed).states)
            for policy in (found.policy, found.open_loop)
        ]
        yield (
            f"| `examples/{name}.py` | {found.iterations} | "
            f"{missed(found.states):.1f} | {ends[0]:.0f} | {ends[1]:.0f} | "
            f"{first:.1f} | {second:.1f} |"
        )


ROWS = {"reach": reach_rows, "swing": swing_rows}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tables."""
    add_names(parser, "tables", HEADS, "TABLE")
    parser.add_argument("--dry", action="store_true", help="write nothing")


def run(args: argparse.Namespace) -> int:
    """Measures, prints and writes."""
    jaxrod.configure_cpu(1)
    for table in args.tables:
        measured_table(PAGE, table, HEADS[table], ROWS[table], dry=args.dry)
    return 0
