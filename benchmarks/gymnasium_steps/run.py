"""Control steps per second of one environment through Gymnasium.

`gymnasium.make` makes each id, with Gymnasium's usual wrappers. The environment runs
under random actions, on one core and with `configure_cpu(1)`. Ids of other packages are
`module:id`. The result is the best and the median of many short bursts, which reduces
the influence of other work on the machine. Speeds exclude compiling. On a busy machine
the system interrupts long bursts, but steps per second of processor time do not change.

`--softrobot` names a Python that has gym-softrobot, for example of a separate
environment (`python -m venv x; x/bin/pip install gym-softrobot`). The same function
measures its `SoftArmTracking-v0`, PyElastica's arm in a similar task, on the same core:
one half before ours, one half after. The two have different control steps, so the
benchmark also prints steps of the rod and seconds of its motion.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
from pathlib import Path
from typing import Any

import jaxrod
from benchmarks.gymnasium_steps.bursts import BURST, OURS, THEIRS, bursts
from benchmarks.shared.clocks import pin_to_one_core
from jaxrod.installation.machine import processor_and_versions

BURSTS = Path(__file__).with_name("bursts.py")
SECONDS = 30.0
"""Bursts end after so long."""


def in_other_python(python: str, seconds: float) -> dict[str, Any]:
    """Bursts of gym-softrobot's arm, in a process with another Python.

    Raises:
        ValueError: That Python cannot run it.
    """
    try:
        done = subprocess.run(
            [python, "-W", "ignore", str(BURSTS), THEIRS, str(seconds)],
            capture_output=True,
            text=True,
        )
    except OSError as error:
        raise ValueError(f"--softrobot {python}: {error.strerror}") from None
    if done.returncode or not done.stdout:
        last = done.stderr.strip().rpartition("\n")[2] or "it said nothing"
        raise ValueError(f"--softrobot {python} could not measure {THEIRS}: {last}")
    measured: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return measured


def line(name: str, measured: dict[str, Any]) -> str:
    """Measurements of an id, as text."""
    best, median = max(measured["speeds"]), statistics.median(measured["speeds"])
    busy = BURST * len(measured["speeds"]) / measured["busy"]
    words = (
        f"{name}: best {best:,.0f}, median {median:,.0f} control steps/s, {busy:,.0f} "
        "in a second of processor time"
    )
    steps = measured["steps"]
    if steps:
        words += (
            f"; of {steps} steps of {measured['elements']} elements: "
            f"{busy * steps:,.0f} rod-steps in it"
        )
    if measured["seconds"]:
        words += f", {busy * measured['seconds']:.2f} s of motion"
    return words


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the environments."""
    parser.add_argument("ids", nargs="*", default=[OURS], help=f"by default {OURS}")
    parser.add_argument(
        "--softrobot", metavar="PYTHON", help=f"measure {THEIRS} beside, in this Python"
    )


def run(args: argparse.Namespace) -> int:
    """Measures and prints."""
    pin_to_one_core()
    jaxrod.configure_cpu(1)
    print(processor_and_versions(), f"; load {os.getloadavg()[0]:.1f}", sep="")
    theirs: dict[str, Any] = {}
    half = SECONDS / 2
    if args.softrobot:
        python = str(Path(args.softrobot).absolute())
        theirs = in_other_python(python, half)
    for name in args.ids:
        print(line(name, bursts(name, SECONDS)))
    if args.softrobot:
        again = in_other_python(python, half)
        theirs["speeds"] += again["speeds"]
        theirs["busy"] += again["busy"]
        print(line(THEIRS, theirs))
    return 0
