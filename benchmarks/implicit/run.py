"""Implicit steps, and when they are worthwhile: docs/implicit.md.

Each scene is a rod that is clamped at one end and bends under a lateral acceleration,
in float64 on one core. The error is the largest distance of the tip from a reference,
divided by the distance that the tip travels. The reference is extrapolated from
implicit runs with two step sizes.
Writes a record into records, and the page from it. `--pages` measures
nothing and writes the page from the record.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.shared.arguments import add_pages_only
from benchmarks.shared.files import ROOT, write_record
from jaxrod.files import read_json, write_atomically
from jaxrod.installation.machine import processor_and_versions
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene

SAMPLES = 20
BATCH = 64
RECORDS = ROOT / "benchmarks" / "implicit" / "records"
RADIUS = 0.8
"""Spectral radius of the implicit steps."""
HEADER = """\
# When implicit steps are worthwhile

Written by `python -m benchmarks implicit`; do not edit.

Measured on: {machine}, one core, float64.

A step of `jaxrod.implicit({radius})` costs as much as {least:.0f} to {most:.0f}
explicit steps (first table). On slender rods, scaled inertia makes explicit steps five
to 25 times as long. Implicit steps are therefore worthwhile only if they can be about a
thousand times as long as the stable explicit step.
"""
STEPS_HEADER = """\
## A step

The table gives processor times for the steel wire below, in jaxrod's kernels and in
XLA. The implicit step is 4,000 times as long as the stable explicit
step. "One of 64" is a step of one rod in a batch of 64. "Gradient" is the time of a
step within the gradient of a run of 100 steps. "First call" is the time from the call
to the first result, including tracing and compiling.

| elements | step | kernels [us] | XLA [us] | first call, kernels [s] \
| first call, XLA [s] |
|---:|---|---:|---:|---:|---:|
"""
STUDIES_HEADER = """\
## Whole motions

