"""Find actuation by gradients through the simulation.

Takes the arm of a task, straight and at rest, and looks for muscle activity that
brings its tip to a target at the end of a given time. The whole simulation is
differentiated with respect to control values at knots in time, and Adam follows the
gradient. TASK is `tracking`, whose arm is 1 m long, clamped at the origin and points
along +y.

The folder gets config.json (what was asked for), history.csv (a row per gradient
step), summary.json, trajectory.npz (knots, controls and the motion), convergence.png,
and replay.html, a page that plays in any browser without a network. Ctrl-C stops and
writes the best so far.

Exits with 0 when the tip ends within the tolerance, and with 1 when it does not.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrod.cli import settings

if TYPE_CHECKING:
    from jaxrod.envs import Environment
    from jaxrod.training import ActuatedArm, TrajectoryResult
    from jaxrod.training.runs.owned_folder import OwnedFolder

EXAMPLES = """\
examples:
  jaxrod optimise tracking                                  a target 60 cm from the tip
  jaxrod optimise tracking --target -0.3 0.5 0.4 --out runs/reach
  jaxrod optimise tracking --duration 2 --speed-tolerance 0.05   ... and come to rest
  jaxrod optimise tracking --elements 20 --double           finer, in float64
  jaxrod optimise tracking --json > result.json             for a script: summary.json
