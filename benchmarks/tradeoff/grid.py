"""The whole trade of a problem: every setting of a grid, PyElastica and MuJoCo."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from benchmarks.tradeoff.mujoco_cable import measure_mujoco
from benchmarks.tradeoff.pyelastica import measure_pyelastica
from jaxrod.tradeoff.measure import (
    Measurement,
    Reduction,
    Reference,
    Setting,
    measure,
    members_for,
)
from jaxrod.tradeoff.workload import Workload

BATCHES = (1, 256, 4096)
ELEMENTS = (5, 8, 10, 14, 20, 28, 40, 80)
PYELASTICA_ELEMENTS = (10, 20, 40, 80, 160)
MUJOCO_ELEMENTS = (5, 10, 20, 40, 80)
PYELASTICA_SAFETIES = (0.5, 0.05)
"""Fractions of the stable step. PyElastica's frequencies rise when the rod is
compressed, so it needs the room; and where damping is strong, its steps are of first
order, and much smaller ones with fewer elements are the cheaper way to a tolerance."""
COLUMNS = (
    "simulator",
    "mode",
    "integrator",
    "n_elements",
    "dt",
    "dtype",
    "reductions",
    "batch",
    "error",
    "wall_s_per_sim_s",
)


@dataclass(frozen=True)
class Row:
    """One line of tradeoff.csv.

    Attributes:
        simulator: "jaxrod", "pyelastica" or "mujoco".
        setting: Settings of the simulation.
        batch: Number of rods at once.
        error: Root mean square over time of the tip's distance from the reference, in
            lengths of the rod.
        wall_s_per_sim_s: Wall-clock time per simulated second and rod, on one core.
    """

    simulator: str
    setting: Setting
    batch: int
    error: float
    wall_s_per_sim_s: float

    def cells(self) -> tuple[object, ...]:
        """The values under `COLUMNS`."""
        s = self.setting
        return (
            self.simulator,
            "cable" if self.simulator == "mujoco" else s.mode,
            s.integrator,
            s.n_elements,
            s.dt,
            s.dtype,
            "+".join(s.reductions),
            self.batch,
            self.error,
            self.wall_s_per_sim_s,
        )


def settings_of(
    problem: Workload, elements: Sequence[int] = ELEMENTS
) -> Iterable[Setting]:
    """The grid: modes, types, reductions and steps, for each number of elements."""
    kinds: list[tuple[Reduction, ...]] = [(), ("inertia",), ("compensated",)]
    if problem.plane is not None:
        kinds += [("planar",), ("planar", "inertia")]
    if members_for(problem, "untwisted"):
        kinds += [("untwisted",)]
    for n in elements:
        for kind in kinds:
            yield Setting(n, reductions=kind)
        yield Setting(n, safety=0.3)
        yield Setting(n, dtype="float64")
        yield Setting(
            n, dtype="float64", mode="pyelastica", safety=PYELASTICA_SAFETIES[0]
        )
        for part in (1, 4):
            yield Setting(
                n, problem.period / part, dtype="float64", integrator="implicit"
            )


def measure_grid(
    problem: Workload,
    exact: Reference,
    *,
    elements: Sequence[int] = ELEMENTS,
    batches: Sequence[int] = BATCHES,
    pyelastica_elements: Sequence[int] = PYELASTICA_ELEMENTS,
    mujoco_elements: Sequence[int] = MUJOCO_ELEMENTS,
    seconds: float = 0.2,
    log: Callable[[str], None] = lambda line: None,
) -> list[Row]:
    """Measures a problem's grid of settings, PyElastica and MuJoCo, in one run.

    Args:
        problem: The problem.
        exact: Its reference.
        elements: Numbers of elements.
        batches: Numbers of rods at once; implicit steps are timed for one.
        pyelastica_elements: Numbers of elements for PyElastica. It is left out, with a
            message, if it is not installed or lacks a feature of the problem.
        mujoco_elements: The same for MuJoCo's cable. It is left out, with a message, if
            it lacks a feature of the problem.
        seconds: Time to measure each setting and batch [s].
        log: Called with a line of text after every measurement.
    """
    rows: list[Row] = []

    def add(simulator: str, one: Measurement) -> None:
        for batch, wall in one.wall_s_per_sim_s.items():
            rows.append(Row(simulator, one.setting, batch, one.error, wall))
        costs = ", ".join(f"{w:.2g}" for w in one.wall_s_per_sim_s.values())
        log(f"{simulator} {one.setting}: error {one.error:.2g}, {costs} s/s")

    seen = set()
    for setting in settings_of(problem, elements):
        sizes = tuple(batches)
        if setting.integrator == "implicit":
            sizes = tuple(batch for batch in batches if batch == 1)
        one = measure(problem, setting, exact, batches=sizes, seconds=seconds)
        if dataclasses.replace(one.setting, safety=1.0) not in seen:
            seen.add(dataclasses.replace(one.setting, safety=1.0))
            add("jaxrod", one)
    for n, safety in itertools.product(pyelastica_elements, PYELASTICA_SAFETIES):
        try:
            one = measure_pyelastica(
                problem, n, exact, batches=tuple(batches), safety=safety
            )
        except ModuleNotFoundError as missing:
            if missing.name != "elastica":
                raise
            log("PyElastica is not installed")
            break
        except ValueError as unfit:
            log(f"PyElastica is left out: {unfit}")
            break
        add("pyelastica", one)
    for n in mujoco_elements:
        try:
            one = measure_mujoco(problem, n, exact, batches=tuple(batches))
        except ModuleNotFoundError as missing:
            if missing.name != "mujoco":
                raise
            log("MuJoCo is not installed")
            break
        except ValueError as unfit:
            log(f"MuJoCo is left out: {unfit}")
            break
        add("mujoco", one)
    return rows


def pareto(rows: Iterable[Row]) -> list[Row]:
    """Rows that no other beats in both error and cost, the cheapest first."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda row: (row.wall_s_per_sim_s, row.error)):
        if not front or row.error < front[-1].error:
            front.append(row)
    return front


def cheapest(rows: Iterable[Row], tolerance: float) -> Row | None:
    """The cheapest row within a tolerance, if there is one."""
    accurate = [row for row in rows if row.error <= tolerance]
    return min(accurate, key=lambda row: row.wall_s_per_sim_s, default=None)


def as_csv(rows: Iterable[Row]) -> str:
    """The rows as tradeoff.csv."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(row.cells() for row in rows)
    return text.getvalue()