Each rod is 1 m long and clamped at its base. It starts straight and at rest, and a
lateral acceleration bends it, without damping. The error is the largest distance of the
tip from a reference, relative to the distance that the tip travels. The reference is
extrapolated from implicit runs with shorter steps. The cost is wall-clock time per
second of motion. "Scaled" means that `scale_inertia` has enlarged the transverse
inertia.
"""


@dataclass(frozen=True)
class Study:
    """A rod, its load, and the steps to try.

    Attributes:
        name: Description of the rod.
        n_elements: Number of elements.
        radius: [m].
        youngs_modulus: [Pa].
        density: [kg/m^3].
        acceleration: Lateral acceleration of gravity [m/s^2].
        duration: Simulated time [s].
        steps: Implicit step sizes to try, falling [s].
    """

    name: str
    n_elements: int
    radius: float
    youngs_modulus: float
    density: float
    acceleration: float
    duration: float
    steps: tuple[float, ...]


STUDIES = (
    Study(
        "Steel wire, 2 mm thick, 20 elements",
        20,
        1e-3,
        2e11,
        7850.0,
        9.81,
        1.0,
        (1e-2, 5e-3, 2.5e-3),
    ),
    Study(
        "Rope, 4 mm thick, 10 MPa, 50 elements, under an acceleration of g/1000",
        50,
        2e-3,
        1e7,
        1000.0,
        9.81e-3,
        2.0,
        (1e-1, 5e-2, 2e-2),
    ),
    Study(
        "The same rope under an acceleration of g",
        50,
        2e-3,
        1e7,
        1000.0,
        9.81,
        0.5,
        (2.5e-2, 1.25e-2, 5e-3),
    ),
    Study(
        "Arm, 10 cm thick, 1 GPa, 20 elements",
        20,
        0.05,
        1e9,
        1000.0,
        9.81,
        0.2,
        (5e-3, 2e-3, 1e-3),
    ),
)


def tips(scene: Scene, state: RodState, dt: float, duration: float) -> np.ndarray:
    """The tip at equal intervals of time `(samples, 3)` [m]."""
    per_sample = max(1, round(duration / SAMPLES / dt))
    exact = duration / SAMPLES / per_sample
    found = []
    for _ in range(SAMPLES):
        state = jaxrod.advance(scene, state, exact, per_sample)
        found.append(state.tip)
    return np.asarray(found)


def cost(scene: Scene, state: RodState, dt: float, duration: float) -> float:
    """Wall-clock time per simulated second, the best of three."""
    steps = max(1, round(duration / dt))

    def timed() -> float:
        start = time.perf_counter()
        jax.block_until_ready(jaxrod.advance(scene, state, duration / steps, steps))
        return time.perf_counter() - start

    timed()
    return min(timed() for _ in range(3)) / duration


def timed_step(
    scene: Scene, state: RodState, dt: float, what: str, mode: str
) -> tuple[float, float]:
    """Processor time of a step [us], and of the first call [s]."""
    jaxrod.use_lanes(mode)
    steps, windows = (100_000, 5) if scene.method.explicit else (100, 9)
    factors = 1 + 0.01 * jnp.arange(BATCH if what == "one of 64" else 1)

    gravity = scene.effects[-1]

    def scaled(factor: jax.Array) -> Any:
        return jaxrod.gravity(factor * gravity.acceleration)

    def tip(factor: jax.Array) -> jax.Array:
        pulled = replace(scene, effects=(*scene.effects[:-1], scaled(factor)))
        return jaxrod.advance(pulled, state, dt, steps).tip[0]

    program = jax.grad(tip) if what == "gradient" else tip
    program = jax.jit(jax.vmap(program) if len(factors) > 1 else program)
    given = factors if len(factors) > 1 else factors[0]
    times = []
    for _ in range(windows + 1):
        begun = time.process_time()
        jax.block_until_ready(program(given))
        times.append(time.process_time() - begun)
    jaxrod.use_lanes("auto")
    return min(times[1:]) / steps / len(factors) * 1e6, times[0]


def steps_table() -> list[dict[str, Any]]:
    """The rows of the table of a step."""
    rows = []
    for n in (20, 100):
        rod, state = jaxrod.straight_rod(
            n, length=1.0, radius=1e-3, density=7850.0, youngs_modulus=2e11
        )
        gravity = jaxrod.gravity((9.81, 0.0, 0.0))
        explicit = jaxrod.make_scene(rod, jaxrod.clamp(state), gravity)
        implicit = replace(explicit, method=jaxrod.implicit(RADIUS))
        stable = float(jaxrod.stable_dt(explicit).dt)
        cases = [("explicit", explicit, stable, "run")]
        cases += [("implicit", implicit, 4000 * stable, "run")]
        cases += [("implicit, one of 64", implicit, 4000 * stable, "one of 64")]
        if n == 20:
            cases += [("implicit, gradient", implicit, 4000 * stable, "gradient")]
        for name, scene, dt, what in cases:
            (ours, first), (theirs, their_first) = (
                timed_step(scene, state, dt, what, mode) for mode in ("auto", "never")
            )
            row = {"elements": n, "step": name, "kernels_us": ours, "xla_us": theirs}
            row |= {"first_call_kernels_s": first, "first_call_xla_s": their_first}
            rows.append(row)
            print(step_line(row), flush=True)
    return rows


def rows(study: Study) -> list[dict[str, Any]]:
    """The rows of the table of one study."""
    rod, state = jaxrod.straight_rod(
        study.n_elements,
        length=1.0,
        radius=study.radius,
        density=study.density,
        youngs_modulus=study.youngs_modulus,
    )
    gravity = jaxrod.gravity((study.acceleration, 0.0, 0.0))
    explicit = jaxrod.make_scene(rod, jaxrod.clamp(state), gravity)
    implicit = replace(explicit, method=jaxrod.implicit(RADIUS))
    scaling = jaxrod.scale_inertia(explicit)
    fine, finer = (
        tips(implicit, state, study.steps[-1] / k, study.duration) for k in (4, 8)
    )
    exact = finer + (finer - fine) / 3
    travel = float(np.max(np.abs(exact - np.asarray(state.tip))))
    tries = [("implicit", implicit, dt) for dt in study.steps]
    tries += [("explicit, scaled", scaling.scene, 0.95 * float(scaling.dt))]
    tries += [("explicit", explicit, 0.95 * float(scaling.dt_before))]
    rows = []
    for name, scene, dt in tries:
        error = np.max(
            np.linalg.norm(tips(scene, state, dt, study.duration) - exact, axis=1)
        )
        wall = cost(scene, state, dt, study.duration)
        row = {"steps": name, "dt_s": dt, "error": float(error / travel)}
        rows.append(row | {"cost_s_per_s": wall})
        print(study.name, study_line(rows[-1]), flush=True)
    return rows


def step_line(row: dict[str, Any]) -> str:
    """A row of the table of a step."""
    return (
        f"| {row['elements']} | {row['step']} | {row['kernels_us']:.3g} "
        f"| {row['xla_us']:.3g} | {row['first_call_kernels_s']:.1f} "
        f"| {row['first_call_xla_s']:.1f} |"
    )


def study_line(row: dict[str, Any]) -> str:
    """A row of the table of a study."""
    return (
        f"| {row['steps']} | {row['dt_s']:.2e} | {row['error']:.2%} "
        f"| {row['cost_s_per_s']:.2g} |"
    )


def page(record: dict[str, Any]) -> str:
    """The page of a record."""
    cost = {(row["elements"], row["step"]): row["kernels_us"] for row in record["step"]}
    sizes = {n for n, _ in cost}
    ratios = [cost[n, "implicit"] / cost[n, "explicit"] for n in sizes]
    header = HEADER.format(
        machine=record["machine"], radius=RADIUS, least=min(ratios), most=max(ratios)
    )
    table = "\n".join(map(step_line, record["step"]))
    lines = [header, STEPS_HEADER + table + "\n"]
    lines += [STUDIES_HEADER]
    for name, found in record["studies"].items():
        lines += [f"### {name}\n", "| steps | dt [s] | error | cost [s/s] |"]
        lines += ["|---|---:|---:|---:|", *map(study_line, found), ""]
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares whether to measure."""
    add_pages_only(parser)


def run(args: argparse.Namespace) -> int:
    """Measures, and writes the record and the page."""
    if not args.pages:
        jaxrod.configure_cpu(1)
        jax.config.update("jax_enable_x64", True)
        record = {"machine": processor_and_versions(), "step": steps_table()}
        with warnings.catch_warnings():
            warnings.simplefilter("error", jaxrod.UnstableStepWarning)
            record["studies"] = {study.name: rows(study) for study in STUDIES}
        write_record(RECORDS, "implicit", record)
    found = read_json(RECORDS / "implicit.json")
    write_atomically(ROOT / "docs" / "implicit.md", page(found).encode())
    return 0
