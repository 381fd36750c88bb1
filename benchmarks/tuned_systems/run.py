"""Errors that `jaxrod.tune` states for systems, divided by their true errors.

For each of four systems `tune` finds the cheapest setting within an allowed error. To
find the true error of this setting, the benchmark runs it again, and compares it with
the same system with more elements and a smaller step than the reference of `tune`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxrod
from benchmarks.shared.files import write_record
from benchmarks.tuned_systems.scenes import SCENES
from jaxrod.installation.machine import processor_and_versions

FOLDER = Path(__file__).parent / "records"
RECORDS = 50
"""Moments at which positions are compared."""
REFINED = 20
"""Stable step divided by that of the true motion [1]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the systems, the allowed error and the elements of the true motion."""
    parser.add_argument("scenes", nargs="*", default=list(SCENES), help="systems")
    parser.add_argument("--max-error", type=float, default=0.02, help="allowed error")
    parser.add_argument("--elements", type=int, default=200, help="of true motions")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder of the record")


def run(args: argparse.Namespace) -> int:
    """Measures, prints and writes the record."""
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    found = {}
    for name in args.scenes:
        found[name] = measured(name, args.max_error, args.elements)
        print(json.dumps({name: found[name]}, indent=2), flush=True)
    record = {"machine": processor_and_versions(), "scenes": found}
    write_record(args.out, "tuned_systems", record)
    return 0


def measured(
    name: str, max_error: float, n_elements: int, **few: Any
) -> dict[str, float | str | bool]:
    """Stated and true error of the setting that `tune` finds for a system.

    Args:
        name: Name of the system.
        max_error: Largest allowed error [1].
        n_elements: Number of elements of the longest rod in the true motion.
        **few: Further arguments of `tune`.
    """
    make, duration = SCENES[name]
    system, state = make()
    begun = time.process_time()
    tuned = jaxrod.tune(system, state, max_error=max_error, duration=duration, **few)
    seconds = time.process_time() - begun
    ready = tuned.prepared
    with jax.enable_x64(tuned.setting.dtype == "float64"):
        per_record = round(duration / RECORDS / tuned.setting.dt)
        path = _path(ready.scene, ready.state, tuned.setting.dt, per_record)
    exact = _path(*_fine(system, state, duration, n_elements))
    true = _distance(path, exact) / _length(system)
    return {
        "setting": str(tuned.setting),
        "met": tuned.met,
        "stated": tuned.error,
        "true": true,
        "ratio": tuned.error / true,
        "reference_error": tuned.reference_error,
        "wall_s_per_sim_s": tuned.wall_s_per_sim_s,
        "processor_s": seconds,
    }


def _fine(system: Any, state: Any, duration: float, n_elements: int) -> Any:
    """A finer system, its state, its step [s] and the number of steps per record."""
    numbers = {name: own.n_elements for name, own in _rods(system).items()}
    factor = n_elements // max(numbers.values())
    finer, start = jaxrod.resample(
        system, state, {name: factor * n for name, n in numbers.items()}
    )
    step = float(jaxrod.stable_dt(finer).dt) / REFINED
    steps = int(np.ceil(duration / RECORDS / step))
    return finer, start, duration / RECORDS / steps, steps


def _path(system: Any, state: Any, dt: float, steps: int) -> dict[str, np.ndarray]:
    """Ends and middles of rods and places of bodies at all records [m], by name."""
    found: dict[str, list[np.ndarray]] = {name: [] for name in system.members}
    for _ in range(RECORDS):
        state = jaxrod.advance(system, state, dt, steps)
        for name, path in found.items():
            x = np.asarray(state[name].positions, np.float64).reshape(3, -1)
            # Nothing but the ends and the middle has the same place on all grids.
            last = x.shape[1] - 1
            between = x[:, [0, last]]
            if last % 2 == 0:
                between = x[:, [0, last // 2, last]]
            path.append(between)
    return {name: np.stack(path) for name, path in found.items()}


def _distance(path: dict[str, np.ndarray], exact: dict[str, np.ndarray]) -> float:
    """Root mean square over time of the distance, at the worst point [m]."""
    worst = 0.0
    for name, own in path.items():
        true = exact[name]
        if own.shape != true.shape:
            true = true[:, :, [0, -1]]
        squares = np.sum((own - true) ** 2, axis=1)
        worst = max(worst, float(np.sqrt(np.max(np.mean(squares, axis=0)))))
    return worst


def _rods(system: Any) -> dict[str, Any]:
    members = system.interfaces().items()
    return {name: own.rod for name, own in members if own.rod is not None}


def _length(system: Any) -> float:
    return max(float(np.sum(rod.rest_lengths)) for rod in _rods(system).values())
