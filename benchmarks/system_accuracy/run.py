"""Cost of accuracy in systems of several rods, on one core.

Both libraries run the scenes of `system_speed` with more and fewer elements, in
float64, with the largest possible steps. For jaxrod this is `stable_dt`. For PyElastica
it is the step of its example, or twice or four times that step if the motion stays the
same. The reference of each library is its own run with many elements (PyElastica's
snake with a quarter of the step), because their laws of friction and of joints differ.
The benchmark also prints the difference of the two references. Errors are relative root
mean squares: of the snake's speed in its fourth and fifth period, and of the motion of
the free end of the two rods over a second.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.shared.arguments import add_names
from benchmarks.system_accuracy import gripper, knot, nest
from benchmarks.system_accuracy.contact_scenes import (
    as_csv_with_contact,
    measure_contact,
)
from benchmarks.system_accuracy.ropes import crossing, heap
from benchmarks.system_speed.run import Scene, joint, on_one_core, processor, snake
from benchmarks.tradeoff.grid import Row, as_csv
from benchmarks.tradeoff.work_precision import Words, work_precision
from jaxrod import tradeoff
from jaxrod.files import write_atomically

FOLDER = Path(__file__).parent / "records"
SHARE = 0.01
"""Error for which the two are compared [1]."""


class Run(NamedTuple):
    """Result of one run."""

    observed: np.ndarray
    """The numbers that are to be right."""
    seconds: float
    """Processor time, nothing compiled in it [s]."""


class Case(NamedTuple):
    """A scene, and the quantity that is compared."""

    build: Any
    duration: float
    """Simulated time [s]."""
    samples: int
    """Moments at which it is looked at, all but the first at equal distances."""
    place: Any
    """The place that is looked at, from a list of rods' nodes and masses."""
    sizes: tuple[int, ...]
    finest: int
    their_dt: float
    """PyElastica's step, of its example [s]."""
    observed: Any
    """Numbers to be right, from places over time."""


CONTACT = {"gripper": gripper.SCENE, "knot": knot.SCENE, "nest": nest.SCENE}


