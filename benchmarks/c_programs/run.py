"""Single rods in rows and by XLA beside a C program of the same law.

The C program is compiled for one number of elements and one type, with vectors of 256
and of 512 bits, and the faster one counts. All programs start from the same state.
Their states after some steps are compared before any is timed.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.installation.machine import processor_and_versions
from jaxrod.methods.consistent import ConsistentStepper

LENGTHS = (20, 50, 200, 1000)
DTYPES = ("float32", "float64")
FLAGS = "-O3 -march=native -fno-math-errno -fno-trapping-math -ffp-contract=fast"
WINDOWS = 15
COMPARED = 100
TOLERANCE = {"float32": 1e-3, "float64": 1e-11}
"""Largest difference of positions and velocities, over the largest number [1]."""


def scene_of(n: int, dtype: str) -> tuple[Any, Any, Any]:
    """A clamped, damped rod that begins to fall, and half of its largest step."""
    rod, state = jaxrod.straight_rod(
        n,
        length=1.0,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        dtype=dtype,
    )
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity((0.0, -9.81, 0.5)),
        jaxrod.exponential_damping(0.7),
    )
    return scene, state, 0.5 * jaxrod.stable_dt(scene).dt


def compiled(n: int, dtype: str, bits: int, folder: Path) -> Any:
    """The C program for `n` elements and vectors of so many bits."""
    source = Path(__file__).with_name("rod.c")
    library = folder / f"rod_{n}_{dtype}_{bits}.so"
    kind = {"float32": "float", "float64": "double"}[dtype]
    words = f"cc {FLAGS} -mprefer-vector-width={bits} -DN={n} -DT={kind} -shared -fPIC"
    words += f" {source} -o {library} -lm"
    subprocess.run(words.split(), check=True)
    found = ctypes.CDLL(str(library))
    found.advance.argtypes = (
        ctypes.c_void_p,
        ctypes.c_void_p,
        ctypes.c_double,
        ctypes.c_int,
    )
    return found


def numbers_of(scene: Any, dt: Any, dtype: str) -> np.ndarray:
    """Constants of the rod, in the order of the C program's struct."""
    stepper = ConsistentStepper.create(scene, dt)
    n = scene.rod.n_elements
    clamp, gravity, _ = scene.effects
    wall = clamp.wall(scene.rod)
    joints = np.concatenate(
        [np.asarray(wall.stiffness)[:, None], np.stack(stepper.law.joint)], axis=1
    )
    weight = np.asarray(gravity.acceleration)[:, None] * np.asarray(
        scene.rod.node_masses
    )
    spread = lambda x, k: np.broadcast_to(np.asarray(x), (k,))
    fields = (
        stepper.law.inverse_lengths,
        np.stack(stepper.law.shear_stretch),
        joints,
        wall.orientation,
        weight,
        stepper.velocity_kick.gain,
        spread(stepper.velocity_kick.loss, n + 1),
        spread(stepper.spin_kick.gain, n),
        spread(stepper.spin_kick.loss, n),
        stepper.inverse_inertia,
        stepper.inertia_contrast,
    )
    return np.concatenate([np.asarray(f, dtype).ravel() for f in fields])


FIELDS = ("positions", "velocities", "orientations", "angular_momenta")


def row(n: int, dtype: str, folder: Path, window: float) -> str:
    """One row of the table.

    Raises:
        FloatingPointError: If the programs do not agree.
    """
    with jax.enable_x64(dtype == "float64"):
        scene, state, dt = scene_of(n, dtype)
        dt = jnp.asarray(dt, dtype)
        programs = [compiled(n, dtype, bits, folder) for bits in (256, 512)]
        constants = numbers_of(scene, dt, dtype)
        start = np.concatenate([np.asarray(getattr(state, f)).ravel() for f in FIELDS])

        def in_c(program: Any, steps: int) -> np.ndarray:
            now = start.copy()
            program.advance(now.ctypes.data, constants.ctypes.data, float(dt), steps)
            return now

        steps = jnp.int32(max(200, 200_000 // n))
        runs: dict[str, Callable[[], Any]] = {
            f"C {k}": lambda program=program: in_c(program, int(steps))
            for k, program in enumerate(programs)
        }
        for mode, name in (("auto", "rows"), ("never", "XLA")):
            jaxrod.use_lanes(mode)
            run = jax.jit(lambda state, k: jaxrod.advance(scene, state, dt, k))
            ended = run(state, jnp.int32(COMPARED))
            there = in_c(programs[0], COMPARED)
            found = np.concatenate(
                [np.asarray(getattr(ended, f)).ravel() for f in FIELDS]
            )
            apart = np.max(np.abs(found - there)) / np.max(np.abs(there))
            if not apart < TOLERANCE[dtype]:
                raise FloatingPointError(
                    f"{name} and C differ by {apart:.1e}, n = {n}, {dtype}"
                )
            runs[name] = lambda run=run: jax.block_until_ready(run(state, steps))
        per = {k: 1e6 * t / int(steps) for k, t in times(runs, window).items()}
        per["C"] = min(per["C 0"], per["C 1"])
    shares = [f"{per['rows'] / per['C']:.2f}", f"{per['XLA'] / per['C']:.1f}"]
    figures = [f"{per[k]:.3g}" for k in ("C", "rows", "XLA")]
    return f"| {n} | {dtype} | {' | '.join([*figures, *shares])} | {apart:.0e} |"


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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares lengths, types and the time to measure."""
    parser.add_argument("--lengths", type=int, nargs="+", default=list(LENGTHS))
    parser.add_argument("--dtypes", nargs="+", default=list(DTYPES), choices=DTYPES)
    parser.add_argument("--seconds", type=float, default=0.1)


def run(args: argparse.Namespace) -> int:
    """Measures and prints the table."""
    jaxrod.configure_cpu(1)
    heads = "elements | type | C [us a step] | rows | XLA | rows / C | XLA / C | apart"
    print(f"{processor_and_versions()}; cc {FLAGS}\n\n| {heads} |")
    print("|---:|---|---:|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        for dtype in args.dtypes:
            for n in args.lengths:
                print(row(n, dtype, Path(folder), args.seconds), flush=True)
    return 0
