"""Batches, learners and a nest over several devices: docs/scaling.md.

JAX emulates the devices: it divides the processor into eight. At most as many devices
work at the same time as there are cores. Prints each row after its measurement.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec

import jaxrod
from benchmarks.environments.run import stepping
from benchmarks.scaling.exchanges import exchanges
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import ROOT, example
from benchmarks.shared.page_tables import measured_table
from jaxrod.envs import make
from jaxrod.installation.machine import available_cores
from jaxrod.training import find_algorithm
from jaxrod.training.runs.hosts import (
    device_mesh,
    partition_of,
    place,
    trace_updates,
)

PAGE = ROOT / "docs" / "scaling.md"
DEVICES = (1, 2, 4, 8)
ENVS_PER_DEVICE, ENVS = 256, 2048
LEARNER_ENVS = 32
"""Environments of each device in training."""
WINDOWS, ROUNDS = 21, 3
RODS = (1_000, 12_504)
"""Rods of each nest: 8e3 and 1e5 elements."""
NEST_STEPS = 12
"""In which lists of neighbours are made once."""
LEARNERS = ("ppo", "sac")
GPUS = (8, 64, 256, 1024)
HOP, BANDWIDTH = 5e-6, 50e9
"""Latency and rate of a network [s], [bytes/s]: supposed, not measured."""


def updates(
    env: Any, name: str, config: Any, devices: Sequence[jax.Device]
) -> tuple[Any, jax.stages.Lowered]:
    """A learner's first state over devices, and the program of its updates."""
    learner, mesh = find_algorithm(name), device_mesh(devices)
    start = jax.jit(learner.init, static_argnums=(1, 4))
    params = env.default_params()
    state = start(jax.random.key(0), env, config, params, 1_000_000_000)
    state = place(state, partition_of(learner, state), mesh)
    return state, trace_updates(learner, state, 1, mesh).lower()


def nest(rods: int, devices: Sequence[jax.Device]) -> tuple[Callable[[], Any], str]:
    """Function that advances a nest with rods spread over devices, and its program."""
    system, state, dt = example("nest").nest(rods)
    mesh = device_mesh(devices)

    def spread(leaf: Any) -> Any:
        leaf = jnp.asarray(leaf)
        along = mesh.axis_names if leaf.ndim and leaf.shape[0] == rods else ()
        return jax.device_put(leaf, NamedSharding(mesh, PartitionSpec(*along)))

    system, state = jax.tree.map(spread, (system, state))
    advance = jax.jit(lambda scene, at: jaxrod.advance(scene, at, dt, NEST_STEPS))
    program = advance.lower(system, state).compile()
    return (
        lambda: jax.block_until_ready(program(system, state)),
        program.as_text() or "",
    )


def medians(calls: Sequence[Callable[[], Any]]) -> list[tuple[float, float]]:
    """Medians of the calls' times [s], and of the first one's beside each.

    They take turns, so that what else the machine does slows all alike.
    """
    found: list[list[float]] = [[] for _ in calls]
    for call in calls:
        call()
    for _ in range(WINDOWS):
        for times, call in zip(found, calls, strict=True):
            start = time.perf_counter()
            call()
            times.append(time.perf_counter() - start)
    return [
        (
            statistics.median(times),
            statistics.median(a / b for a, b in zip(found[0], times, strict=True)),
        )
        for times in found
    ]


