"""Accuracy and cost of three rods in jaxrod and MuJoCo 4.

MuJoCo 4's rods are flexes. `--mujoco PYTHON` names the interpreter of an environment
with MuJoCo 4, which must be separate from that of this project's tests
(`python -m venv x; x/bin/pip install "mujoco>=4"`). It runs `flex.py`; jaxrod and
PyElastica run in this process. All are on the same core. Writes records/mujoco_rods.md;
without `--mujoco` it only prints the other rows.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import jaxrod
from benchmarks.mujoco_rods import (
    errors,
    flex_jobs,
    ours,
    problem,
    references,
    scenes,
    theirs,
)
from benchmarks.mujoco_rods.flex_jobs import Setting
from benchmarks.mujoco_rods.problem import Problem, Run
from benchmarks.shared.clocks import pin_to_one_core
from jaxrod.files import write_atomically
from jaxrod.installation.machine import machine_facts

PAGE = Path(__file__).with_name("records") / "mujoco_rods.md"


class Table(NamedTuple):
    """One scene, its measured numbers, and MuJoCo's settings for it."""

    problem: Problem
    columns: tuple[str, ...]
    """Names of the errors."""
    measure: Callable[[Run], list[float]]
    """The errors of a run."""
    settings: tuple[Setting, ...]


def tables() -> list[Table]:
    """The three scenes.

    Steps of springs: one near the largest that is stable, one well below.
    """
    return [
        Table(
            problem.cantilever(),
            ("deflection, elastica", "deflection, with shear"),
            errors.measure_deflection,
            (
                Setting("held", 1e-3),
                Setting("held", 2e-4),
                Setting("held", 1e-3, short_edge=True),
                Setting("held", 2e-4, short_edge=True),
                Setting("springs", 1e-3, short_edge=True),
                Setting("springs", 2e-4, short_edge=True),
            ),
        ),
        Table(
            problem.swinging(),
            ("period",),
            errors.measure_period,
            (
                Setting("held", 5e-4),
                Setting("held", 1e-4),
                Setting("springs", 1 / 6000),
                Setting("springs", 1e-4),
            ),
        ),
        Table(
            problem.hanging(),
            ("shape, catenary", "sag, catenary", "shape, with bending"),
            errors.measure_shape,
            (
                Setting("held", 1e-3),
                Setting("held", 2e-4),
                Setting("springs", 5e-4),
                Setting("springs", 1e-4),
            ),
        ),
    ]


def head(table: Table) -> list[str]:
    """Title and first lines of a table."""
    scene = table.problem.scene
    names = (*table.columns, "step [s]", "first run [s]", "second run [s]")
    return [
        f"## {scene.name.capitalize()}, n = {scene.n}",
        "",
        f"| | settings | {' | '.join(names)} |",
        f"|---|---|{'---:|' * len(names)}",
    ]


def line(table: Table, simulator: str, settings: str, found: Run) -> str:
    """One row."""
    cells = [f"{error:.2e}" for error in table.measure(found)]
    cells += [f"{found.dt:.2g}", f"{found.first:.2g}", f"{found.second:.2g}"]
    return f"| {simulator} | {settings} | {' | '.join(cells)} |"


def lines_here(table: Table) -> Iterator[str]:
    """Rows of what runs in this process."""
    for more, masses in ours.MASSES.items():
        for words, method in ours.METHODS.items():
            found = ours.run(table.problem, method, masses)
            yield line(table, "jaxrod", f"{words}{more}", found)
    if importlib.util.find_spec("elastica"):
        yield line(table, "PyElastica", "in space", theirs.run(table.problem))


def describe_references() -> str:
    """A paragraph on the references."""
    exact = errors.deflections()
    swing, stiff = errors.swing(), errors.swing(stretches=False)
    middle = np.asarray(scenes.HANGING.length / 2)
    sag, sag_stiff = (
        float(errors.catenary(stretches).places(middle)[1])
        for stretches in (True, False)
    )
    rod, cable = scenes.HANGING, errors.catenary()
    bent = references.bent_cable(cable, rod.bending, rod.shearing, rod.places)
    lifted = float(np.min(bent[:, 1])) / sag - 1
    large, small = (
        errors.period(ours.run(problem.swinging(amplitude), ours.METHODS["in a plane"]))
        for amplitude in (scenes.AMPLITUDE, scenes.AMPLITUDE / 2)
    )
    lengthening = (large / small - 1) * 4 / 3
    return f"""\
- **Deflection** of the tip under a force across it: F L^3/3EI gives
  {exact.linear:.6f} m, the elastica {exact.elastica:.6f} m, the elastica that also
  shears and stretches {exact.sheared:.6f} m. MuJoCo's rods do not shear, so their own
  reference is the elastica; that of the others is the one with shear.
- **Period** of the lowest small swing, pinned at the top and free below, by 200 cubic
  Hermite elements: {2 * np.pi / swing.frequency:.6f} s. Without stretch it would be
  shorter by {1 - swing.frequency / stiff.frequency:.1e} of that. The swing is not quite
  small: an amplitude of {scenes.AMPLITUDE:g} m lengthens the period by
  {lengthening:.1e} (jaxrod's, compared with half the amplitude). The errors
  have that floor.
- **Hanging cable**: the elastic catenary in closed form, its pull by bisection; it sags
  by {-sag:.6f} m. Without stretch it would sag by {-sag_stiff:.6f} m, an error of
  {sag_stiff / sag - 1:.1e}. A catenary has no bending stiffness. The last column
  compares with the equilibrium of a rod that bends, stretches and shears, by
  collocation. Bending changes the sag by {lifted:.1e}, and few elements change it the
  other way. So of two sags within that range the one nearer to the catenary's is
  further from that of the rod that bends."""


