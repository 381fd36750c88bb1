"""Batches of rods in lanes compared with a C program of the same law.

The C program has a rod in each lane of a vector of 512 bits, and makes one pass along
the rods for a step. A compiler makes it for one number of elements and one type. All
programs start from the same states. The benchmark compares their states after some
steps, and then times them.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.c_programs.programs import (
    FIELDS,
    FLAGS,
    constants_of_scene,
    kind,
    numbers_of_state,
)
from benchmarks.c_programs.run import COMPARED, DTYPES, times
from benchmarks.c_programs.scenes import rod
from jaxrod.installation.machine import processor_and_versions

LENGTHS = (20, 50, 100, 200, 500, 1000)
TOLERANCE = {"float32": 1e-2, "float64": 1e-10}
"""Largest difference of any number after the first steps, over the largest number."""
MODES = {"auto": "chosen", "loops": "lanes in loops", "rows": "rows", "never": "XLA"}


def compiled(n: int, dtype: str) -> Any:
    """The C program for `n` elements."""
    source = Path(__file__).with_name("rods.c")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "rods.so"
        given = f"-DN={n} -DT={kind(dtype)} -shared -fPIC {source} -o {library} -lm"
        subprocess.run(["cc", *FLAGS.split(), *given.split()], check=True)
        found = ctypes.CDLL(str(library))
    given = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double, *[ctypes.c_int] * 2)
    found.advance.argtypes = given
    return found


def advanced(scene: Any, dt: Any, state: Any, steps: Any) -> Any:
    """State of one rod after some steps."""
    return jaxrod.advance(scene, state, dt, steps)


def row(n: int, dtype: str, rods: int, modes: list[str], window: float) -> str:
    """One row of the table.

    Raises:
        FloatingPointError: If the programs do not agree.
    """
    with jax.enable_x64(dtype == "float64"):
        scene, state, dt = rod(n, dtype)
        dt = jnp.asarray(dt, dtype)
        program = compiled(n, dtype)
        constants = constants_of_scene(scene, state, float(dt), dtype)
        begun = np.tile(numbers_of_state(state, ()), (rods, 1))
        # The rods begin with different velocities, which grow along them.
        rates = slice(3 * (n + 1), 6 * (n + 1))
        along = np.tile(np.linspace(0, 0.01, n + 1), 3)
        begun[:, rates] += np.arange(rods)[:, None] / rods * along
        many = jax.tree.map(lambda leaf: jnp.stack([leaf] * rods), state)
        shape = many.velocities.shape
        many = jaxrod.RodState(
            many.positions,
            many.orientations,
            jnp.asarray(begun[:, rates].reshape(shape)),
            many.angular_momenta,
        )

        def in_c(steps: int) -> np.ndarray:
            now = begun.copy()
            given = now.ctypes.data, constants.ctypes.data, float(dt), steps, rods
            program.advance(*given)
            return now

        steps = max(20, 20_000 // n)
        runs: dict[str, Callable[[], Any]] = {"C": lambda: in_c(steps)}
        there, first = in_c(COMPARED), {}
        for mode in modes:
            jaxrod.use_lanes(mode)
            # A new function for each mode, so that it is compiled again.
            one = jax.vmap(partial(advanced, scene, dt), in_axes=(0, None))
            run = jax.jit(lambda states, k, one=one: one(states, k))
            begin = time.perf_counter()
            ended = jax.block_until_ready(run(many, jnp.int32(COMPARED)))
            first[mode] = time.perf_counter() - begin
            found = np.concatenate(
                [np.asarray(getattr(ended, f)).reshape(rods, -1) for f in FIELDS], 1
            )
            apart = np.max(np.abs(found - there)) / np.max(np.abs(there))
            if not apart < TOLERANCE[dtype]:
                raise FloatingPointError(
                    f"{mode} and C differ by {apart:.1e}, n = {n}, {dtype}"
                )
            call = lambda run=run: jax.block_until_ready(run(many, jnp.int32(steps)))
            runs[mode] = call
        per = {k: 1e6 * t / steps / rods for k, t in times(runs, window).items()}
    figures = [f"{per[k]:.3g}" for k in ("C", *modes)]
    figures += [f"{per['C'] / per[k]:.2f}" for k in modes]
    figures += [f"{first[k]:.1f}" for k in modes]
    return f"| {n} | {dtype} | {' | '.join(figures)} |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares lengths, types, the batch and the time to measure."""
    parser.add_argument("--lengths", type=int, nargs="+", default=list(LENGTHS))
    parser.add_argument("--dtypes", nargs="+", default=list(DTYPES), choices=DTYPES)
    parser.add_argument("--rods", type=int, default=64, help="a multiple of 16")
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=MODES)
    parser.add_argument("--seconds", type=float, default=0.1)


def run(args: argparse.Namespace) -> int:
    """Measures and prints the table."""
    jaxrod.configure_cpu(1)
    names = [MODES[mode] for mode in args.modes]
    heads = ["elements", "type", "C [us a rod-step]", *names]
    heads += [f"C / {name}" for name in names] + [f"first call, {k} [s]" for k in names]
    print(f"{processor_and_versions()}; cc {FLAGS}; {args.rods} rods\n")
    print(f"| {' | '.join(heads)} |")
    print("|---:|---|" + "---:|" * (len(heads) - 2))
    for dtype in args.dtypes:
        for n in args.lengths:
            made = row(n, dtype, args.rods, args.modes, args.seconds)
            print(made, flush=True)
    return 0
