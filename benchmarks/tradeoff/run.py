"""Measure what accuracy costs, and find the cheapest setting.

SCENE is `swing` (a horizontal arm that is released), `tracking` (the tracking task's
arm under recorded actions of a trained policy), `rope` (4 mm thick, 1 m long, released)
or `slam` (an arm that falls onto a post). The command compares a grid of settings
(elements, step, precision, law, integrator, reductions) with a converged reference (160
elements, an eighth of the stable step, float64). It times each setting on one core, for
a single rod and for batches. PyElastica computes the same scene in the same run, and so
does MuJoCo's cable if nothing drives the arm. Neither computes scenes with contact,
because the contact laws differ. A search then finds the cheapest setting within the
tolerance. It also tries steps between those of the grid.

DIR gets tradeoff.csv (a line per setting and batch), tradeoff.png (error against cost)
and tradeoff.md (the results).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.tradeoff.grid import Row
    from jaxrod.tradeoff import Reference, Tuned

OTHERS = {"pyelastica": "PyElastica", "mujoco": "MuJoCo's cable"}
EXAMPLES = """\
examples:
  jaxrod tradeoff swing                            everything, in some ten minutes
  jaxrod tradeoff tracking --out runs/tradeoff     into another folder
  jaxrod tradeoff rope --elements 10 20 --batches 1       a few, in a minute
  jaxrod tradeoff swing --tolerance 0.001          the cheapest within 0.1 %
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod tradeoff`."""
    parser.epilog = EXAMPLES
    parser.add_argument("scene", metavar="SCENE", help="swing, tracking, rope or slam")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for the results (default: runs/tradeoff/SCENE)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.01,
        metavar="X",
        help="largest error, in lengths of the rod (default: 0.01)",
    )
    parser.add_argument(
        "--elements",
        type=int,
        nargs="+",
        metavar="N",
        help="numbers of elements (default: 5 8 10 14 20 28 40 80)",
    )
    parser.add_argument(
        "--batches",
        type=int,
        nargs="+",
        metavar="N",
        help="numbers of rods in a batch (default: 1 256 4096)",
    )
    parser.add_argument(
        "--pyelastica-elements",
        type=int,
        nargs="*",
        metavar="N",
        help="PyElastica's numbers of elements (default: 10 20 40 80 160)",
    )
    parser.add_argument(
        "--mujoco-elements",
        type=int,
        nargs="*",
        metavar="N",
        help="numbers of elements of MuJoCo's cable (default: 5 10 20 40 80)",
    )
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object instead of text"
    )


def run(args: argparse.Namespace) -> int:
    """Measures, writes and prints."""
    import jaxrod

    # One core each: what is compared is work, not machines.
    jaxrod.configure_cpu(1)
    from benchmarks.tradeoff import grid
    from benchmarks.tradeoff.work_precision import work_precision
    from jaxrod import tradeoff
    from jaxrod.files import write_atomically
    from jaxrod.installation.machine import machine_facts

    if args.scene not in tradeoff.SCENES:
        known = ", ".join(tradeoff.SCENES)
        raise ValueError(f"SCENE must be one of {known}, got {args.scene!r}")
    for name, least in (
        ("elements", 2),
        ("batches", 1),
        ("pyelastica_elements", 2),
        ("mujoco_elements", 2),
    ):
        if any(n < least for n in getattr(args, name) or ()):
            flag = name.replace("_", "-")
            raise ValueError(f"--{flag} must be at least {least} each")
    if not args.tolerance > 0:
        raise ValueError(f"--tolerance must be positive, got {args.tolerance:g}")
    out: Path = args.out or Path("runs/tradeoff") / args.scene
    out.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None

    def log(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    workload = tradeoff.SCENES[args.scene]()
    exact = tradeoff.reference(workload)
    log(f"reference: uncertain by {exact.error:.2g} of the length")

    def elements(others: list[int] | None, usual: tuple[int, ...]) -> tuple[int, ...]:
        return usual if others is None else tuple(others)

    batches = tuple(args.batches or grid.BATCHES)
    rows = grid.measure_grid(
        workload,
        exact,
        elements=args.elements or grid.ELEMENTS,
        batches=batches,
        pyelastica_elements=elements(
            args.pyelastica_elements, grid.PYELASTICA_ELEMENTS
        ),
        mujoco_elements=elements(args.mujoco_elements, grid.MUJOCO_ELEMENTS),
        log=log,
    )
    write_atomically(out / "tradeoff.csv", grid.as_csv(rows).encode())
    work_precision(
        rows,
        out / "tradeoff.png",
        title=f"{args.scene}: error against cost, one core",
        floor=exact.error,
    )
    tuned = {
        batch: tradeoff.tune(workload, max_error=args.tolerance, batch=batch, log=log)
        for batch in batches
    }
    compared = [_compared(rows, tuned[batch]) for batch in batches]
    machine = machine_facts(load)
    page = _page(args.scene, exact, compared, machine)
    write_atomically(out / "tradeoff.md", page.encode())
    if args.json:
        result = {
            "scene": args.scene,
            "tolerance": args.tolerance,
            "reference_error": exact.error,
            "tuned": compared,
            "machine": machine,
        }
        print(json.dumps(result, indent=2))
    else:
        print(page.rstrip())
        print(f"\n{out / 'tradeoff.csv'}\n{out / 'tradeoff.png'}")
    return 0


def _compared(rows: list[Row], tuned: Tuned) -> dict[str, Any]:
    """A tuned setting beside the cheapest of the others that is as accurate."""
    from benchmarks.tradeoff.grid import cheapest

    result: dict[str, Any] = {
        "batch": tuned.batch,
        "tolerance": tuned.max_error,
        "met": tuned.met,
        "setting": str(tuned.setting),
        "error": tuned.error,
        "wall_s_per_sim_s": tuned.wall_s_per_sim_s,
    }
    for simulator in OTHERS:
        theirs = [
            row
            for row in rows
            if row.simulator == simulator and row.batch == tuned.batch
        ]
        other = cheapest(theirs, tuned.max_error)
        shown = other or min(theirs, key=lambda row: row.error, default=None)
        if shown is not None:
            result[simulator] = {
                "met": other is not None,
                "n_elements": shown.setting.n_elements,
                "dt": shown.setting.dt,
                "error": shown.error,
                "wall_s_per_sim_s": shown.wall_s_per_sim_s,
                "ratio": shown.wall_s_per_sim_s / tuned.wall_s_per_sim_s,
            }
    return result


def _page(
    scene: str,
    exact: Reference,
    compared: list[dict[str, Any]],
    machine: dict[str, Any],
) -> str:
    """Results, as a Markdown page."""
    versions = ", ".join(f"{name} {v}" for name, v in machine["versions"].items())
    tolerance = compared[0]["tolerance"]
    lines = [
        f"# Speed for accuracy: {scene}",
        "",
        f"Written by `jaxrod tradeoff {scene}`. {machine['processor']}, one core; "
        f"{versions}. The reference has {exact.n_elements} elements and is uncertain "
        f"by {exact.error:.1e} of the length. Cost: wall-clock time per simulated "
        "second and rod. Error: root mean square over time of the tip's distance "
        "from the reference, in lengths of the rod.",
        "",
        f"The cheapest setting with an error of at most {tolerance:g}:",
        "",
        "| rods | setting | error | cost [s/s] |",
        "|---:|---|---:|---:|",
    ]
    for one in compared:
        setting = one["setting"] if one["met"] else f"(not met) {one['setting']}"
        cost = f"{one['wall_s_per_sim_s']:.2g}"
        lines.append(f"| {one['batch']} | {setting} | {one['error']:.2g} | {cost} |")
    pairs = [(one, name) for name in OTHERS for one in compared if name in one]
    if pairs:
        lines += [
            "",
            "And the cheapest of the others that is as accurate:",
            "",
            "| rods | simulator | elements | step [s] | error | cost [s/s] | ratio |",
            "|---:|---|---:|---:|---:|---:|---:|",
        ]
    for one, name in pairs:
        theirs = one[name]
        bound = "" if theirs["met"] else "> "
        cells = (
            f"{one['batch']}",
            OTHERS[name],
            f"{theirs['n_elements']}",
            f"{theirs['dt']:.2g}",
            f"{theirs['error']:.2g}",
            f"{theirs['wall_s_per_sim_s']:.2g}",
            f"{bound}{theirs['ratio']:,.0f} x",
        )
        lines.append(f"| {' | '.join(cells)} |")
    if not all(one[name]["met"] for one, name in pairs):
        lines += [
            "",
            "Where the ratio is a bound, the tolerance was not reached with the "
            "elements tried, and the most accurate run stands in its place.",
        ]
    return "\n".join(lines) + "\n"
