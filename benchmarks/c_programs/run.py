"""Rods and systems in rows compared with C programs of the same laws.

A compiler makes each C program for its numbers of elements and one type, with vectors
of 256 and of 512 bits, and the faster one counts. All programs start from the same
state. The benchmark compares their states after some steps, and then times them.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.c_programs.programs import (
    FLAGS,
    RECORDED,
    Program,
    kind,
    numbers_of_state,
    recorded,
    settings_of_lists,
)
from benchmarks.c_programs.scenes import SCENES, Compared, refreshed, rods
from benchmarks.shared.arguments import add_names
from jaxrod.installation.machine import processor_and_versions

LENGTHS = (20, 50, 200, 1000)
DTYPES = ("float32", "float64")
WINDOWS = 15
COMPARED = 100
TOLERANCE = {"float32": 0.05, "float64": 1e-11}
"""Largest difference of any number of the state, over the largest number [1].

In float32 rows and XLA differ by 2e-2 in the coil, whose elements are nearly parallel.
"""
OFTEN = 4
"""Steps between searches in the run that shows what a search costs."""


@dataclass(frozen=True)
class Problem:
    """A scene in one type, with all arguments of its C program."""

    compared: Compared
    model: Any
    state: Any
    dt: float
    dtype: str
    settings: dict[str, Any]
    """Numbers that the C program is compiled for."""
    start: np.ndarray
    """State of the C program."""
    constants: np.ndarray

    @staticmethod
    def of(compared: Compared, dtype: str) -> Problem:
        """Builds the scene in a type."""
        model, state, dt = compared.build(dtype)
        dt = float(np.asarray(dt, dtype))
        settings = {**compared.settings, "T": kind(dtype)}
        numbers = [numbers_of_state(state, compared.members)]
        if "EVERY" in (lists := lists_of(model)):
            # What the program records, and how many pairs it kept.
            numbers.append(np.zeros(len(RECORDED) + 1, dtype))
        return Problem(
            compared,
            model,
            state,
            dt,
            dtype,
            {**settings, **lists},
            np.concatenate(numbers),
            compared.constants(model, state, dt, dtype),
        )

    def program(self, bits: int, folder: Path, **changes: int) -> Program:
        """The C program, with vectors of `bits` bits."""
        settings = {**self.settings, **changes}
        return Program(self.compared.source, settings, bits, folder)

    def in_c(self, program: Program, steps: int) -> np.ndarray:
        """State of the C program after some steps."""
        return program(self.start, self.constants, self.dt, steps)

    def jaxrods(self, model: Any) -> Callable[[int], Any]:
        """Function from a number of steps to jaxrod's state after them."""
        run = jax.jit(lambda state, k: jaxrod.advance(model, state, self.dt, k))
        return lambda steps: jax.block_until_ready(run(self.state, jnp.int32(steps)))

    def apart(self, ended: Any, there: np.ndarray) -> float:
        """Largest difference of two states, over the largest number [1].

        Raises:
            FloatingPointError: If they differ by more than rounding, or in the records
                of their neighbour lists.
        """
        found = numbers_of_state(ended, self.compared.members)
        state, record = np.split(there, [len(found)])
        apart = float(np.max(np.abs(found - state)) / np.max(np.abs(state)))
        if not apart < TOLERANCE[self.dtype]:
            raise FloatingPointError(f"jaxrod and C differ by {apart:.1e}")
        own = recorded(ended, self.compared.members)
        scale = 10 * TOLERANCE[self.dtype]
        if not np.allclose(own, record[: len(own)], rtol=scale, atol=scale):
            raise FloatingPointError(f"{RECORDED} differ: {own} and {record}")
        return apart


def lists_of(model: Any) -> dict[str, int]:
    """Sizes of neighbour lists, as definitions for a C compiler; none without lists."""
    for coupling in getattr(model, "couplings", ()):
        if coupling.refresh_every is not None:
            return settings_of_lists(coupling)
    return {}


