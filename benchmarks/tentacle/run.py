"""A twin of a real arm with two tendons, from the recordings of its makers.

FOLDER contains the recordings: CSV files of frames, times and the coordinates of five
markers. The order of the markers differs from file to file. A file is named after the
torques on the two pulleys (m1_u015: 0.15 N m on the first). The recordings are in the
folder paper_results/secVa_system_identification/data of tud-phi/soromox on GitHub.

Like the makers' fit, this fit uses eight poses with one tendon pulled. It forecasts all
others. It finds the labels of the markers itself, and compares them with the true
labels if FOLDER has markers.csv. Writes a table into docs/twin.md, and with --report
the page of the twin.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxrod
from benchmarks.shared.files import ROOT
from benchmarks.shared.page_tables import measured_table
from benchmarks.tentacle import network
from jaxrod import twin
from jaxrod.twin.report import save_report

PAGE = ROOT / "docs" / "twin.md"
ARM = Path(__file__).with_name("arm.toml")
FITTED = tuple(f"m{k}_u{u}" for k in (1, 2) for u in ("01", "015", "02", "025"))
"""Poses that the makers of the arm fitted."""
MARKERS = 5
THEIRS = (11.3, 18.4, 19.2, 35.6)
"""Errors of the makers' model over the fitted poses, by marker [mm]."""
HEAD = (
    "| recordings | first | second | third | tip | all four |\n"
    "|---|---:|---:|---:|---:|---:|"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="the recordings")
    parser.add_argument(
        "--report", type=Path, metavar="FILE", help="HTML page to write"
    )
    parser.add_argument("--dry", action="store_true", help="leave the page as it is")
    parser.add_argument(
        "--leave-out",
        action="store_true",
        help="only forecast each of the eight poses from the other seven, without any "
        "other recording: to choose the unknowns of arm.toml",
    )
    parser.add_argument(
        "--poses",
        action="store_true",
        help="only find the pose of each recording for the arm as drawn, from the "
        "straight one, and print how long it takes",
    )
    parser.add_argument(
        "--network",
        action="store_true",
        help="also fit a network inside the twin, and print what it adds",
    )


def torques(name: str) -> tuple[float, float]:
    """Torques on the two pulleys, from the name of a recording [N m].

    `m1_u015` has 0.15 on the first, and `m12_u00100005` 0.10 and 0.05 on both;
    `m12_u001002` has 0.1 and 0.2, and `m12_u001` has 0.1 twice.
    """
    motors, digits = name.removeprefix("m").split("_u")
    if motors != "12":
        torque = int(digits) / 10 ** (len(digits) - 1)
        return (torque, 0.0) if motors == "1" else (0.0, torque)
    half = len(digits) if len(digits) < 6 else len(digits) // 2
    first, second = digits[:half], digits[-half:]
    return int(first) / 10 ** (half - 2), int(second) / 10 ** (half - 2)


def recordings(folder: Path) -> list[twin.Recording]:
    """All recordings of a folder, without labels."""
    found = []
    for path in sorted(folder.glob("m*_u*.csv")):
        table = np.genfromtxt(path, delimiter=",")
        rising = np.concatenate(
            [[True], np.diff(np.maximum.accumulate(table[:, 1])) > 0]
        )
        table = table[rising]
        points = table[:, 2 : 2 + 3 * MARKERS].reshape(-1, MARKERS, 3)
        inputs = np.broadcast_to(torques(path.stem), (len(table), 2))
        found.append(twin.Recording(path.stem, table[:, 1], inputs, points, False))
    return found


def known_orders(folder: Path) -> dict[str, list[int]]:
    """Orders of the markers, if the folder has them."""
    path = folder / "markers.csv"
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        _, *rows = csv.reader(file)
    return {Path(row[0]).stem: [int(word) for word in row[1:]] for row in rows}


def _row(title: str, compared: Sequence[twin.Comparison]) -> str:
    """Root mean square errors of the four markers that are not the origin [mm]."""
    errors = 1000 * np.array([one.errors[1:] for one in compared])
    each = np.sqrt(np.mean(errors**2, axis=0))
    cells = " | ".join(f"{e:.1f}" for e in each)
    return f"| {title} | {cells} | {np.sqrt(np.mean(errors**2)):.1f} |"


def _left_out(poses: Sequence[twin.Recording]) -> list[twin.Comparison]:
    """Forecast of each pose by a twin of all others."""
    arm, found = twin.read_arm(ARM), []
    for one in poses:
        others = [pose for pose in poses if pose is not one]
        found += twin.identify(arm, others).compare([one])
    return found


