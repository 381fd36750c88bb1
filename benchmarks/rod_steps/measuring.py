"""Rod-steps per second on this machine, beside PyElastica's in the same run."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from benchmarks.rod_steps.arms import (
    N_ELEMENTS,
    AdvanceArms,
    arms,
    compile_arms,
    even_share,
)
from benchmarks.rod_steps.pyelastica import TIME_STEP, pyelastica_steps_per_s
from jaxrod.effects.actuation import ElementCouples
from jaxrod.methods.laws import IN_SPACE, Law
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.stepping.runs import advance

BATCHES = (1, 64, 256, 1024, 4096)
DTYPES = ("float32", "float64")
WINDOWS = 5


@dataclasses.dataclass(frozen=True)
class Row:
    """Measurements of one batch."""

    batch: int
    """Number of arms."""
    dtype: str
    """Floating-point type, "float32" or "float64"."""
    mode: Law
    """The scene's mode."""
    rod_steps_per_s: float
    """Steps of one arm per second, median window [1/s]."""
    slowest: float
    """Rate in the slowest window [1/s]."""
    fastest: float
    """Rate in the fastest window [1/s]."""
    devices: int
    """Number of devices the batch was spread over."""
    compile_s: float
    """Time the program took to compile, not counted above [s]."""
    times_pyelastica: float | None = None
    """Ratio to PyElastica's median in the same run; None without PyElastica."""


@dataclasses.dataclass(frozen=True)
class Report:
    """A whole run."""

    pyelastica: tuple[float, ...]
    """PyElastica's steps per second before, between and after the rows [1/s]; empty if
    it is not installed."""
    rows: tuple[Row, ...]
    """One for every mode, type and batch."""

    @property
    def pyelastica_steps_per_s(self) -> float | None:
        """Median of the measurements [1/s]."""
        return statistics.median(self.pyelastica) if self.pyelastica else None