"""

TASKS = ("tracking",)

FILES = (
    "history.csv",
    "summary.json",
    "trajectory.npz",
    "convergence.png",
    "replay.html",
)
"""Files that are written, beside config.json."""

ASKED = (
    "task",
    "target",
    "duration",
    "knots",
    "twist",
    "iterations",
    "tolerance",
    "speed_tolerance",
    "learning_rate",
    "seed",
    "elements",
    "double",
)
"""The request, as config.json keeps it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod optimise`."""
    parser.epilog = EXAMPLES
    parser.add_argument("task", metavar="TASK", help="whose arm: tracking")
    parser.add_argument(
        "--target",
        type=float,
        nargs=3,
        default=(0.4, 0.6, 0.2),
        metavar=("X", "Y", "Z"),
        help="where the tip should end [m] (default: 0.4 0.6 0.2)",
    )
    parser.add_argument(
        "--out",
        type=settings.path,
        default=Path("runs/optimise"),
        metavar="DIR",
        help="folder for the result (default: runs/optimise)",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the result in DIR"
    )
    parser.add_argument(
        "--duration",
        type=float,
        default=1.0,
        metavar="S",
        help="simulated time to get there (default: 1 s)",
    )
    parser.add_argument(
        "--knots",
        type=int,
        default=11,
        metavar="N",
        help="knots in time of each control value (default: 11)",
    )
    parser.add_argument(
        "--twist", action="store_true", help="muscles may twist the arm, too"
    )
    parser.add_argument(
        "--iterations",
        type=int,
        default=100,
        metavar="N",
        help="the most gradient steps (default: 100)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.005,
        metavar="M",
        help="stop when the tip ends this close (default: 0.005 m)",
    )
    parser.add_argument(
        "--speed-tolerance",
        type=float,
        metavar="V",
        help="... and is at most this fast [m/s] (default: any speed)",
    )
    parser.add_argument(
        "--learning-rate",
        type=float,
        default=0.05,
        metavar="R",
        help="of Adam, per gradient step (default: 0.05)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of the first guess (default: 0)"
    )
    parser.add_argument(
        "--elements",
        type=int,
        metavar="N",
        help="elements of the arm, a multiple of 10 (default: the task's)",
    )
    parser.add_argument(
        "--double", action="store_true", help="compute in float64 instead of float32"
    )
    parser.add_argument(
        "--json", action="store_true", help="print summary.json instead of text"
    )


def run(args: argparse.Namespace) -> int:
    """Optimises, writes the folder, and prints the result."""
    import jaxrod
    from jaxrod.validation import check_seed

    if args.task not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}; got {args.task!r}")
    check_seed(args.seed)
    if args.knots < 2:
        raise ValueError(f"knots must be at least 2, got {args.knots}")
    jaxrod.configure_cpu(1)
    import jax

    from jaxrod import envs
    from jaxrod.training import optimise_trajectory
    from jaxrod.training.runs.owned_folder import OwnedFolder

    out: Path = args.out
    folder = OwnedFolder(out, "optimised trajectory", FILES)
    with ExitStack() as stack:
        # Once so that what is refused leaves no trace, once more when nobody else can
        # change it.
        _check_folder(folder, args.overwrite)
        stack.enter_context(folder.only_process())
        _check_folder(folder, args.overwrite)
        stack.enter_context(jax.enable_x64(args.double))
        options = {} if args.elements is None else {"n_elements": args.elements}
        env = envs.make(args.task, variant="clean", **options)
        result = optimise_trajectory(
            args.target,
            arm_of(env),
            duration=args.duration,
            n_knots=args.knots,
            directions=3 if args.twist else 2,
            iterations=args.iterations,
            tolerance=args.tolerance,
            speed_tolerance=args.speed_tolerance,
            learning_rate=args.learning_rate,
            seed=args.seed,
        )
        summary = {"task": args.task, "seed": args.seed, **_summary(result)}
        folder.begin({name: getattr(args, name) for name in ASKED})
        _write(out, result, summary)
    if args.json:
        print(json.dumps(summary | {"out": str(out)}, indent=2))
    else:
        print(
            f"tip {1000 * result.tip_distance:.1f} mm from the target at "
            f"{result.tip_speed:.2f} m/s ({result.reason} after "
            f"{result.iterations} gradient steps, {result.wall_s:.1f} s)\n{out}"
        )
    if result.reason == "interrupted":
        return 130
    return 0 if result.success else 1


def _check_folder(folder: OwnedFolder, overwrite: bool) -> None:
    """Says why the folder cannot be used, if it cannot."""
    folder.check_replaceable()
    if folder.exists and not overwrite:
        raise ValueError(
            f"{folder.path} holds a result already: replace it with --overwrite, or "
            "choose another folder with --out"
        )


def arm_of(env: Environment) -> ActuatedArm:
    """The arm of a clean task, straight and at rest, with the task's muscles."""
    from jaxrod.envs.arm.clean import CleanArm
    from jaxrod.training import ActuatedArm

    arm: CleanArm = env.default_params().arm
    return ActuatedArm(arm.scene(), arm.rest, arm.spline, arm.couple_density)


def _summary(result: TrajectoryResult) -> dict[str, Any]:
    problem = result.problem
    return {
        "target": [float(x) for x in problem.target],
        "success": result.success,
        "reason": result.reason,
        "tip_distance": result.tip_distance,
        "tip_speed": result.tip_speed,
        "iterations": result.iterations,
        "wall_s": result.wall_s,
        "compile_s": result.compile_s,
        "duration": float(result.times[-1]),
        "dt": float(problem.dt),
        "n_elements": problem.arm.scene.rod.n_elements,
        "dtype": str(result.knots.dtype),
    }


def _write(out: Path, result: TrajectoryResult, summary: dict[str, Any]) -> None:
    import numpy as np

    from jaxrod import viz
    from jaxrod.files import write_atomically

    out.mkdir(parents=True, exist_ok=True)
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    columns = vars(result.history)
    writer.writerow(["iteration", *columns])
    for index, row in enumerate(zip(*columns.values(), strict=True)):
        writer.writerow([index, *(f"{number:.9g}" for number in row)])
    write_atomically(out / "history.csv", table.getvalue().encode())
    arrays = io.BytesIO()
    np.savez_compressed(
        arrays,
        knot_times=result.knot_times,
        knots=np.asarray(result.knots),
        times=result.times,
        controls=np.asarray(result.controls),
        positions=np.asarray(result.states.positions),
        orientations=np.asarray(result.states.orientations),
        velocities=np.asarray(result.states.velocities),
        angular_momenta=np.asarray(result.states.angular_momenta),
    )
    write_atomically(out / "trajectory.npz", arrays.getvalue())
    viz.save_html(result.replay(), out / "replay.html")
    try:
        write_atomically(out / "convergence.png", _draw(result))
    except ModuleNotFoundError as missing:
        if missing.name != "matplotlib":
            raise
        print(
            'the picture needs matplotlib: pip install "jaxrod[viz]"', file=sys.stderr
        )
    # Last, because its presence says that the folder is complete.
    write_atomically(
        out / "summary.json", (json.dumps(summary, indent=2) + "\n").encode()
    )


def _draw(result: TrajectoryResult) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    history = result.history
    left.semilogy(history.loss, label="loss [m²]")
    left.semilogy(history.tip_distance, label="distance [m]")
    left.semilogy(history.gradient_norm, label="gradient norm [m²]", linewidth=0.8)
    left.set_xlabel("gradient step")
    left.legend(frameon=False, fontsize=9)
    values = result.knots.reshape(len(result.knot_times), -1)
    right.plot(result.knot_times, values, marker=".", linewidth=1)
    right.set_xlabel("time [s]")
    right.set_ylabel("control value")
    for axes in (left, right):
        axes.grid(color="#d5dbe4", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
