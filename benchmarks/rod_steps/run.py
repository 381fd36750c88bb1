"""Measure rod-steps per second on this machine, compared with PyElastica.

The arm has 20 elements and is clamped, damped and actuated. The command steps batches
of it in float32 and float64, with both elastic laws, spread over the CPU cores. (A
single arm runs on one core.) PyElastica steps the same arm in the same run, before,
between and after the batches. On a busy machine, compare ratios instead of rates. Rates
exclude compiling. A rate is the median of at least five windows. Before it times a
batch, the command compares the arms of the batch with a single one.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import Any

EXAMPLES = """\
examples:
  jaxrod benchmark                          everything, in about two minutes
  jaxrod benchmark --batches 1 1024 --dtypes float32 --modes consistent
  jaxrod benchmark --json > here.json       for a script
  jaxrod benchmark --out benchmarks/rod_steps/my_machine
  JAX_PLATFORMS=cpu jaxrod benchmark        leave the accelerator out
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod benchmark`."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "--batches",
        type=int,
        nargs="+",
        metavar="N",
        help="numbers of arms (default: 1 64 256 1024 4096)",
    )
    parser.add_argument(
        "--dtypes",
        nargs="+",
        metavar="TYPE",
        help="float32, float64 or both (default: both)",
    )
    parser.add_argument(
        "--modes",
        nargs="+",
        metavar="MODE",
        help="consistent, pyelastica or both (default: both)",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=1.5,
        metavar="S",
        help="time of each measurement [s] (default: 1.5)",
    )
    parser.add_argument(
        "--devices",
        type=int,
        metavar="N",
        help="CPU devices to spread batches over (default: one per core)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="also write DIR/rod_steps.json and DIR/rod_steps.md",
    )
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object instead of a table"
    )


def run(args: argparse.Namespace) -> int:
    """Measures and prints."""
    import jaxrod

    jaxrod.configure_cpu(args.devices)
    from benchmarks.rod_steps import measuring
    from benchmarks.rod_steps.arms import N_ELEMENTS
    from benchmarks.rod_steps.pyelastica import TIME_STEP
    from jaxrod.files import write_atomically
    from jaxrod.installation.machine import machine_facts
    from jaxrod.lanes.choice import slower
    from jaxrod.methods.laws import IN_SPACE

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
    try:
        report = measuring.run_benchmark(
            args.batches or measuring.BATCHES,
            args.dtypes or measuring.DTYPES,
            args.modes or tuple(IN_SPACE),
            seconds=args.seconds,
            say=lambda line: print(line, file=sys.stderr, flush=True),
        )
    except FloatingPointError as error:
        print(f"jaxrod benchmark: {error}", file=sys.stderr)
        return 1
    machine = machine_facts(load)
    result = {
        "pyelastica_steps_per_s": report.pyelastica_steps_per_s,
        "rows": [dataclasses.asdict(row) for row in report.rows],
        "pyelastica_measurements": list(report.pyelastica),
        "n_elements": N_ELEMENTS,
        "dt": TIME_STEP,
        "machine": machine,
        "slower": slower(),
    }
    text = json.dumps(result, indent=2)
    if args.out is not None:
        write_atomically(args.out / "rod_steps.json", f"{text}\n".encode())
        write_atomically(args.out / "rod_steps.md", page(result).encode())
    print(text if args.json else _table(result).rstrip())
    return 0


def page(record: dict[str, Any]) -> str:
    """The page of a record."""
    return f"# Rod-steps per second\n\n{_table(record)}"


def _table(record: dict[str, Any]) -> str:
    """A record as a Markdown table, which reads well in a terminal too."""
    machine = record["machine"]
    versions = ", ".join(f"{name} {v}" for name, v in machine["versions"].items())
    lines = [f"{machine['processor']}, {machine['devices']}; {versions}", ""]
    unit = record["pyelastica_steps_per_s"]
    if unit is None:
        lines.append(
            "PyElastica is not installed, so there is nothing to compare with "
            "(pip install pyelastica)."
        )
    else:
        beside = record["pyelastica_measurements"]
        low, high = min(beside), max(beside)
        lines.append(
            f"PyElastica: {unit:,.0f} steps/s in one process (median of "
            f"{len(beside)} measurements, {low:,.0f} to {high:,.0f})."
        )
    load, cores = machine["load_average_before"], machine["cores"]
    if load is not None and load > 0.25 * cores:
        lines.append(
            f"The machine was busy already (load average {load:.1f} on {cores} cores): "
            "neither rates nor ratios are what an idle one gives."
        )
    heads = ("mode", "dtype", "batch", "rod-steps/s", "x PyElastica", "devices")
    body = [
        (
            row["mode"],
            row["dtype"],
            str(row["batch"]),
            f"{row['rod_steps_per_s']:,.0f}",
            f"{row['times_pyelastica']:.1f}" if row["times_pyelastica"] else "-",
            str(row["devices"]),
        )
        for row in record["rows"]
    ]
    widths = [max(len(line[i]) for line in (heads, *body)) for i in range(len(heads))]
    rule = tuple("-" * (w - 1) + (":" if i > 1 else "-") for i, w in enumerate(widths))
    lines.append("")
    for line in (heads, rule, *body):
        cells = (
            f"{cell:>{width}}" if i > 1 else f"{cell:<{width}}"
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        lines.append(f"| {' | '.join(cells)} |")
    compiling = sum(row["compile_s"] for row in record["rows"])
    lines += [
        "",
        f"Compiling took {compiling:.0f} s and is not counted.",
        record["slower"] or "Batches on CPUs run in lanes (docs/performance.md).",
    ]
    return "\n".join(lines) + "\n"
