"""Run the published benchmark: a grid of cases, algorithms and seeds.

CASES are `tracking`, `reaching`, `structured` and `unstructured`, or as in the paper
Case1 to Case4 (default: all four). `trivial` is a small grid, for a trial of one
minute. A cell is a case with an algorithm and a seed. `jaxrod train` trains every cell
in a separate process, with the control steps and settings of
benchmarks/paper/settings.py. Cells run one after another on all cores. With --jobs
several run in parallel, each on its share of the cores.

DIR gets results.csv (a row per seed), results.md (a comparison with the paper), a
figure per case, cells/ (settings and result of every cell) and curves/. The command
updates these after every cell. Keep them. DIR/runs has the run folders, which you may
delete. Ctrl-C saves and stops. The same command continues, also after a kill, and skips
finished cells. If a cell diverges, the command records it as failed and continues.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from jaxrod.cli.settings import count

EXAMPLES = """\
examples:
  jaxrod reproduce --dry-run                         what would run, for how long
  jaxrod reproduce                                   the paper's 20 cells, 3 seeds
  jaxrod reproduce Case1 Case2 --algorithms ppo trpo --seeds 0 1
  jaxrod reproduce Case4 --variant clean --algorithms sac --out /tmp/clean
  jaxrod reproduce --steps-fraction 0.05 --out /tmp/short
  jaxrod reproduce trivial --algorithms ppo sac --out /tmp/trivial
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod reproduce`."""
    parser.epilog = EXAMPLES
    parser.add_argument("cases", metavar="CASES", nargs="*", help="see above")
    parser.add_argument(
        "--algorithms",
        nargs="+",
        default=[],
        metavar="NAME",
        help="ppo, trpo, sac, td3, ddpg (default: all)",
    )
    parser.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        default=[0, 1, 2],
        metavar="N",
        help="random seeds (default: 0 1 2)",
    )
    parser.add_argument("--variant", help="paper or clean (default: paper)")
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--steps",
        type=count,
        metavar="N",
        help="control steps of every cell (default: those of "
        "benchmarks/paper/settings.py; for --variant paper at most the paper's)",
    )
    length.add_argument(
        "--steps-fraction",
        type=float,
        metavar="F",
        help="fraction of the control steps to run",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("benchmarks/paper/records"),
        metavar="DIR",
        help="folder of the grid (default: benchmarks/paper/records)",
    )
    parser.add_argument(
        "--jobs",
        type=count,
        default=1,
        metavar="N",
        help="cells in parallel, each on its share of the cores (default: 1)",
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="repeat the cells that ran with other settings or steps",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="print cells, steps, settings and expected time, and run nothing",
    )
    parser.add_argument(
        "--json", action="store_true", help="print a list of cells instead of text"
    )


def run(args: argparse.Namespace) -> int:
    """Runs the grid, or says what it would run."""
    from benchmarks.paper.cell_records import Records
    from benchmarks.paper.plan import plan
    from benchmarks.paper.report import report

    if args.jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {args.jobs}")
    cells = plan(
        args.cases,
        args.algorithms,
        args.seeds,
        variant=args.variant,
        steps=args.steps,
        fraction=args.steps_fraction,
    )
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"out must be a folder, but {args.out} is a file")
    records = Records(args.out)
    if args.dry_run:
        _describe(cells, records, args.overwrite, args.json)
        return 0
    from benchmarks.paper.running import run_grid

    code = run_grid(
        cells,
        records,
        overwrite=args.overwrite,
        stream=sys.stderr,
        jobs=args.jobs,
    )
    if args.json:
        ended = [record for cell in cells if (record := records.get(cell))]
        print(json.dumps(ended, indent=2))
    elif code != 130:
        print(report(records).partition("Settings that")[0].rstrip())
        for name in ("results.csv", "results.md"):
            print(args.out / name)
    return code


def _describe(cells: list[Any], records: Any, overwrite: bool, as_json: bool) -> None:
    """Prints what would run, and for how long as far as is known."""
    from benchmarks.paper.running import changed_since
    from jaxrod.training.progress import duration

    rows = []
    for cell in cells:
        pace = [
            record["wall_s"] / record["env_steps"]
            for record in records
            if (record["config"]["task"], record["config"]["algorithm"])
            == (cell.task, cell.algorithm)
            and record["variant"] == cell.variant
            and record["status"] == "finished"
        ]
        record = records.get(cell)
        status = record["status"] if record else "waiting"
        if changed_since(cell, records):
            status = "waiting" if overwrite else "changed"
        rows.append(
            {
                "cell": cell.name,
                "status": status,
                "steps": cell.steps,
                "changed": list(cell.changed),
                "expected_s": sum(pace) / len(pace) * cell.steps if pace else None,
            }
        )
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    width = max(len(row["cell"]) for row in rows)
    for cell, row in zip(cells, rows, strict=True):
        known = row["expected_s"]
        time = "not measured" if known is None else duration(known)
        print(
            f"{row['cell']:<{width}}  {row['status']:<8}  {row['steps']:>10,} steps  "
            f"{time:<12}{cell.beside}  {' '.join(row['changed'])}".rstrip()
        )
    changed = sum(row["status"] == "changed" for row in rows)
    if changed:
        print(f"run with other settings or steps: {changed} (see --overwrite)")
    left = [row["expected_s"] for row in rows if row["status"] == "waiting"]
    known = [seconds for seconds in left if seconds is not None]
    print(
        f"{len(left)} of {len(rows)} cells to run: {duration(sum(known))} expected for "
        f"{len(known)} of them, {len(left) - len(known)} not measured"
    )
