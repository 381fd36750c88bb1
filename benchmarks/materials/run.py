"""Materials with memory: simulated rods compared with closed forms.

A couple at the tip holds or bends a rod, so slowly that inertia hardly matters. The
benchmark compares every curvature with the closed form of the material. Prints the
largest difference for each law; with --out, also draws the three pictures of
docs/material.md. Takes about half a minute of processor time.

Exits with 0 if all differences are at most 1 %, and with 1 if not.

For example:
  python -m benchmarks materials
  python -m benchmarks materials --out docs   draws the pictures, too
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxrod
from jaxrod import materials, schedules
from jaxrod.files import write_atomically
from jaxrod.viz.style import BLUE, GREEN, INK, ORANGE, charts

BAR = 0.01
"""Largest difference from a closed form [1]."""
RATIO, TIME = 1.5, 8.0
STICKING, SLIP = 80.0, 8.0
YIELD, HARDENING = 10.0, 0.1


class Curve(NamedTuple):
    """A quantity of a moving rod, and the same in closed form."""

    name: str
    at: np.ndarray
    """Time or curvature at each measurement."""
    measured: np.ndarray
    exact: np.ndarray

    @property
    def error(self) -> float:
        """Largest difference, relative to the largest exact value [1]."""
        gap = np.nanmax(np.abs(self.measured - self.exact))
        return float(gap / np.nanmax(np.abs(self.exact)))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the folder of the pictures."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for pictures")


def run(args: argparse.Namespace) -> int:
    """Measures, prints, draws."""
    jaxrod.configure_cpu(1)
    with jax.enable_x64(True):
        relaxing, slipping = relaxation(), hysteresis()
        yielding, shapes = plastic_set()
    curves = [*relaxing, *slipping, *yielding]
    for curve in curves:
        print(f"{curve.name:58} {100 * curve.error:.2f} %")
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        for name, made in (
            ("relaxation", picture_of_relaxation(relaxing)),
            ("hysteresis", picture_of_hysteresis(slipping)),
            ("plastic_set", picture_of_set(yielding, shapes)),
        ):
            write_atomically(args.out / f"{name}.png", made)
    return 0 if all(curve.error <= BAR for curve in curves) else 1


def rod_along_x() -> tuple[Any, Any, float]:
    """A thick rod of four elements, its state, and its bending stiffness [N m^2]."""
    rod, state = jaxrod.straight_rod(
        4,
        length=1.0,
        radius=0.1,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )
    return rod, state, float(rod.bend_twist_stiffness[1, 0])


def bent(law: Any, couples: Any, end: float, records: int) -> Any:
    """Times, couples at the tip, curvatures, and states of a rod bent by the couples.

    Args:
        law: Function of the rod and its clamp that returns the material.
        couples: Table of times [s] and couples [N m], or a schedule of couples.
        end: Duration [s].
        records: Number of records.
    """
    rod, state, _ = rod_along_x()
    wall = jaxrod.clamp(state)
    couple = jaxrod.end_load(couple=couples)
    calm = jaxrod.exponential_damping(2.0)
    scene = jaxrod.make_scene(rod, wall, couple, calm, law(rod, wall))
    dt = jaxrod.stable_dt(scene).dt
    every = int(end / float(dt) / records)
    states = jaxrod.rollout(scene, state, dt, every * records, every)
    times = np.asarray(jaxrod.rollout_times(dt, every * records, every))
    curvature = jax.vmap(lambda own: jaxrod.strains(rod, own)[1][1, 1])(states)
    return times, np.asarray(curvature), states


def about_y(times: Any, values: Any) -> Any:
    """Schedule of couples that bend the rod upwards, from times and values [N m]."""
    values = np.asarray(values)
    stacked = np.stack([0 * values, -values, 0 * values], axis=1)
    return schedules.table(np.asarray(times), stacked)


def relaxation() -> list[Curve]:
    """Relaxation of a bend that is held, and creep under a couple that is removed."""
    curves = []

    def law(rod: Any, wall: Any) -> Any:
        return materials.standard_linear_solid(
            rod, stiffness_ratio=RATIO, relaxation_time=TIME, into=wall
        )

    _, _, stiffness = rod_along_x()
    couple, release, end = 20.0, 40.0, 80.0
    steps = about_y([0.0, release, release + 1e-3, end], [couple, couple, 0.0, 0.0])
    times, curvature, _ = bent(law, steps, end, 160)
    creeping = TIME * (1 + RATIO)
    before, after = (
        np.where(
            t >= 0, 1 - RATIO / (1 + RATIO) * np.exp(-np.maximum(t, 0) / creeping), 0
        )
        for t in (times, times - release)
    )
    exact = couple / stiffness * (before - after)
    # Without the vibrations right after the couple has changed.
    calm = np.where(times < release, times, times - release) > 4
    exact = np.where(calm, exact, np.nan)
    curves.append(Curve("creep and recovery", times, curvature, exact))
    curves.append(_held(law))
    return curves


def _held(law: Any) -> Curve:
    """Moment of an arc held at both ends, over that after a long time."""
    rod, _, stiffness = rod_along_x()
    nodes = _arc(0.5, rod.n_elements)
    _, arc = jaxrod.rod_along(
        nodes, normal=(0.0, 0.0, 1.0), radius=0.1, density=1000.0, youngs_modulus=1e6
    )
    ends = jaxrod.fixed_end(arc), jaxrod.fixed_end(arc, "tip")
    scene = jaxrod.make_scene(rod, *ends, law(rod, None))
    dt = jaxrod.stable_dt(scene).dt
    every = int(4 * TIME / float(dt) / 60)
    states = jaxrod.rollout(scene, arc, dt, 60 * every, every)
    times = np.asarray(jaxrod.rollout_times(dt, 60 * every, every))
    couples = jax.vmap(lambda own: jaxrod.reactions(scene, own)[1].couple[1])(states)
    moment = np.abs(np.asarray(couples)) / (0.5 * stiffness)
    return Curve(
        "moment of a bend that is held",
        times,
        moment,
        1 + RATIO * np.exp(-times / TIME),
    )


def _arc(curvature: float, n_elements: int) -> Any:
    """Nodes of an arc of length one, whose elements are its chords as long as at rest.

    The middle of each element turns by the curvature times the length from the start.
    """
    length = 1 / n_elements
    angles = curvature * length * np.arange(n_elements)
    steps = length * np.stack([np.cos(angles), 0 * angles, np.sin(angles)])
    return np.pad(np.cumsum(steps, axis=1), ((0, 0), (1, 0)))


def hysteresis() -> list[Curve]:
    """Loops of the couple over the curvature, of three sizes."""

    def law(rod: Any, wall: Any) -> Any:
        return materials.bending_hysteresis(
            rod, stiffness=STICKING, slip_moment=SLIP, into=wall
        )

    _, _, stiffness = rod_along_x()
    period, curves = 60.0, []
    for largest in (0.05, 0.1, 0.2):
        end = SLIP * np.tanh(STICKING * largest / SLIP)
        times = np.linspace(0, 4 * period, 4 * 200 + 1)
        cycle = (stiffness * largest + end) * np.sin(2 * np.pi * times / period)
        found, curvature, _ = bent(law, about_y(times, cycle), 4 * period, 800)
        last = found > 3 * period - 0.25 * period
        couple = np.interp(found[last], times, cycle)
        path = curvature[last]
        rising = np.cos(2 * np.pi * found[last] / period) > 0
        way = np.where(rising, 1, -1)
        friction = way * SLIP - way * (SLIP + end) * np.exp(
            -STICKING / SLIP * (largest + way * path)
        )
        name = f"couple over a loop of {largest:g}/m"
        curves.append(Curve(name, path, couple, stiffness * path + friction))
    return curves


def plastic_set() -> tuple[list[Curve], list[np.ndarray]]:
    """The curvature under a couple that rises, falls and turns, and three shapes."""

    def law(rod: Any, wall: Any) -> Any:
        return materials.plastic_bending(
            rod, yield_moment=YIELD, hardening=HARDENING, into=wall
        )

    _, _, stiffness = rod_along_x()
    corners, values = [0.0, 160.0, 320.0, 480.0], [0.0, 16.0, 0.0, -10.0]
    times, curvature, states = bent(law, about_y(corners, values), 480.0, 240)
    couple = np.interp(times, corners, values)
    first = YIELD / stiffness
    beyond = np.maximum(couple[times <= 160] - YIELD, 0) / (HARDENING * stiffness)
    rising = np.minimum(couple[times <= 160] / stiffness, first) + beyond
    # It yields backwards after twice the yield moment.
    largest = first + 6.0 / (HARDENING * stiffness)
    falling = couple[times > 160]
    turned = np.maximum(16.0 - 2 * YIELD - falling, 0) / (HARDENING * stiffness)
    elastic = (16.0 - np.maximum(falling, 16.0 - 2 * YIELD)) / stiffness
    exact = np.concatenate([rising, largest - elastic - turned])
    at = [np.argmin(np.abs(times - time)) for time in (0.0, 160.0, 320.0)]
    shapes = [np.asarray(states.positions)[k] for k in at]
    return [Curve("curvature under a couple that yields", couple, curvature, exact)], [
        shape[[0, 2]] for shape in shapes
    ]


def picture_of_relaxation(curves: list[Curve]) -> bytes:
    """Creep on the left, relaxation on the right."""
    creep, held = curves
    figure, (left, right) = _figure()
    for axes, curve, label in (
        (left, creep, "curvature [1/m]"),
        (right, held, "moment, over that of a long time"),
    ):
        axes.plot(curve.at, curve.exact, color=INK, linewidth=1)
        shown = ~np.isnan(curve.exact)
        axes.plot(
            curve.at[shown][::3],
            curve.measured[shown][::3],
            "o",
            color=BLUE,
            fillstyle="none",
        )
        axes.set_xlabel("time [s]")
        axes.set_ylabel(label)
    left.set_title("a couple comes, stays and goes", fontsize=10)
    right.set_title("a bend is held", fontsize=10)
    return _bytes(figure)


def picture_of_hysteresis(curves: list[Curve]) -> bytes:
    """Loops of the couple on the left, of the friction alone on the right."""
    figure, (left, right) = _figure()
    _, _, stiffness = rod_along_x()
    for curve, color in zip(curves, (GREEN, ORANGE, BLUE), strict=True):
        for axes, elastic in ((left, 0.0), (right, stiffness * curve.at)):
            axes.plot(curve.at, curve.exact - elastic, color=INK, linewidth=1)
            axes.plot(
                curve.at[::6],
                (curve.measured - elastic)[::6],
                "o",
                color=color,
                fillstyle="none",
                markersize=4,
            )
    for axes, label in ((left, "couple [N m]"), (right, "moment of friction [N m]")):
        axes.set_xlabel("curvature [1/m]")
        axes.set_ylabel(label)
    return _bytes(figure)


def picture_of_set(curves: list[Curve], shapes: list[np.ndarray]) -> bytes:
    """Couple over curvature on the left, three shapes on the right."""
    (curve,) = curves
    figure, (left, right) = _figure()
    left.plot(curve.exact, curve.at, color=INK, linewidth=1)
    left.plot(
        curve.measured[::4], curve.at[::4], "o", color=BLUE, fillstyle="none",
        markersize=4,
    )  # fmt: skip
    left.set_xlabel("curvature [1/m]")
    left.set_ylabel("couple [N m]")
    names = ("before", "under the couple", "after it")
    for shape, name, color in zip(shapes, names, (INK, ORANGE, BLUE), strict=True):
        right.plot(*shape, "o-", color=color, label=name, markersize=4)
    right.set_aspect("equal")
    right.set_xlabel("x [m]")
    right.set_ylabel("z [m]")
    right.legend(frameon=False, fontsize=9)
    return _bytes(figure)


def _figure() -> tuple[Any, Any]:
    """Figure with two pairs of axes."""
    figure, (pair,) = charts(7.5, 3.2, columns=2)
    return figure, pair


def _bytes(figure: Any) -> bytes:
    """The figure as a PNG."""
    made = io.BytesIO()
    figure.savefig(made, format="png")
    return made.getvalue()