def figures(
    compared: Compared, dtype: str, folder: Path, window: float
) -> dict[str, float]:
    """Times of all programs of a scene [us a step], and largest difference [1]."""
    with jax.enable_x64(dtype == "float64"):
        problem = Problem.of(compared, dtype)
        runs: dict[str, Callable[[int], Any]] = {}
        programs = [problem.program(bits, folder) for bits in (256, 512)]
        for k, program in enumerate(programs):
            runs[f"C {k}"] = partial(problem.in_c, program)
        there, apart = problem.in_c(programs[0], COMPARED), 0.0
        for mode, name in (("auto", "rows"), ("never", "XLA")):
            jaxrod.use_lanes(mode)
            runs[name] = problem.jaxrods(problem.model)
            apart = max(apart, problem.apart(runs[name](COMPARED), there))
        every = problem.settings.get("EVERY")
        if every:
            for k, bits in enumerate((256, 512)):
                often = problem.program(bits, folder, EVERY=OFTEN)
                runs[f"C often {k}"] = partial(problem.in_c, often)
            jaxrod.use_lanes("auto")
            runs["rows often"] = problem.jaxrods(refreshed(problem.model, OFTEN))
        steps = compared.steps
        timed = {name: partial(run, steps) for name, run in runs.items()}
        per = {name: 1e6 * t / steps for name, t in times(timed, window).items()}
        best = 0 if per["C 0"] < per["C 1"] else 1
        per["C"] = per[f"C {best}"]
        if every:
            per["C often"] = per[f"C often {best}"]
            for name in ("C", "rows"):
                more = per[f"{name} often"] - per[name]
                search = more / (1 / OFTEN - 1 / every)
                per[f"{name} search"] = search
                per[f"{name} inner"] = per[name] - search / every
            kept = problem.in_c(programs[0], steps)[-3:]
            per["listed"], per["kept"] = kept[1], kept[2] / steps
        return {**per, "apart": apart}


def times(runs: dict[str, Callable[[], Any]], window: float) -> dict[str, float]:
    """Least processor time of a call of each [s]; windows alternate."""
    found: dict[str, list[float]] = {name: [] for name in runs}
    calls = {}
    for name, run in runs.items():
        begin = time.process_time()
        run()
        once = time.process_time() - begin
        calls[name] = max(1, round(window / max(once, 1e-6)))
    for _ in range(WINDOWS):
        for name, run in runs.items():
            begin = time.process_time()
            for _ in range(calls[name]):
                run()
            found[name].append((time.process_time() - begin) / calls[name])
    return {name: min(taken) for name, taken in found.items()}


def row(title: str, dtype: str, per: dict[str, float]) -> str:
    """One row of a table of steps."""
    cells = [f"{per[k]:.3g}" for k in ("C", "rows", "XLA")]
    cells += [f"{per['rows'] / per['C']:.2f}", f"{per['XLA'] / per['C']:.1f}"]
    return f"| {title} | {dtype} | {' | '.join(cells)} | {per['apart']:.0e} |"


def search_row(title: str, dtype: str, per: dict[str, float]) -> str:
    """One row of the table of searches for neighbours."""
    cells = [f"{per[k]:.3g}" for k in ("C inner", "rows inner")]
    cells.append(f"{per['rows inner'] / per['C inner']:.2f}")
    cells += [f"{per[k]:.0f}" for k in ("C search", "rows search")]
    cells += [f"{per['listed']:.0f}", f"{per['kept']:.1f}"]
    return f"| {title} | {dtype} | {' | '.join(cells)} |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares scenes, lengths of single rods, types and the time to measure."""
    add_names(parser, "scenes", ("rods", *SCENES), "SCENE")
    parser.add_argument(
        "--lengths", type=int, nargs="+", default=list(LENGTHS), help="of single rods"
    )
    parser.add_argument("--dtypes", nargs="+", default=list(DTYPES), choices=DTYPES)
    parser.add_argument("--seconds", type=float, default=0.1, help="of a window")


HEADS = "type | C [us a step] | rows | XLA | rows / C | XLA / C | apart"
SEARCH_HEADS = (
    "scene | type | C, without searches [us a step] | rows | rows / C | "
    "C [us a search] | rows | pairs listed | not left out by C"
)


def run(args: argparse.Namespace) -> int:
    """Measures and prints the tables."""
    jaxrod.configure_cpu(1)
    print(f"{processor_and_versions()}; cc {FLAGS}")
    scenes = {name: SCENES[name] for name in args.scenes if name != "rods"}
    single = {str(n): rods(n) for n in args.lengths if "rods" in args.scenes}
    searches = []
    with tempfile.TemporaryDirectory() as folder:
        for kind_of, group in (("elements", single), ("scene", scenes)):
            if group:
                print(f"\n| {kind_of} | {HEADS} |\n|---|---|{6 * '---:|'}")
            for dtype in args.dtypes:
                for compared in group.values():
                    per = figures(compared, dtype, Path(folder), args.seconds)
                    print(row(compared.title, dtype, per), flush=True)
                    if "listed" in per:
                        searches.append(search_row(compared.title, dtype, per))
    if searches:
        print(
            "\n".join([f"\n| {SEARCH_HEADS} |", f"|---|---|{7 * '---:|'}", *searches])
        )
    return 0