def centre(rods: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Centre of mass of the first rod."""
    nodes, masses = rods[0]
    return np.sum(masses * nodes, axis=-1) / np.sum(masses)


def free_end(rods: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Last node of the last rod."""
    return rods[-1][0][:, -1]


def speed(places: np.ndarray) -> np.ndarray:
    """Lengths per period in the fourth and fifth of five periods."""
    return np.asarray([(places[5, 0] - places[3, 0]) / 2 / 0.35])


def way(places: np.ndarray) -> np.ndarray:
    """Distance from the start."""
    return places[1:] - places[0]


CASES = {
    "snake": Case(snake, 10.0, 6, centre, (10, 15, 20, 25, 35, 50), 200, 1e-4, speed),
    "joint": Case(joint, 1.0, 51, free_end, (4, 5, 6, 8, 10), 40, 1e-5, way),
}


def ours(case: Case, scene: Scene) -> Run:
    """Runs ours."""
    each = case.duration / (case.samples - 1)
    steps = int(np.ceil(each / scene.dt))
    dt, alone = each / steps, not isinstance(scene.state, dict)
    models = [scene.model] if alone else list(scene.model.members.values())

    def looked_at(state: Any) -> np.ndarray:
        states = [state] if alone else list(state.values())
        return case.place(
            [
                (np.asarray(own.positions), np.asarray(model.rod.node_masses))
                for own, model in zip(states, models, strict=True)
            ]
        )

    def moved() -> np.ndarray:
        state, places = scene.state, [looked_at(scene.state)]
        for k in range(case.samples - 1):
            first: Any = jnp.asarray(k * steps)
            state = jaxrod.advance(
                scene.model, state, dt, jnp.asarray(steps), first=first
            )
            places.append(looked_at(state))
        return case.observed(np.asarray(places))

    observed = moved()
    return Run(observed, processor(moved))


def theirs(case: Case, scene: Scene) -> Run:
    """Runs PyElastica's."""
    steps = round(case.duration / (case.samples - 1) / scene.their_dt)
    places = []

    def look() -> None:
        places.append(
            case.place(
                [(rod.position_collection, rod.mass) for rod in scene.their_rods]
            ).copy()
        )

    def move() -> None:
        for _ in range(case.samples - 1):
            for _ in range(steps):
                scene.step()
            look()

    look()
    seconds = processor(move)
    return Run(case.observed(np.asarray(places)), seconds)


def error(found: np.ndarray, exact: np.ndarray) -> float:
    """Root mean square of the difference, relative."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def measure(name: str) -> list[Row]:
    """Prints the table of a scene, and returns its rows."""
    case = CASES[name]
    coarsest = case.sizes[0]
    fine_dt = case.their_dt * min(1, 50 / case.finest)
    finest = case.build(case.finest, fine_dt)
    # Compiled before its processor time is taken.
    short = case._replace(duration=1e3 * case.their_dt, samples=6)
    theirs(short, case.build(coarsest, case.their_dt))
    limits = {"jaxrod": ours(case, finest), "PyElastica": theirs(case, finest)}
    apart = error(limits["jaxrod"].observed, limits["PyElastica"].observed)
    print(f"## {name}: the limits at n = {case.finest} are {apart:.2%} apart\n")
    print("| | n | step [us] | error | processor seconds per second |")
    print("|---|---:|---:|---:|---:|")
    cheapest: dict[str, float] = {}
    rows = []
    for n in case.sizes:
        for label, factors in {"jaxrod": (1,), "PyElastica": (1, 2, 4)}.items():
            for factor in factors:
                scene = case.build(n, factor * case.their_dt)
                found = (ours if label == "jaxrod" else theirs)(case, scene)
                off = error(found.observed, limits[label].observed)
                if not off < 1:
                    break
                cost = found.seconds / case.duration
                dt = scene.dt if label == "jaxrod" else scene.their_dt
                print(
                    f"| {label} | {n} | {1e6 * dt:.1f} | {off:.3%} | {cost:.4g} |",
                    flush=True,
                )
                law = "consistent" if label == "jaxrod" else "pyelastica"
                setting = tradeoff.Setting(n, dt, dtype="float64", mode=law)
                rows.append(Row(label.lower(), setting, 1, off, cost))
                if off <= SHARE:
                    cheapest[label] = min(cost, cheapest.get(label, np.inf))
    if len(cheapest) == 2:
        ratio = cheapest["PyElastica"] / cheapest["jaxrod"]
        print(
            f"\nThe cheapest within {SHARE:.0%}: {cheapest['PyElastica']:.4g} and "
            f"{cheapest['jaxrod']:.4g} s, {ratio:.0f} times.\n",
            flush=True,
        )
    return rows


def save(folder: Path, name: str, rows: list[Row], floor: float = 0.0) -> None:
    """Writes a record of the rows, `NAME.csv`, and their picture, `NAME.png`.

    `floor` is the error of the reference, which is shaded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    touching = name in CONTACT
    text = as_csv_with_contact(rows) if touching else as_csv(rows)
    write_atomically(folder / f"{name}.csv", text.encode())
    most = "largest distance from the reference [lengths of a rod]"
    words = Words(
        error=most if touching else "relative error, RMS over time [1]",
        cost="processor time per simulated second [s]",
        single="",
        line="1 %",
    )
    title = f"{name}, one core" if touching else f"{name}: error against cost, one core"
    picture = folder / f"{name}.png"
    work_precision(rows, picture, title=title, floor=floor, words=words)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the scenes."""
    names = (*CASES, *CONTACT, "crossing", "heap")
    add_names(parser, "scenes", names, "SCENE")
    parser.add_argument(
        "--out", type=Path, default=FOLDER, help="folder of records and pictures"
    )
    parser.add_argument(
        "--n", type=int, nargs="+", default=[50, 51, 100], help="of our crossing ropes"
    )
    parser.add_argument(
        "--graded",
        type=float,
        nargs="+",
        default=[1.0],
        help="longest element over shortest, in the middle, of our crossing ropes",
    )
    parser.add_argument(
        "--their-n", type=int, nargs="*", default=[50, 51], help="of PyElastica's"
    )
    parser.add_argument(
        "--floors",
        type=float,
        nargs="*",
        default=[1.5e7],
        help="stiffnesses of the heap's floor, next to the default one [N/m^2]",
    )
    parser.add_argument(
        "--their-share",
        type=float,
        default=1.0,
        help="of the heap that PyElastica runs; its whole time is estimated from this",
    )


def run(args: argparse.Namespace) -> int:
    """Measures the named scenes, or all."""
    on_one_core()
    for name in args.scenes:
        if name == "crossing":
            crossing(tuple(args.n), tuple(args.their_n), tuple(args.graded))
        elif name == "heap":
            heap(100, args.their_share, tuple(args.floors))
        elif name in CONTACT:
            save(args.out, name, *measure_contact(name, CONTACT[name]))
        else:
            save(args.out, name, measure(name))
    return 0
