"""Numbers and speed of the default accelerator beside the CPU's.

`equal` compares runs and gradients on the accelerator and on the CPU.
`rods` measures rod-steps per second of batches, and `tasks` control steps per second of
environments under random actions. Compiling is not counted, but stated.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.environments.run import ARMS, stepping
from benchmarks.lanes.run import crossing
from benchmarks.rod_steps.arms import N_ELEMENTS, advance_arms, arms
from benchmarks.rod_steps.pyelastica import TIME_STEP
from benchmarks.shared.arguments import add_names
from jaxrod.envs import make

SECTIONS = ("equal", "rods", "tasks")
RODS = (1, 1024, 4096, 16384, 65536, 262144, 1048576)
ENVIRONMENTS = (1024, 4096, 16384, 65536)
STEPS = 200
WINDOWS = 5

Timed = tuple[float, float]
"""Time of a call and time to compile it [s]."""


def arm(dtype: str) -> tuple[Any, Any, float]:
    """A soft arm with a tendon that touches a sphere."""
    rod, state = jaxrod.straight_rod(
        20, length=1.0, radius=0.02, density=1000.0, youngs_modulus=1e6, dtype=dtype
    )
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity(),
        jaxrod.exponential_damping(0.5),
        jaxrod.contact(
            jaxrod.shapes.sphere((0.6, 0.0, -0.1), 0.06), stiffness=1e4, damping=1.0
        ),
        jaxrod.actuation.tendon(rod, (0.015, 0.0), tension=0.5),
    )
    return scene, state, 1e-4


def comparisons(dtype: str) -> Iterator[tuple[str, Callable[..., Any], Any]]:
    """Names of programs, the programs, and their arguments."""

    def run(model: Any, dt: float, parts: Any) -> Callable[[Any], Any]:
        def program(state: Any) -> Any:
            ended = jaxrod.advance(model, state, dt, STEPS)
            return [(part.positions, part.velocities) for part in parts(ended)]

        return program

    scene, state, dt = arm(dtype)
    yield f"arm, {STEPS} steps", run(scene, dt, lambda end: [end]), state
    system, states, fine = crossing("crossing_contact", 25, dtype)
    both = lambda end: [end[name] for name in states]
    yield f"two ropes with lists, {STEPS} steps", run(system, fine, both), states

    def height(speed: Any) -> Any:
        begun = replace(state, velocities=state.velocities + speed)
        return jaxrod.advance(scene, begun, dt, STEPS).positions[2, -1]

    yield "arm, gradient of a run", jax.grad(height), jnp.asarray(0.1, dtype)
    batch = jnp.linspace(-0.5, 0.5, 64, dtype=dtype)
    yield "arm, 64 gradients", jax.vmap(jax.grad(height)), batch


def equal() -> None:
    """Largest differences from float64 on the CPU, over the largest number."""
    cpu = jax.devices("cpu")[0]
    print("| program | dtype | accelerator | CPU | the same bits again |")
    print("|---|---|---:|---:|---|")
    for case, exact in zip(comparisons("float32"), comparisons("float64"), strict=True):
        name, program, given = exact
        there = jax.device_put(given, cpu)
        reference = jax.block_until_ready(jax.jit(program)(there))
        for dtype, (_, program, given) in (("float32", case), ("float64", exact)):
            compiled = jax.jit(program)
            found = jax.block_until_ready(compiled(given))
            same = _equal_bits(found, compiled(given))
            here = jax.jit(program)(jax.device_put(given, cpu))
            errors = [f"{_difference(x, reference):.1e}" for x in (found, here)]
            again = "yes" if same else "no"
            print(f"| {name} | {dtype} | {' | '.join(errors)} | {again} |", flush=True)


def _difference(found: Any, reference: Any) -> float:
    """Largest difference of any array over that array's largest number."""
    return max(
        float(np.max(np.abs(np.asarray(x, float) - y)) / np.max(np.abs(y)))
        for x, y in zip(
            jax.tree.leaves(found),
            map(np.asarray, jax.tree.leaves(reference)),
            strict=True,
        )
    )


def _equal_bits(found: Any, again: Any) -> bool:
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


def median_time(call: Callable[[], Any]) -> Timed:
    """Median of some windows, and the time of the first call."""
    begin = time.perf_counter()
    call()
    first = time.perf_counter() - begin
    times = []
    for _ in range(WINDOWS):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return float(np.median(times)), first


def rods(dtypes: tuple[str, ...], batches: tuple[int, ...]) -> None:
    """Rod-steps per second of arms of 20 elements, each under couples of its own."""
    print(f"| rods of {N_ELEMENTS} elements | dtype | rod-steps/s | first call [s] |")
    print("|---:|---|---:|---:|")
    for dtype in dtypes:
        for batch in batches:
            with jax.enable_x64(dtype == "float64"):
                scene, couples, states = arms(batch, "consistent")
            dt = jnp.asarray(TIME_STEP, dtype)
            steps = jnp.int32(min(2000, max(20, 40_000_000 // (batch * 20))))
            run = jax.jit(advance_arms)
            per, first = median_time(
                lambda run=run, given=(scene, couples, states, dt, steps): (
                    jax.block_until_ready(run(*given))
                )
            )
            ended = np.asarray(run(scene, couples, states, dt, steps).positions)
            if not (np.all(np.isfinite(ended)) and np.ptp(ended, axis=0).max() < 1e-5):
                raise FloatingPointError("equal arms did not move alike")
            speed = batch * int(steps) / per
            print(f"| {batch:,} | {dtype} | {speed:,.0f} | {first:.1f} |", flush=True)


def tasks(names: tuple[str, ...], batches: tuple[int, ...]) -> None:
    """Control steps per second of tasks, restarts and scores included."""
    print("| task | environments | control steps/s | first call [s] |")
    print("|---|---:|---:|---:|")
    for name in names:
        env = make(name, variant="clean")
        for batch in batches:
            steps, call = stepping(env, batch, jax.devices()[:1])
            per, first = median_time(call)
            speed = steps / per
            print(f"| {name} | {batch:,} | {speed:,.0f} | {first:.1f} |", flush=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares what to measure."""
    add_names(parser, "sections", SECTIONS, "SECTION")
    parser.add_argument("--batches", type=int, nargs="+", metavar="N")
    parser.add_argument("--dtypes", nargs="+", default=["float32", "float64"])
    parser.add_argument("--tasks", nargs="+", default=list(ARMS), choices=ARMS)


def run(args: argparse.Namespace) -> int:
    """Measures and prints."""
    jax.config.update("jax_enable_x64", True)
    print(f"{jax.devices()[0].device_kind}, JAX {jax.__version__}", flush=True)
    chosen = args.sections
    if "equal" in chosen:
        equal()
    if "rods" in chosen:
        rods(tuple(args.dtypes), tuple(args.batches or RODS))
    if "tasks" in chosen:
        jax.config.update("jax_enable_x64", False)
        tasks(tuple(args.tasks), tuple(args.batches or ENVIRONMENTS))
    return 0