def batches() -> Iterator[str]:
    """Rows of stepping: equal work per device, and equal work in total.

    Each number of devices is a program of its own, with as many threads.
    """
    shares = {
        "the same for each": [ENVS_PER_DEVICE] * len(DEVICES),
        "the same in all": [ENVS // count for count in DEVICES],
    }
    for what, sizes in shares.items():
        runs = [
            [_speed(*pair) for pair in zip(DEVICES, sizes, strict=True)]
            for _ in range(ROUNDS)
        ]
        for i, (count, size) in enumerate(zip(DEVICES, sizes, strict=True)):
            speed = statistics.median(run[i] for run in runs)
            faster = statistics.median(run[i] / run[0] for run in runs)
            yield _row(what, count, count * size, speed, faster)


def _speed(devices: int, envs_per_device: int) -> float:
    """Steps per second of a new process with a number of devices."""
    program = (
        "from benchmarks.scaling.run import print_speed\n"
        f"print_speed({devices}, {envs_per_device})"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        cwd=ROOT,
        # A device alone would be handed from core to core.
        env=os.environ | {"NPROC": "1"},
    )
    return float(done.stdout)


def print_speed(devices: int, envs_per_device: int) -> None:
    """Prints the steps per second of this process with its number of devices."""
    jaxrod.configure_cpu(devices)
    env = make("tracking", variant="clean")
    steps, call = stepping(env, envs_per_device, jax.devices())
    ((wall, _),) = medians([call])
    print(steps / wall)


def learners() -> Iterator[str]:
    """Rows of training: equal work per device."""
    env = make("tracking", variant="clean")
    for name in LEARNERS:
        found = []
        for count in DEVICES:
            learner = find_algorithm(name)
            config = _config(name, count)
            state, lowered = updates(env, name, config, jax.devices()[:count])
            found.append((learner.steps_per_update(config), _going(state, lowered)))
        first = found[0][0]
        for count, (steps, _), (wall, faster) in zip(
            DEVICES, found, medians([call for _, call in found]), strict=True
        ):
            num_envs = count * LEARNER_ENVS
            yield _row(name, count, num_envs, steps / wall, faster * steps / first)


def _config(name: str, devices: int) -> Any:
    settings: dict[str, Any] = {"num_envs": LEARNER_ENVS * devices}
    if name == "sac":
        # A batch grows with the devices, as the environments do.
        settings |= {"batch_size": 256 * devices, "learning_starts": 0}
    return dataclasses.replace(find_algorithm(name).config_type(), **settings)


def _going(state: Any, lowered: jax.stages.Lowered) -> Callable[[], None]:
    program = lowered.compile()
    held = [state]
    one = place(jnp.int32(1), PartitionSpec(), _mesh_of(state))

    def call() -> None:
        held[0], _ = jax.block_until_ready(program(held[0], one))

    return call


def _mesh_of(state: Any) -> Any:
    return jax.tree.leaves(state)[0].sharding.mesh


def scenes() -> Iterator[str]:
    """Rows of nests: one scene of one size on increasing numbers of devices."""
    for rods in RODS:
        pairs = [nest(rods, jax.devices()[:count]) for count in DEVICES]
        times = medians([call for call, _ in pairs])
        for count, (_, text), (wall, faster) in zip(DEVICES, pairs, times, strict=True):
            found = exchanges(text)
            size = sum(e.bytes for e in found if not e.open_loops)
            lists = sum(e.bytes for e in found if e.open_loops)
            yield (
                f"| {8 * rods:,} | {count} | {NEST_STEPS / wall:,.1f} | {faster:.2f} "
                f"| {size / NEST_STEPS / 1e3:,.0f} | {lists / 1e3:,.0f} |"
            )


def exchanged() -> Iterator[str]:
    """Rows of the exchanges of learners in an update, and of their estimated time."""
    env = make("tracking", variant="clean")
    for name in LEARNERS:
        config = _config(name, 2)
        _, lowered = updates(env, name, config, jax.devices()[:2])
        found = exchanges(lowered.compile().as_text() or "")
        steps = getattr(config, "gradient_steps", 1)
        # Gradient steps off policy are a loop that begins when there is enough.
        times = [e.times * (steps if e.open_loops > 1 else 1) for e in found]
        size = sum(n * e.size for n, e in zip(times, found, strict=True))
        waits = []
        for gpus in GPUS:
            hops = 2 * math.ceil(math.log2(gpus))
            sent = 2 * (gpus - 1) / gpus * size / BANDWIDTH
            waits.append(f"{1e3 * (sum(times) * hops * HOP + sent):.1f}")
        yield f"| {name} | {sum(times)} | {size / 1e3:,.0f} | {' | '.join(waits)} |"


def _row(what: str, devices: int, envs: int, speed: float, faster: float) -> str:
    share = faster / min(devices, available_cores())
    return (
        f"| {what} | {devices} | {envs} | {speed:,.0f} | {faster:.2f} | {share:.0%} |"
    )


HEAD = "| {} | devices | environments | steps/s | faster than one | of the cores |\n"
RULE = "|---|---:|---:|---:|---:|---:|"
TABLES: dict[str, tuple[str, Callable[[], Iterator[str]]]] = {
    "batches": (HEAD.format("environments") + RULE, batches),
    "learners": (HEAD.format("learner") + RULE, learners),
    "scenes": (
        "| elements | devices | steps/s | faster than one | kB a step "
        "| kB a list of neighbours |\n|---:|---:|---:|---:|---:|---:|",
        scenes,
    ),
    "exchanged": (
        "| learner | exchanges | kB | "
        + " | ".join(f"{gpus:,} GPUs [ms]" for gpus in GPUS)
        + " |\n|---|---:|---:|"
        + "---:|" * len(GPUS),
        exchanged,
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tables."""
    add_names(parser, "tables", TABLES, "TABLE")


def run(args: argparse.Namespace) -> int:
    """Measures the tables, all or those named, and writes them into their page."""
    jaxrod.configure_cpu(max(DEVICES))
    for name in args.tables:
        head, rows = TABLES[name]
        measured_table(PAGE, name, head, rows, dry=False)
    return 0
