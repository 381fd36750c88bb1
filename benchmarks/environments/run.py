"""Control steps per second of every task: docs/environments.md.

Measures all tasks, or those that you name; other rows of the record
do not change. Steps a batch of
every task and variant in float32 under random actions, without a policy. Spreads the
batch over all cores, as training does. Times include restarts and scores.
Writes a record into records, and the page from it. `--pages` measures
nothing and writes the page from the record.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float

import jaxrod
from benchmarks.shared.arguments import add_names, add_pages_only
from benchmarks.shared.files import ROOT, write_record
from jaxrod.envs import VectorEnvironment, VectorState, make
from jaxrod.files import read_json, write_atomically
from jaxrod.installation.machine import processor_and_versions
from jaxrod.lanes.choice import slower
from jaxrod.training.algorithm import DEVICE_AXIS
from jaxrod.training.runs.hosts import device_mesh, place

ARMS = ("tracking", "reaching", "structured", "unstructured")
TASKS = (
    *((name, variant) for name in ARMS for variant in ("clean", "paper")),
    *((name, "clean") for name in ("following", "snake", "octopus", "gripper")),
    *((name, "clean") for name in ("lift", "insert", "catheter")),
)
RECORDS = ROOT / "benchmarks" / "environments" / "records"
BATCHES = (16, 64, 256)
"""Environments per core."""
MOTION = 7.0
"""Simulated time of a core's environments together in one timed call, about [s]."""
WINDOWS = 5
WINDOW_SECONDS = 2.0
HEADER = """\
# How fast the tasks are

Written by `python -m benchmarks environments`; do not edit.

| column | meaning |
|---|---|
| control step | simulated time of a control step, by the task's default |
| elements | number of elements of each rod, by the task's default |
| steps | number of time steps in a control step, by the task's default |
| per core | control steps per second, with {batches} environments on each core |
| flagged | fraction of control steps that a health flag marked |

Runs use {cores} cores and float32. Every control step has new random actions. Values
are medians of {windows} windows of {seconds:g} s and exclude compiling. The octopus has
eight arms, and the gripper has three fingers and a ball. {lanes}
The machine is shared: at a busy hour a task may reach only half of its usual speed.

{machine}.

| task | variant | control step [ms] | elements | steps | {columns} | flagged |
|---|---|---:|---:|---:|{rule}---:|
"""


def row(name: str, variant: str) -> dict[str, Any]:
    """Measures one task."""
    env = make(name, variant=variant)
    found = [measured(env, batch) for batch in BATCHES]
    return {
        "task": name,
        "variant": variant,
        "control_step_ms": 1e3 * env.control_period,
        "elements": env.n_elements,
        "steps": env.substeps,
        "control_steps_per_s": [speed for speed, _ in found],
        "flagged": statistics.mean(share for _, share in found),
        "machine": processor_and_versions(),
    }


def line(row: dict[str, Any]) -> str:
    """A row in the table of the page."""
    speeds = " | ".join(f"{speed:,.0f}" for speed in row["control_steps_per_s"])
    sizes = f"{row['control_step_ms']:.3g} | {row['elements']} | {row['steps']}"
    head = f"| {row['task']} | {row['variant']} | {sizes}"
    return f"{head} | {speeds} | {row['flagged']:.1e} |"


def page(record: dict[str, Any]) -> str:
    """The page of a record."""
    machines = sorted({row["machine"] for row in record["rows"]})
    header = HEADER.format(
        lanes=record["lanes"],
        machine=f"Measured on: {'; '.join(machines)}",
        cores=record["cores"],
        batches=f"{', '.join(map(str, BATCHES[:-1]))} or {BATCHES[-1]}",
        columns=" | ".join(f"{batch} per core" for batch in BATCHES),
        rule="---:|" * len(BATCHES),
        windows=WINDOWS,
        seconds=WINDOW_SECONDS,
    )
    text = header + "".join(f"{line(row)}\n" for row in record["rows"])
    remarks = [row["remark"] for row in record["rows"] if "remark" in row]
    return text + "".join(f"\n{remark}\n" for remark in remarks)


def measured(env: Any, envs_per_core: int) -> tuple[float, float]:
    """Control steps per second of a batch, and the share of them that was flagged."""
    steps, call = stepping(env, envs_per_core, jax.devices())
    shares: list[float] = []

    def timed() -> float:
        start = time.perf_counter()
        flagged = call()
        wall = time.perf_counter() - start
        shares.append(flagged)
        return wall

    timed()
    calls = max(1, round(WINDOW_SECONDS / timed()))
    wall = statistics.median(
        sum(timed() for _ in range(calls)) / calls for _ in range(WINDOWS)
    )
    return steps / wall, statistics.mean(shares)


def stepping(
    env: Any, envs_per_device: int, devices: Sequence[jax.Device], least: int = 1
) -> tuple[int, Callable[[], float]]:
    """Function that steps a batch spread over devices, under random actions.

    Args:
        env: The environment.
        envs_per_device: Number of environments on each device.
        devices: The devices.
        least: Least number of control steps that each environment makes in a call.

    Returns:
        Control steps of a call, and the call, which returns the share that was
        flagged. The first one compiles.
    """
    batch = VectorEnvironment(env)
    params = env.default_params()
    mesh = device_mesh(devices)
    spread, whole = PartitionSpec(DEVICE_AXIS), PartitionSpec()
    steps = max(least, round(MOTION / env.control_period / envs_per_device))

    @jax.jit
    @partial(
        jax.shard_map,
        mesh=mesh,
        in_specs=(spread, whole),
        out_specs=(spread, spread),
        # Nothing is exchanged between devices.
        check_vma=False,
    )
    def play(
        state: VectorState, params: Any
    ) -> tuple[VectorState, Float[Array, " devices"]]:
        def step(state: VectorState, _: None) -> tuple[VectorState, Array]:
            draw = jax.vmap(
                lambda key, tick: jax.random.uniform(
                    jax.random.fold_in(key, tick), (env.action_size,), minval=-1.0
                )
            )
            state, outcome = batch.step(state, draw(state.keys, state.ticks), params)
            return state, jnp.mean(outcome.info["flagged"])

        state, flagged = jax.lax.scan(step, state, length=steps)
        return state, jnp.mean(flagged)[None]

    num_envs = envs_per_device * len(devices)
    state = batch.reset(jax.random.key(0), num_envs, params, spread_phases=True)
    state, params = place(state, spread, mesh), place(params, whole, mesh)

    def call() -> float:
        nonlocal state
        state, flagged = jax.block_until_ready(play(state, params))
        return float(jnp.mean(flagged))

    return steps * num_envs, call


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tasks, and whether to measure."""
    known = dict.fromkeys(name for name, _ in TASKS)
    add_names(parser, "tasks", known, "TASK")
    add_pages_only(parser)


def run(args: argparse.Namespace) -> int:
    """Measures, and writes the record and the page."""
    if not args.pages:
        jaxrod.configure_cpu()
        file = RECORDS / "environments.json"
        before = read_json(file)["rows"] if file.exists() else []
        kept = {
            (found["task"], found["variant"]): found
            for found in before
            if found["task"] not in args.tasks
        }
        rows = []
        for task in TASKS:
            rows.append(kept.get(task) or row(*task))
            print(line(rows[-1]), flush=True)
        lanes = slower() or "Batches run in [lanes](performance.md)."
        record = {"cores": jax.device_count(), "lanes": lanes, "rows": rows}
        write_record(RECORDS, "environments", record)
    found = read_json(RECORDS / "environments.json")
    write_atomically(ROOT / "docs" / "environments.md", page(found).encode())
    return 0