def run_benchmark(
    batches: Sequence[int] = BATCHES,
    dtypes: Sequence[str] = DTYPES,
    modes: Sequence[Law] = tuple(IN_SPACE),
    *,
    seconds: float = 1.5,
    devices: Sequence[jax.Device] | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Report:
    """Measures every combination, and PyElastica before, between and after.

    Args:
        batches: numbers of arms.
        dtypes: "float32", "float64" or both.
        modes: "consistent", "pyelastica" or both.
        seconds: time to measure each row, and PyElastica each time [s].
        devices: devices to spread batches over, None for all.
        say: called with a line of text as each measurement is done.

    Raises:
        ValueError: an argument is out of range.
        FloatingPointError: the arms did not move as a single rod does, so that no
            speed would mean anything.
    """
    _check(batches, dtypes, modes, seconds)
    devices = jax.devices() if devices is None else devices
    pyelastica: list[float] = []

    def step_pyelastica() -> None:
        try:
            rate = pyelastica_steps_per_s(N_ELEMENTS, seconds)
        except ModuleNotFoundError as missing:
            if missing.name != "elastica":
                raise
            say("PyElastica is not installed")
            return
        pyelastica.append(rate)
        say(f"PyElastica {rate:,.0f} steps/s")

    rows: list[Row] = []
    step_pyelastica()
    for mode in modes:
        for dtype in dtypes:
            for batch in batches:
                row = measure(batch, dtype, mode, seconds=seconds, devices=devices)
                rows.append(row)
                say(f"{mode} {dtype} {batch}: {row.rod_steps_per_s:,.0f} rod-steps/s")
            step_pyelastica()
    report = Report(tuple(pyelastica), tuple(rows))
    unit = report.pyelastica_steps_per_s
    if unit is None:
        return report
    compared = (
        dataclasses.replace(row, times_pyelastica=row.rod_steps_per_s / unit)
        for row in rows
    )
    return Report(report.pyelastica, tuple(compared))


def measure(
    batch: int,
    dtype: str = "float32",
    mode: Law = "consistent",
    *,
    seconds: float = 1.5,
    devices: Sequence[jax.Device] | None = None,
) -> Row:
    """Measures one batch.

    Args:
        batch: number of arms.
        dtype: "float32" or "float64".
        mode: "consistent" or "pyelastica".
        seconds: time to measure [s].
        devices: devices to spread the batch over, None for all; as many are used as
            divide it evenly.

    Raises:
        ValueError: an argument is out of range.
        FloatingPointError: the arms did not move as a single rod does.
    """
    _check([batch], [dtype], [mode], seconds)
    devices = jax.devices() if devices is None else devices
    devices = devices[: even_share(batch, len(devices))]
    with jax.enable_x64(dtype == "float64"):
        scene, couples, states = arms(batch, mode)
        if str(states.positions.dtype) != dtype:
            raise ValueError(f"dtype {dtype} is not to be had with these JAX settings")
        began = time.perf_counter()
        run = compile_arms(scene, couples, states, devices)
        compile_s = time.perf_counter() - began
        _check_against_one_rod(run(states, 200), scene, couples[0], 200)
        rates = _time(run, states, batch, seconds)
    return Row(
        batch=batch,
        dtype=dtype,
        mode=mode,
        rod_steps_per_s=statistics.median(rates),
        slowest=min(rates),
        fastest=max(rates),
        devices=len(devices),
        compile_s=compile_s,
    )


def _time(
    run: AdvanceArms, states: RodState, batch: int, seconds: float
) -> list[float]:
    """Rod-steps per second of at least `WINDOWS` windows, and a check of the end."""

    def window(n_steps: int) -> float:
        nonlocal states
        began = time.perf_counter()
        states = run(states, n_steps)
        return time.perf_counter() - began

    # Lengthen the window until a call's fixed cost no longer shows.
    n_steps, target = 8, seconds / (WINDOWS + 1)
    while (took := window(n_steps)) < target / 4:
        n_steps = int(n_steps * min(8.0, max(2.0, 0.5 * target / took)))
    n_steps = max(1, int(n_steps * target / took))
    rates: list[float] = []
    end = time.perf_counter() + seconds
    while len(rates) < WINDOWS or time.perf_counter() < end:
        rates.append(batch * n_steps / window(n_steps))
    _check_equal(states)
    return rates


def _check_against_one_rod(
    states: RodState, scene: Scene, couples: Float[Array, "3 n"], n_steps: int
) -> None:
    """Compares every arm with `jaxrod.advance` on a single rod."""
    _check_equal(states)
    actuated = dataclasses.replace(
        scene, effects=(*scene.effects, ElementCouples(couples))
    )
    start = jax.tree.map(
        lambda leaf: leaf[0],
        arms(1, "consistent" if scene.method.has_energy else "pyelastica")[2],
    )
    alone = advance(actuated, start, TIME_STEP, n_steps)
    _compare("a single rod", states, jax.tree.map(np.asarray, alone))


def _check_equal(states: RodState) -> None:
    """Checks that all arms are finite and, having the same couples, equal."""
    first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], states)
    _compare("the first arm", states, first)


def _compare(other: str, states: RodState, expected: Any) -> None:
    for name in ("positions", "velocities", "orientations", "angular_momenta"):
        got = np.asarray(getattr(states, name))
        want = getattr(expected, name)
        # Programs of one rod and of many round differently, and places that are
        # rounded in every step make rates differ by that per step.
        eps = float(np.finfo(got.dtype).eps)
        tolerance = np.sqrt(eps) * max(1.0, np.max(np.abs(want)))
        if name == "velocities":
            tolerance = max(tolerance, 4 * eps / TIME_STEP)
        error = np.max(np.abs(got - want[None]))
        if not error <= tolerance:
            raise FloatingPointError(
                f"{name} of an arm differ by {error:.1e} from those of {other} "
                f"(limit {tolerance:.1e}): this program computes wrong numbers"
            )


def _check(
    batches: Sequence[int],
    dtypes: Sequence[str],
    modes: Sequence[str],
    seconds: float,
) -> None:
    for batch in batches:
        if batch < 1:
            raise ValueError(f"batches must be at least 1, got {batch}")
    for name, values, known in (("dtypes", dtypes, DTYPES), ("modes", modes, IN_SPACE)):
        for value in values:
            if value not in known:
                raise ValueError(
                    f"{name} must be among {', '.join(known)}; got {value!r}"
                )
    if not 0 < seconds < float("inf"):
        raise ValueError(f"seconds must be positive and finite, got {seconds} s")