TEXT = """\
# Rods of MuJoCo 4

Written by `python -m benchmarks mujoco_rods --mujoco PYTHON`; do not edit. Three rods
of 1 m in jaxrod, in MuJoCo 4, which has discrete elastic rods as flexes of one
dimension, and in PyElastica 1.0. {machine}; one core, float64.

Times are of the processor. The first run includes building the scene and compiling
(JAX's programs and those of PyElastica's numba, which keeps some on disk; MuJoCo is
compiled already). The second is the same run once more, in the same process. The first
rows of jaxrod and PyElastica include what each does once in a process.

A single run in a new process costs jaxrod more than MuJoCo in its cheapest setting,
because jaxrod compiles first. Each run after it costs less.

{tables}

Deflections and periods are relative errors, shapes the largest distance of a node from
its place over the length of 1 m.

## What they are compared with

{references}

`pytest tests/benchmarks/test_mujoco_rods.py` checks these references.

## How each is run

- **jaxrod** takes the step of `stable_dt`. In a plane (`planar`) it gives the same
  result as in space, at a lower cost. Higher-order masses are the option
  `mass_matrix="higher_order"` of the rod; other rods have lumped masses at their nodes.
- **MuJoCo, edges held**: what its documentation advises. A constraint keeps the lengths
  of edges, with a time constant of two steps, the shortest it allows, and the
  integrator is `discrete`. A rod like this has no stretch. For the swinging cable the
  edges are therefore made as long as they are when it hangs. How the hanging cable
  will stretch is not known beforehand, so its edges have their length at rest. The
  constraint gives way in proportion to the square of the step. At 1 ms that happens to
  be about what the real cable stretches, which is why the shorter step is further from
  the catenary.
- **MuJoCo, edges springs**: each edge is a spring of the stiffness EA, which `discrete`
  does not allow. `Euler` is explicit: both steps are below the limit that stretch sets,
  the time in which a wave of it crosses an edge.
- **MuJoCo's masses and clamps**: its `flexcomp` gives every point the same mass. The
  free end should have half of that, and has it here. Its documented clamp holds the
  first two points, so that the first element cannot bend. With one more edge, {short:g}
  of an element long and within the wall, all of the rod can.
- **PyElastica** takes 0.9 of the largest stable step. Its clamp holds the first
  element.
- Damping is the same everywhere: velocities decay at one rate until the rod is at rest
  (the program checks that nothing moves faster than {rest:g} m/s). In MuJoCo it is the
  damping of each joint, in PyElastica its analytical damper.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the interpreter with MuJoCo."""
    parser.add_argument("--mujoco", metavar="PYTHON", help="Python that has MuJoCo 4")


def run(args: argparse.Namespace) -> int:
    """Measures, prints and writes the page."""
    pin_to_one_core()
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    facts = machine_facts(load)
    facts["versions"].pop("mujoco", None)  # of this environment, not what is measured
    every = tables()
    theirs_of: list[list[tuple[Setting, Run]]] = [[] for _ in every]
    if args.mujoco:
        wanted = [
            (k, setting) for k, table in enumerate(every) for setting in table.settings
        ]
        try:
            version, runs = flex_jobs.run_all(
                str(Path(args.mujoco).absolute()),
                [(every[k].problem, setting) for k, setting in wanted],
            )
        except ValueError as error:
            raise SystemExit(f"python -m benchmarks mujoco_rods: {error}") from None
        facts["versions"]["mujoco"] = version
        for (k, setting), found in zip(wanted, runs, strict=True):
            theirs_of[k].append((setting, found))
    pieces = []
    for table, found_there in zip(every, theirs_of, strict=True):
        lines = head(table)
        lines += lines_here(table)
        for setting, found in found_there:
            lines.append(line(table, "MuJoCo", setting.words, found))
        pieces.append("\n".join(lines))
        print(pieces[-1], end="\n\n", flush=True)
    compared = describe_references()
    print(compared)
    if not args.mujoco:
        print("nothing is written without --mujoco")
        return 0
    versions = ", ".join(f"{name} {v}" for name, v in facts["versions"].items())
    page = TEXT.format(
        machine=f"Measured on: {facts['processor']}; {versions}",
        tables="\n\n".join(pieces),
        references=compared,
        short=flex_jobs.SHORT_EDGE,
        rest=errors.AT_REST,
    )
    write_atomically(PAGE, page.encode())
    return 0
