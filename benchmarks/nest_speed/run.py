"""Steps of settling nests of rods, and the cost of neighbour lists.

Nests are those of examples/nest.py, with 8 elements per rod, in float32. For each size
it prints wall-clock and processor time per step. It also prints the processor time per
element and step, relative to the smallest nest, with contact and without, and the
listed pairs per element. On a busy machine, compare processor times. PyElastica steps
nests of tens of rods, with its contact between every two rods.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import jaxrod
from benchmarks.shared.files import example

SIZES = (125, 1000, 12_500)
"""Rods of each nest: 1e3, 8e3 and 1e5 elements."""
THEIR_SIZES = (10, 20, 40)
"""Rods of each of PyElastica's nests."""


def timed(run: Callable[[], Any], windows: int = 3) -> tuple[float, float]:
    """Least wall-clock and processor time of a run that is compiled [s]."""
    jax.block_until_ready(run())
    found = []
    for _ in range(windows):
        wall, processor = time.perf_counter(), time.process_time()
        jax.block_until_ready(run())
        found.append((time.perf_counter() - wall, time.process_time() - processor))
    return min(w for w, _ in found), min(p for _, p in found)


def measure(nest: Any, n_rods: int, steps: int) -> float:
    """Prints a nest's line; returns its processor time per element and step [s]."""
    system, state, dt = nest.nest(n_rods)
    state = jaxrod.advance(system, state, dt, steps)
    elements = n_rods * nest.N_ELEMENTS
    wall, processor = timed(lambda: jaxrod.advance(system, state, dt, steps))
    free = jaxrod.make_system(system.members)
    rods = {"rods": state["rods"]}
    bare = timed(lambda: jaxrod.advance(free, rods, dt, steps))[1]
    (near,) = jaxrod.systems.neighbours(system, state)
    flagged = bool(jaxrod.health(system, state, dt).flagged)
    print(
        f"{n_rods:6d} rods {elements:7d} elements: {steps / wall:8.1f} steps/s, "
        f"processor {processor / steps * 1e3:8.3f} ms a step "
        f"({bare / steps * 1e3:.3f} without contact), "
        f"{processor / steps / elements * 1e9:6.0f} ns an element, "
        f"{near.pairs[0] / elements:.2f} pairs an element listed, "
        f"lists at most {near.occupancy:.0%} full, "
        f"flagged {flagged}",
        flush=True,
    )
    return processor / steps / elements


def measure_pyelastica(nest: Any, n_rods: int, steps: int) -> None:
    """Prints PyElastica's line for the same rods."""
    import elastica

    class Simulator(elastica.BaseSystemCollection, elastica.Forcing, elastica.Contact):
        """Rods with gravity and contact."""

    collection = Simulator()
    rods = []
    for number in range(n_rods):
        _, state = nest.rod_in_layer(jax.numpy.asarray(number))
        nodes = np.asarray(state.positions, np.float64)
        way = (nodes[:, -1] - nodes[:, 0]) / nest.LENGTH
        rod = elastica.CosseratRod.straight_rod(
            nest.N_ELEMENTS,
            nodes[:, 0],
            way / np.linalg.norm(way),
            np.cross(way, (0.0, 0.0, 1.0)) / np.linalg.norm(np.cross(way, (0, 0, 1.0))),
            nest.LENGTH,
            nest.RADIUS,
            1000.0,
            youngs_modulus=1e6,
            shear_modulus=4e5,
        )
        rods.append(rod)
        collection.append(rod)
        collection.add_forcing_to(rod).using(
            elastica.GravityForces, acc_gravity=np.array((0.0, 0.0, -9.81))
        )
    for i, one in enumerate(rods):
        for two in rods[i + 1 :]:
            collection.detect_contact_between(one, two).using(
                elastica.RodRodContact, k=50.0, nu=0.02
            )
    collection.finalize()
    stepper = elastica.PositionVerlet()
    clock, dt = np.float64(0.0), np.float64(1e-5)
    clock = stepper.step(collection, clock, dt)
    begin = time.process_time()
    for _ in range(steps):
        clock = stepper.step(collection, clock, dt)
    spent = (time.process_time() - begin) / steps
    elements = n_rods * nest.N_ELEMENTS
    print(
        f"PyElastica {n_rods:4d} rods {elements:5d} elements: processor "
        f"{spent * 1e3:8.3f} ms a step, {spent / elements * 1e9:8.0f} ns an element",
        flush=True,
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the numbers of steps and rods."""
    parser.add_argument(
        "steps", type=int, nargs="?", default=200, help="of the smallest nest"
    )
    parser.add_argument("most_rods", type=int, nargs="?", default=max(SIZES))


def run(args: argparse.Namespace) -> int:
    """Measures all sizes."""
    jaxrod.configure_cpu()
    nest = example("nest")
    first = None
    for n_rods in SIZES:
        if n_rods > args.most_rods:
            continue
        cost = measure(nest, n_rods, max(60, args.steps * SIZES[0] // n_rods))
        first = cost if first is None else first
        print(f"       {cost / first:.2f} times the smallest's cost per element")
    for n_rods in THEIR_SIZES:
        measure_pyelastica(nest, n_rods, 20)
    return 0