def _time_poses(every: Sequence[twin.Recording], rounds: int = 9) -> None:
    """Prints the processor time of the equilibrium of each recording, as drawn.

    It is the median of `rounds` calls, each from the straight arm.
    """
    arm = twin.read_arm(ARM)

    def made(inputs: jax.Array) -> tuple[Any, Any]:
        pulls = arm.tensions(arm.start, inputs)
        return arm.scene(arm.start, lambda numbers: pulls[numbers])

    def found(scene: Any, state: Any) -> tuple[Any, float]:
        began = time.process_time()
        rest = jax.block_until_ready(jaxrod.equilibrium(scene, state))
        return rest, time.process_time() - began

    scenes = [made(jax.numpy.asarray(one.inputs[0])) for one in every]
    print(f"first call: {found(*scenes[0])[1]:.1f} s of processor time")
    for recording, scene in zip(every, scenes, strict=True):
        rest, _ = found(*scene)
        took = np.median([found(*scene)[1] for _ in range(rounds)])
        print(
            f"{recording.name:>16}  {1000 * took:5.1f} ms, {int(rest.iterations):2d} "
            f"corrections{'' if rest.converged else ', not converged'}"
        )


def _with_network(found: twin.Twin, groups: dict[str, Any]) -> None:
    """Prints errors with and without a network that learns from the fitted poses."""
    known = [c.recording for c in groups["fitted"]]
    began = time.process_time()
    trained = network.learn(found, known)
    print(f"network: {time.process_time() - began:.0f} s of processor time")
    left = []
    for k, one in enumerate(known):
        others = network.learn(found, known[:k] + known[k + 1 :])
        left.append(network.errors(found, others, [one])[0])
    print(f"each pose, the network by the seven others: {_mean(np.array(left)):.1f} mm")
    for title, compared in groups.items():
        seen = [c.recording for c in compared]
        without, after = (
            _mean(network.errors(found, weights, seen))
            for weights in (network.start(), trained)
        )
        print(f"{title}: {without:.1f} mm without, {after:.1f} mm with the network")


def _mean(errors: np.ndarray) -> float:
    """Root mean square [mm] of distances [m]."""
    return float(1000 * np.sqrt(np.mean(errors**2)))


def _apart_from_named(found: twin.Twin, every: Sequence[twin.Recording]) -> float:
    """Largest distance between the tips of the fitted twin and of `twin.tentacle` [m].

    Both are at rest under the torques of each recording.
    """
    arm, values, apart = found.arm, found.values, 0.0
    for recording in every:
        pulls = arm.tensions(values, jax.numpy.asarray(recording.inputs[0]))
        tips = []
        for scene, state in (
            arm.scene(values, lambda numbers, pulls=pulls: pulls[numbers]),
            twin.tentacle(pulls),
        ):
            rest = jaxrod.equilibrium(scene, state)
            assert rest.converged, recording.name
            tips.append(np.asarray(rest.state.tip))
        apart = max(apart, float(np.linalg.norm(tips[1] - tips[0])))
    return apart


def run(args: argparse.Namespace) -> int:
    """Fits, forecasts, prints and writes the table."""
    every = recordings(args.folder)
    poses = [one for one in every if one.name in FITTED]
    others = [one for one in every if one.name not in FITTED]
    if args.poses:
        with jax.enable_x64(True):
            _time_poses(every)
        return 0
    if args.leave_out:
        with jax.enable_x64(True):
            print(_row("each pose from the seven others", _left_out(poses)))
        return 0
    with jax.enable_x64(True):
        wall, busy = time.perf_counter(), time.process_time()
        found = twin.identify(twin.read_arm(ARM), poses)
        wall, busy = time.perf_counter() - wall, time.process_time() - busy
        fitted = found.compare(found.recordings)
        forecasts = found.compare(others)
        if args.report is not None:
            save_report(args.report, found, forecasts)
    print(found)
    known = known_orders(args.folder)
    orders = dict(zip((p.name for p in poses), found.registration.orders, strict=True))
    wrong = [
        n for n, order in orders.items() if list(order) != known.get(n, list(order))
    ]
    print(f"labels: {len(orders) - len(wrong)} of {len(orders)} right")
    print(f"first call: {wall:.1f} s, {busy:.1f} s of processor time")
    with jax.enable_x64(True):
        apart = 1000 * _apart_from_named(found, every)
    print(f"tips of twin.tentacle: at most {apart:.2f} mm from those of this twin")
    one = [c for c in forecasts if not c.recording.name.startswith("m12")]
    two = [c for c in forecasts if c.recording.name.startswith("m12")]
    if args.network:
        with jax.enable_x64(True):
            groups = {"fitted": fitted, "one tendon": one, "both tendons": two}
            _with_network(found, groups)
        return 0
    theirs = " | ".join(f"{e:.1f}" for e in THEIRS)
    rows = [
        f"| eight poses, the makers' model | {theirs} "
        f"| {np.sqrt(np.mean(np.square(THEIRS))):.1f} |",
        _row("eight poses, fitted", fitted),
        _row(f"{len(one)} others, one tendon, forecast", one),
        _row(f"{len(two)} others, both tendons, forecast", two),
        _row(f"all {len(forecasts)} others", forecasts),
    ]
    measured_table(PAGE, "tentacle", HEAD, lambda: rows, dry=args.dry)
    for compared in (*fitted, *forecasts):
        errors = " ".join(f"{1000 * e:5.1f}" for e in compared.errors[1:])
        print(f"{compared.recording.name:>16}  {errors}")
    return 0
