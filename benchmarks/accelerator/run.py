"""Numbers and speed of a GPU: warps compared with XLA and the CPU.

Every section measures both programs one after another on the same device, and prints
them. Speeds exclude compiling, whose time is listed separately.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.environments.run import ARMS, stepping
from benchmarks.lanes.run import crossing
from benchmarks.rod_steps.arms import advance_arms, arms
from benchmarks.rod_steps.pyelastica import TIME_STEP
from benchmarks.shared.arguments import add_names
from jaxrod.envs import make
from jaxrod.lanes.choice import lane_choices, use_lanes

SECTIONS = ("equal", "rods", "gradients", "growth", "tasks")
RODS = (1, 64, 1024, 4096, 16384, 65536, 262144, 1048576)
ENVIRONMENTS = (1024, 4096, 16384, 65536)
SCENES = (
    *("1x100", "1x300", "1x1000", "1x3000", "256x100", "256x1000"),
    *("1xropes", "256xropes"),
)
"""Batches of the section `growth`, and numbers of elements, or two ropes that cross."""
STEPS = 200
LEAST_STEPS = 20
"""Least number of control steps of an environment in a timed call."""
WINDOWS = 5
MODES = {"warps": "always", "XLA": "never"}
"""Modes of `jaxrod.use_lanes`, by the name of the program."""

Timed = tuple[float, float]
"""Time of a call and time of the first one [s]."""


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

    def height(speed: Any) -> Any:
        begun = replace(state, velocities=state.velocities + speed)
        return jaxrod.advance(scene, begun, dt, STEPS).positions[2, -1]

    batch = jnp.linspace(-0.5, 0.5, 64, dtype=dtype)
    yield "arm, 64 gradients", jax.vmap(jax.grad(height)), batch
    system, states, fine = crossing("crossing_contact", 25, dtype)
    both = lambda end: [end[name] for name in states]
    yield f"two ropes with lists, {STEPS} steps", run(system, fine, both), states


def equal(dtypes: Sequence[str]) -> None:
    """Largest differences from float64 on the CPU, over the largest number."""
    cpu = jax.devices("cpu")[0]
    print("| program | dtype | warps | XLA | the CPU | warps: the same bits again |")
    print("|---|---|---:|---:|---:|---|")
    for case, exact in zip(comparisons("float32"), comparisons("float64"), strict=True):
        name, program, given = exact
        use_lanes("never")
        there = jax.device_put(given, cpu)
        reference = jax.block_until_ready(jax.jit(program)(there))
        for dtype, (_, program, given) in (("float32", case), ("float64", exact)):
            if dtype not in dtypes:
                continue
            found, again = [], ""
            for mode in MODES.values():
                use_lanes(mode)
                compiled = jax.jit(lambda x, program=program: program(x))
                found.append(jax.block_until_ready(compiled(given)))
                same = _equal_bits(found[-1], compiled(given))
                again = again or ("yes" if same else "no")
            found.append(jax.jit(program)(jax.device_put(given, cpu)))
            errors = [f"{_difference(x, reference):.1e}" for x in found]
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


def beside(name: str, work: float, prepare: Callable[[], Callable[[], Any]]) -> None:
    """Times a program in warps and in XLA, and prints a row.

    Args:
        name: First columns of the row.
        work: Number of units that a call computes; speeds are units per second.
        prepare: Function that returns a call that is not yet compiled.
    """
    speeds, firsts, why = [], [], ""
    for mode in MODES.values():
        use_lanes(mode)
        before = len(lane_choices())
        per, first = median_time(prepare())
        speeds.append(work / per)
        firsts.append(f"{first:.1f}")
        if mode == "always":
            made = lane_choices()[min(before, len(lane_choices()) - 1) :]
            why = "" if made and all(c.taken for c in made) else "XLA was taken"
    columns = [f"{speed:,.0f}" for speed in speeds]
    ratio = f"{speeds[0] / speeds[1]:.1f} {why}".strip()
    print(f"| {name} | {' | '.join([*columns, ratio, *firsts])} |", flush=True)


def _head(first: str, what: str) -> None:
    titles = [first, f"{what}, warps", "XLA", "ratio", "first call, warps [s]", "XLA"]
    print(f"| {' | '.join(titles)} |")
    print(f"|{'---|' * (first.count('|') + 1)}{'---:|' * 5}")


def rods(dtypes: Sequence[str], batches: Sequence[int]) -> None:
    """Rod-steps per second of arms of 20 elements, each under different couples."""
    _head("rods of 20 elements | dtype", "rod-steps/s")
    for dtype in dtypes:
        for batch in batches:
            with jax.enable_x64(dtype == "float64"):
                scene, couples, states = arms(batch, "consistent")
            dt = jnp.asarray(TIME_STEP, dtype)
            steps = jnp.int32(min(20_000, max(20, 400_000_000 // (batch * 20))))
            if batch < 64:
                steps = jnp.int32(5_000)
            given = scene, couples, states, dt, steps

            def prepare(given: Any = given) -> Callable[[], Any]:
                run = jax.jit(lambda *arguments: advance_arms(*arguments))

                def call() -> None:
                    ended = jax.block_until_ready(run(*given)).positions
                    spread = jnp.ptp(ended, axis=0).max()
                    if not (jnp.all(jnp.isfinite(ended)) and spread < 1e-5):
                        raise FloatingPointError("equal arms did not move alike")

                return call

            beside(f"{batch:,} | {dtype}", batch * int(steps), prepare)


def gradients(dtypes: Sequence[str], batches: Sequence[int]) -> None:
    """Derivatives of runs of 200 steps with respect to the state, by reverse mode."""
    _head("gradients of 200 steps, 20 elements | dtype", "gradients/s")
    for dtype in dtypes:
        scene, state, dt = arm(dtype)

        def height(
            speed: Any, scene: Any = scene, state: Any = state, dt: float = dt
        ) -> Any:
            begun = replace(state, velocities=state.velocities + speed)
            return jaxrod.advance(scene, begun, dt, STEPS).positions[2, -1]

        for batch in batches:
            speeds = jnp.linspace(-0.5, 0.5, batch, dtype=dtype)

            def prepare(height: Any = height, speeds: Any = speeds) -> Any:
                run = jax.jit(jax.vmap(jax.grad(lambda speed: height(speed))))
                return lambda: jax.block_until_ready(run(speeds))

            beside(f"{batch:,} | {dtype}", batch, prepare)


def growth(dtypes: Sequence[str], scenes: Sequence[str]) -> None:
    """Element-steps per second of long rods, and of ropes of 25 elements with lists."""
    _head("scene | dtype", "element-steps/s")
    for dtype in dtypes:
        for name in scenes:
            count, _, kind = name.partition("x")
            batch = int(count)
            scene, state, dt, n = _scene(kind, dtype)

            def prepare(
                scene: Any = scene, state: Any = state, dt: Any = dt, batch: int = batch
            ) -> Callable[[], Any]:
                run = lambda state: jaxrod.advance(scene, state, dt, STEPS)
                if batch > 1:
                    run = jax.vmap(run)
                    state = jax.tree.map(
                        lambda leaf: jnp.broadcast_to(leaf, (batch, *jnp.shape(leaf))),
                        state,
                    )
                compiled = jax.jit(run)
                return lambda: jax.block_until_ready(compiled(state))

            beside(f"{name} | {dtype}", batch * n * STEPS, prepare)


def _scene(kind: str, dtype: str) -> tuple[Any, Any, Any, int]:
    """Returns a scene, its state, time step and number of elements."""
    if kind == "ropes":
        return *crossing("crossing_contact", 25, dtype), 50
    n = int(kind)
    shape = {"length": 1.0, "radius": 0.01, "density": 1000.0, "youngs_modulus": 1e6}
    rod, state = jaxrod.straight_rod(n, **shape, dtype=dtype)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
    return scene, state, jaxrod.stable_dt(scene).dt, n


def tasks(names: Sequence[str], batches: Sequence[int]) -> None:
    """Control steps per second of tasks, with restarts and scores."""
    _head("task | environments", "control steps/s")
    for name in names:
        env = make(name, variant="clean")
        for batch in batches:
            made = [0]

            def prepare(
                env: Any = env, batch: int = batch, made: list[int] = made
            ) -> Callable[[], Any]:
                devices = jax.devices()[:1]
                made[0], call = stepping(env, batch, devices, LEAST_STEPS)
                return call

            steps = max(
                LEAST_STEPS * batch, round(7.0 / env.control_period / batch) * batch
            )
            beside(f"{name} | {batch:,}", steps, prepare)
            if made[0] != steps:
                raise AssertionError(f"{made[0]} control steps, not {steps}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares what to measure."""
    add_names(parser, "sections", SECTIONS, "SECTION")
    parser.add_argument("--batches", type=int, nargs="+", metavar="N")
    parser.add_argument("--dtypes", nargs="+", default=["float32", "float64"])
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--tasks", nargs="+", default=list(ARMS), choices=ARMS)


def run(args: argparse.Namespace) -> int:
    """Measures and prints."""
    jax.config.update("jax_enable_x64", True)
    print(f"{jax.devices()[0].device_kind}, JAX {jax.__version__}", flush=True)
    chosen, dtypes = args.sections, tuple(args.dtypes)
    if "equal" in chosen:
        equal(dtypes)
    if "rods" in chosen:
        rods(dtypes, tuple(args.batches or RODS))
    if "gradients" in chosen:
        gradients(dtypes, tuple(args.batches or (64, 1024)))
    if "growth" in chosen:
        growth(dtypes, tuple(args.scenes))
    if "tasks" in chosen:
        jax.config.update("jax_enable_x64", False)
        tasks(tuple(args.tasks), tuple(args.batches or ENVIRONMENTS))
    return 0
