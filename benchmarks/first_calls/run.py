"""Processor time before the first answer, in a first and in a second process.

Each program runs in a separate process. "First process" finds no programs on disk.
"Second process" finds those of an earlier process. `again` repeats the call in the same
process, which compiles nothing. For tasks, the number is the wall-clock time until a
short training run has compiled everything.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.first_calls import programs
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import ROOT
from jaxrod.envs import names as task_names

PROGRAMS = (
    "readme_rod",
    "readme_numbers",
    "readme_system",
    "system_advance",
    "system_rollout",
    "system_gradient",
    "equilibrium",
    "system_equilibrium",
    "friction_equilibrium",
    "tendon_equilibrium",
    "tendon_friction_equilibrium",
    "implicit_advance",
    "levenberg_marquardt",
    "adam",
    "mpc",
    "fit",
    "identify",
    "linearise",
)
HEAD = (
    "| program | import [s] | model [s] | first call [s] | programs | kernels "
    "| second process: first call [s] | again [s] |\n"
    "|---|---:|---:|---:|---:|---:|---:|---:|"
)
TASKS_HEAD = "| task | compiling [s] | second process [s] |\n|---|---:|---:|"


def measured(name: str, cache: str) -> dict[str, Any]:
    """Measures one program in a process of its own, see `child`.

    `cache` is the folder of compiled programs, or "0" for none.
    """
    words = ["-m", "benchmarks.first_calls.child", name]
    return json.loads(_said(words, cache).splitlines()[-1])


def compiling(task: str, cache: str) -> float:
    """Time until all programs of a short training are compiled [s]."""
    with tempfile.TemporaryDirectory() as folder:
        short = "--steps 2k --num-envs 8 --set rollout_steps=32 --no-replay --json"
        words = [
            "-m",
            "jaxrod",
            "train",
            task,
            *short.split(),
            "--out",
            f"{folder}/run",
        ]
        return float(json.loads(_said(words, cache))["compile_s"])


def _said(words: Sequence[str], cache: str) -> str:
    """Standard output of a Python process."""
    done = subprocess.run(
        [sys.executable, *words],
        env={**os.environ, "JAXROD_CACHE": cache},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(words)} failed:\n{done.stderr[-2000:]}")
    return done.stdout


def row(name: str, folder: Path) -> str:
    """Row of a program; `folder` is an empty one for compiled programs."""
    first = measured(name, "0")
    measured(name, str(folder))
    second = measured(name, str(folder))
    doc = (getattr(programs, name).__doc__ or "").strip().rstrip(".")
    return (
        f"| {doc} | {first['import']:.1f} | {first['prepare']:.1f} | "
        f"{first['call']:.1f} | {first['programs']} | {first['kernels']} | "
        f"{second['call']:.1f} | {first['again']:.2f} |"
    )


def task_row(task: str, folder: Path) -> str:
    """Row of a task; `folder` is an empty one for compiled programs."""
    first = compiling(task, "0")
    compiling(task, str(folder))
    return f"| `{task}` | {first:.1f} | {compiling(task, str(folder)):.1f} |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the programs and tasks."""
    tasks = tuple(task_names())
    add_names(parser, "names", (*PROGRAMS, *tasks), "NAME", default=PROGRAMS)


def run(args: argparse.Namespace) -> int:
    """Measures and prints."""
    for head, known, made in (
        (HEAD, PROGRAMS, row),
        (TASKS_HEAD, tuple(task_names()), task_row),
    ):
        chosen = [name for name in args.names if name in known]
        if chosen:
            print(head, flush=True)
        for name in chosen:
            with tempfile.TemporaryDirectory() as folder:
                print(made(name, Path(folder)), flush=True)
    return 0
