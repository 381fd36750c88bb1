"""Derivatives through time: errors, cost, memory, sensitivity of the tip.

Differentiates the end of a run with respect to couples over time and the stiffness.
Compares the derivative with central differences of many step sizes, in float64 and
float32. The scenes are `swing` (an arm that is released), `slam` (the same arm hits a
post, with and without the contact) and `rope` (a thin arm). Prints two tables; with
--out, also writes report.md, report.json and gradients.png. Takes a minute or two for
each scene. `memory` measures the peak memory of processes that compute gradients of
long runs and of large batches (Linux only).

Exits with 0 if the derivative in float64 is correct to 1e-6, and with 1 if not.

For example:
  python -m benchmarks gradients swing
  python -m benchmarks gradients slam --out runs/gradients   with and without contact
  python -m benchmarks gradients rope --elements 10 --duration 0.1 --json
  python -m benchmarks gradients memory
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import jax

import jaxrod
from benchmarks.gradients import memory
from benchmarks.gradients.report import (
    GradientReport,
    gradient_report,
    without_contact,
)
from jaxrod.files import write_atomically
from jaxrod.tradeoff.workload import SCENES as PROBLEMS
from jaxrod.viz.style import BLUE, INK, ORANGE, charts

SCENES = ("swing", "slam", "rope")
RIGHT = 1e-6
"""Largest relative error of a derivative in float64."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the scene and its sizes."""
    parser.add_argument("scene", choices=(*SCENES, "memory"))
    parser.add_argument(
        "--elements", type=int, default=20, metavar="N", help="(default: 20)"
    )
    parser.add_argument(
        "--duration", type=float, metavar="S", help="(default: the scene's) [s]"
    )
    parser.add_argument(
        "--batch", type=int, default=64, metavar="N", help="rods of a batch (64)"
    )
    parser.add_argument(
        "--no-memory", action="store_true", help="leave out three long compilations"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for report and picture"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead")


def run(args: argparse.Namespace) -> int:
    """Measures, prints, writes."""
    if args.scene == "memory":
        memory.table(args.elements)
        return 0
    jaxrod.configure_cpu(1)
    reports = _reports(args)
    text = markdown(reports)
    document = json.dumps([dataclasses.asdict(r) for r in reports], indent=2)
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        write_atomically(args.out / "report.md", text.encode())
        write_atomically(args.out / "report.json", (document + "\n").encode())
        write_atomically(args.out / "gradients.png", picture(reports))
    print(document if args.json else text)
    return 0 if all(report.error <= RIGHT for report in reports) else 1


def _reports(args: argparse.Namespace) -> list[GradientReport]:
    problem = PROBLEMS[args.scene]()
    options: dict[str, Any] = {
        "duration": problem.duration if args.duration is None else args.duration,
        "batch": args.batch,
        "memory": not args.no_memory,
    }
    with jax.enable_x64(True):
        scene, state = problem.build(args.elements, "consistent")
    reports = [gradient_report(scene, state, name=args.scene, **options)]
    free = without_contact(scene)
    if free is not None:
        name = f"{args.scene}, no contact"
        reports.append(gradient_report(free, state, name=name, **options))
    return reports


def markdown(reports: list[GradientReport]) -> str:
    """The report as two tables."""
    cells = [
        ("steps of a run", lambda r: f"{r.steps} of {r.n_elements} elements"),
        ("reverse mode, error, float64", lambda r: f"{min(r.reverse_errors):.1e}"),
        ("forward mode, error, float64", lambda r: f"{min(r.forward_errors):.1e}"),
        ("... at a step of", lambda r: f"{r.best_step:.0e}"),
        ("reverse mode, float32 against float64", lambda r: f"{r.single_reverse:.1e}"),
        ("forward mode, float32 against float64", lambda r: f"{r.single_forward:.1e}"),
        (
            "best central difference in float32",
            lambda r: f"{min(r.single_errors):.1e}",
        ),
        ("forward pass of one rod [ms]", lambda r: f"{r.milliseconds[0]:.3g}"),
        ("gradient / forward pass, one rod", lambda r: f"{r.gradient_ratio:.1f}"),
        ("tangent / forward pass, one rod", lambda r: f"{r.tangent_ratio:.1f}"),
        ("gradient / forward pass, batch", lambda r: f"{r.batch_ratio:.1f}"),
        ("rods of the batch", lambda r: f"{r.batch}"),
    ]
    names = [report.name for report in reports]
    lines = ["| | " + " | ".join(names) + " |", "|---|" + "---:|" * len(names)]
    lines += [
        f"| {label} | " + " | ".join(show(r) for r in reports) + " |"
        for label, show in cells
    ]
    for steps in reports[0].room:
        rooms = " | ".join(f"{r.room[steps] / 1e3:.0f}" for r in reports)
        lines.append(f"| memory of a gradient, {steps} steps [kB] | {rooms} |")
    lines += [
        "",
        "Singular values of the tip's derivative with respect to the controls so far "
        "[m], and the ratio of the largest to the smallest:",
        "",
        "| horizon [s] | " + " | ".join(names) + " |",
        "|---:|" + "---|" * len(names),
    ]
    for k, horizon in enumerate(reports[0].horizons):
        row = []
        for report in reports:
            values = report.singular_values[k]
            ratio = values[0] / values[-1] if values[-1] > 0 else float("inf")
            row.append(", ".join(f"{v:.2e}" for v in values) + f"; {ratio:.1e}")
        lines.append(f"| {horizon:.3g} | " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"


def picture(reports: list[GradientReport]) -> bytes:
    """Plot of errors against step size, and of singular values against the horizon."""
    figure, ((left, right),) = charts(7.5, 3.6, columns=2)
    first = reports[0]
    steps = first.step_sizes
    left.loglog(steps, first.reverse_errors, color=BLUE, marker=".", label="float64")
    left.loglog(steps, first.single_errors, color=ORANGE, marker=".", label="float32")
    left.axhline(first.single_reverse, color=ORANGE, linestyle=":", linewidth=1)
    left.annotate(
        "reverse mode in float32",
        (steps[-1], first.single_reverse),
        xytext=(2, 3),
        textcoords="offset points",
        fontsize=8,
        color=ORANGE,
    )
    left.set_xlabel("step of central differences")
    left.set_ylabel("relative difference from the derivative")
    left.set_title(first.name, fontsize=10)
    left.legend(frameon=False, fontsize=9)
    for report, color in zip(reports, (BLUE, INK), strict=False):
        for k, style in enumerate(("-", "--", ":")):
            right.semilogy(
                report.horizons,
                [values[k] for values in report.singular_values],
                style,
                color=color,
                label=report.name if k == 0 else None,
            )
    right.set_xlabel("horizon [s]")
    right.set_ylabel("singular values of d tip / d controls [m]")
    right.legend(frameon=False, fontsize=9)
    made = io.BytesIO()
    figure.savefig(made, format="png")
    return made.getvalue()
