"""Cost of a step, and what each effect adds to it: docs/costs.md.

Compiles one step of the arm (20 elements, float32), bare and with each effect alone,
for every method. Times the step on one core, for one rod and for a batch of 256.
Writes a record into records, and the page from it. `--pages` measures
nothing and writes the page from the record.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp

import jaxrod
from benchmarks.shared.arguments import add_pages_only
from benchmarks.shared.files import ROOT, write_record
from jaxrod.files import read_json, write_atomically
from jaxrod.installation.machine import processor_and_versions
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene

N_ELEMENTS = 20
BATCH = 256
RECORDS = ROOT / "benchmarks" / "costs" / "records"
TIME_STEP = 2e-4
HEADER = """\
# What a step costs

Written by `python -m benchmarks costs`; do not edit.

The last table of this page is for one time step of an arm with 20 elements in float32.

| column | meaning |
|---|---|
| operations | arithmetic operations of a step within a run, before compiling |
| flops, bytes | the counts of XLA for its compiled program (`cost_analysis`) |
| one rod | the time of a step of a single rod |
| one of 256 | the time of a step of each rod in a batch of 256 |

XLA may compute a value several times if it has many uses. Times are medians of seven
windows on one core, with the settings of `jaxrod.configure_cpu`.

{machine}.

An effect that a scene does not contain is not part of its program, so it costs nothing
(`tests/physics/test_compilation.py`).
"""


def scenes() -> dict[str, tuple[Scene, RodState]]:
    """The scenes of the table: the bare rod first, of every kind."""
    rod, state = jaxrod.straight_rod(
        N_ELEMENTS,
        length=1.0,
        radius=0.05,
        density=1000.0,
        youngs_modulus=1e7,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )
    couples = jaxrod.actuation.ElementCouples(jnp.zeros((3, N_ELEMENTS)).at[0].set(1.0))
    effects = {
        "gravity": jaxrod.gravity((0.0, -9.81, 0.0)),
        "clamp": jaxrod.clamp(state),
        "fixed end": jaxrod.fixed_end(state),
        "damping": jaxrod.exponential_damping(3.8),
        "end load": jaxrod.end_load((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        "uniform load": jaxrod.uniform_load((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        "couples on elements": couples,
    }
    table = {"consistent, bare": (jaxrod.make_scene(rod), state)}
    for name, effect in effects.items():
        table[f"consistent, {name}"] = (jaxrod.make_scene(rod, effect), state)
    arm = (effects["clamp"], effects["damping"], couples)
    table["consistent, clamped, damped, actuated"] = jaxrod.make_scene(rod, *arm), state
    held = (effects["fixed end"], effects["damping"], couples)
    published = jaxrod.make_scene(rod, method=jaxrod.pyelastica())
    table["pyelastica, bare"] = published, state
    table["pyelastica, clamped, damped, actuated"] = (
        jaxrod.make_scene(rod, *held, method=jaxrod.pyelastica()),
        state,
    )
    table["planar, bare"] = jaxrod.make_scene(rod, method=jaxrod.planar("xy")), state
    table["planar, clamped, damped, actuated"] = (
        jaxrod.make_scene(rod, *arm, method=jaxrod.planar("xy")),
        state,
    )
    table["without twist, bare"] = (
        jaxrod.make_scene(rod, method=jaxrod.torsion_free()),
        state,
    )
    moving = (effects["clamp"], effects["damping"], effects["gravity"])
    methods = {"consistent": None, "without twist": jaxrod.torsion_free()}
    for name, method in methods.items():
        table[f"{name}, clamped, damped, with gravity"] = (
            jaxrod.make_scene(rod, *moving, method=method),
            state,
        )
    table["compensated, bare"] = (
        jaxrod.make_scene(rod),
        jaxrod.compensated(state),
    )
    return table


def cost_of_a_step(scene: Scene, state: RodState) -> tuple[float, float, float]:
    """Operations of one step among many as written; flops and bytes as compiled."""
    integrator = scene.method.stepper(scene, state, jnp.asarray(TIME_STEP))
    lowered = jax.jit(integrator.cycle).lower(integrator.begin(state))
    compiled = lowered.compile().cost_analysis()
    written = lowered.cost_analysis()["flops"]
    return written, compiled["flops"], compiled["bytes accessed"]


def time_of_a_step(scene: Scene, state: RodState, batch: int) -> float:
    """Median time of a step of one rod among `batch` [s]; compiling not counted."""
    run = jaxrod.advance
    if batch > 1:
        state = jax.tree.map(lambda a: jnp.broadcast_to(a, (batch, *a.shape)), state)
        run = jax.jit(jax.vmap(run, in_axes=(None, 0, None, None)))
    dt = jnp.asarray(TIME_STEP)

    def timed(steps: int) -> float:
        start = time.perf_counter()
        jax.block_until_ready(run(scene, state, dt, jnp.asarray(steps)))
        return time.perf_counter() - start

    timed(1)
    steps = max(10, int(1000 * 0.15 / timed(1000)))
    return statistics.median(timed(steps) for _ in range(7)) / steps / batch


def measured(name: str, scene: Scene, state: RodState) -> dict[str, Any]:
    """The row of a scene."""
    written, flops, traffic = cost_of_a_step(scene, state)
    alone, among = (1e6 * time_of_a_step(scene, state, b) for b in (1, BATCH))
    return {
        "scene": name,
        "operations": written,
        "flops": flops,
        "bytes": traffic,
        "one_rod_us": alone,
        "of_a_batch_us": among,
    }


def line(row: dict[str, Any]) -> str:
    """A row in the table of the page."""
    return (
        f"| {row['scene']} | {row['operations']:,.0f} | {row['flops']:,.0f} "
        f"| {row['bytes']:,.0f} | {row['one_rod_us']:.3f} "
        f"| {row['of_a_batch_us']:.3f} |"
    )


def page(record: dict[str, Any]) -> str:
    """The page of a record."""
    lines = [
        HEADER.format(machine=f"Measured on: {record['machine']}"),
        "| scene | operations | flops | bytes | one rod [us] | one of 256 [us] |",
        "|---|---:|---:|---:|---:|---:|",
        *map(line, record["rows"]),
    ]
    return "\n".join(lines) + "\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares whether to measure."""
    add_pages_only(parser)


def run(args: argparse.Namespace) -> int:
    """Measures, and writes the record and the page."""
    if not args.pages:
        jaxrod.configure_cpu(1)
        rows = []
        for name, (scene, state) in scenes().items():
            rows.append(measured(name, scene, state))
            print(line(rows[-1]), flush=True)
        record = {"machine": processor_and_versions(), "rows": rows}
        write_record(RECORDS, "costs", record)
    found = read_json(RECORDS / "costs.json")
    write_atomically(ROOT / "docs" / "costs.md", page(found).encode())
    return 0
