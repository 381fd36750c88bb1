"""Find actuation by gradients through the simulation.

Takes the arm of a task, straight and at rest, and finds muscle activity that brings its
tip to a target at the end of a given time. The unknowns are control values at knots in
time, and the command differentiates the whole simulation with respect to them.
Levenberg-Marquardt uses the derivatives of the tip's position and velocity, and needs a
handful of iterations. Adam follows the gradient of the cost, and needs a hundred or
more. TASK is `tracking`, whose arm is 1 m long, clamped at the origin and points along
+y.

The folder gets config.json (the request), history.csv (a row per iteration),
summary.json, trajectory.npz (knots, controls and the motion), convergence.png, and
replay.html, a page that plays in any browser without a network. Ctrl-C stops Adam and
writes the best result so far.

Exits with 0 if the tip ends within the tolerances of distance and speed, with 1 if it
does not, and with 130 after Ctrl-C.
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

from jaxrod.cli.runs import add_out, check_folder

if TYPE_CHECKING:
    from jaxrod.control import ActuatedArm, Problem, Reach, Solution
    from jaxrod.envs import Environment

EXAMPLES = """\
examples:
  jaxrod optimise tracking                                  a target 60 cm from the tip
  jaxrod optimise tracking --target -0.3 0.5 0.4 --out runs/reach
  jaxrod optimise tracking --duration 2 --speed-tolerance 0.05   ... and come to rest
  jaxrod optimise tracking --solver adam --iterations 300   the gradient alone
  jaxrod optimise tracking --elements 20 --double           finer, in float64
  jaxrod optimise tracking --json > result.json             for a script: summary.json
"""

TASKS = ("tracking",)
SOLVERS = {"levenberg-marquardt": 20, "adam": 150}
"""Names of the solvers, and their default limits of iterations."""

SPEED_WEIGHT = 1e-3
"""Weight of the squared final speed of the tip in the cost [s^2]."""

FILES = (
    "history.csv",
    "summary.json",
    "trajectory.npz",
    "convergence.png",
    "replay.html",
)
"""Files that are written, in addition to config.json."""

ASKED = (
    "task",
    "target",
    "duration",
    "knots",
    "twist",
    "solver",
    "iterations",
    "tolerance",
    "speed_tolerance",
    "learning_rate",
    "seed",
    "elements",
    "double",
)
"""Arguments of the command that config.json stores."""


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
    add_out(parser, "runs/optimise")
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
        "--solver",
        choices=tuple(SOLVERS),
        default="levenberg-marquardt",
        help="solver for the knots (default: levenberg-marquardt)",
    )
    parser.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        help="largest number of iterations (default: 20; 150 for Adam)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.005,
        metavar="M",
        help="largest final distance of the tip from the target (default: 0.005 m)",
    )
    parser.add_argument(
        "--speed-tolerance",
        type=float,
        metavar="V",
        help="largest final speed of the tip [m/s] (default: any speed)",
    )
    parser.add_argument(
        "--learning-rate",
        type=float,
        default=0.05,
        metavar="R",
        help="step size of Adam (default: 0.05)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="random seed of the first guess (default: 0)",
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
    """Optimises the actuation, writes the folder, and prints the result."""
    import jaxrod
    from jaxrod.validation import check_array, check_count, check_seed

    if args.task not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}; got {args.task!r}")
    check_seed(args.seed)
    check_count("knots", args.knots, 2)
    if args.iterations is None:
        args.iterations = SOLVERS[args.solver]
    check_array("tolerance", args.tolerance, [()], "m", positive=True)
    if args.speed_tolerance is not None:
        check_array("speed_tolerance", args.speed_tolerance, [()], "m/s", positive=True)
    jaxrod.configure_cpu(1)
    import jax

    from jaxrod import control, envs
    from jaxrod.training.runs.owned_folder import OwnedFolder

    out: Path = args.out
    folder = OwnedFolder(out, "optimised trajectory", FILES)
    with ExitStack() as stack:
        # The folder is checked first, so that a refusal leaves no trace, and again once
        # no other process can change it.
        check_folder(folder, args.overwrite)
        stack.enter_context(folder.only_process())
        check_folder(folder, args.overwrite)
        stack.enter_context(jax.enable_x64(args.double))
        options = {} if args.elements is None else {"n_elements": args.elements}
        arm = arm_of(envs.make(args.task, variant="clean", **options))
        problem = control.reach(
            arm,
            args.target,
            args.duration,
            speed_weight=SPEED_WEIGHT,
            control_shape=(3 if args.twist else 2, arm.spline.n_controls),
        )
        result = _solved(problem, args)
        summary = {
            "task": args.task,
            "seed": args.seed,
            **_summary(result, args.tolerance, args.speed_tolerance),
        }
        folder.begin({name: getattr(args, name) for name in ASKED})
        _write(out, result, summary)
    if args.json:
        print(json.dumps(summary | {"out": str(out)}, indent=2))
    else:
        print(
            f"tip {1000 * summary['tip_distance']:.1f} mm from the target at "
            f"{summary['tip_speed']:.2f} m/s after {result.iterations} iterations "
            f"({result.reason}); compiled in {result.compile_s:.1f} s, run in "
            f"{result.run_s:.1f} s\n{out}"
        )
    if result.interrupted:
        return 130
    return 0 if summary["success"] else 1


def _solved(problem: Problem, args: argparse.Namespace) -> Solution:
    """Runs the chosen solver; returns the best trajectory that it found."""
    from jaxrod import control
    from jaxrod.training.progress import ProgressBar

    if args.solver != "adam":
        return control.levenberg_marquardt(
            problem, n_knots=args.knots, iterations=args.iterations, seed=args.seed
        )
    bar = ProgressBar(args.iterations, "steps", done=1)

    def log(iteration: int, cost: float) -> None:
        if iteration == 0:
            bar.restart()
        bar.update(iteration + 1, f"cost {cost:.2e} m^2")

    # At this cost the tip is as close and as slow as requested.
    enough = args.tolerance**2
    if args.speed_tolerance is not None:
        enough = min(enough, SPEED_WEIGHT * args.speed_tolerance**2)
    return control.adam(
        problem,
        n_knots=args.knots,
        iterations=args.iterations,
        learning_rate=args.learning_rate,
        enough=enough,
        seed=args.seed,
        log=log,
    )


def arm_of(env: Environment) -> ActuatedArm:
    """Arm of a task of the clean variant, with its muscles, straight and at rest."""
    from jaxrod.control import ActuatedArm
    from jaxrod.envs.arm.clean import CleanArm

    arm: CleanArm = env.default_params().arm
    return ActuatedArm(arm.scene(), arm.rest, arm.spline, arm.couple_density)


def _summary(
    result: Solution, tolerance: float, speed_tolerance: float | None
) -> dict[str, Any]:
    problem = result.problem
    reach: Reach = problem.data
    distance, speed = (float(values[-1]) for values in result.readouts.values())
    slow = speed_tolerance is None or speed <= speed_tolerance
    return {
        "target": [float(x) for x in reach.target],
        "success": distance <= tolerance and slow,
        "solver": result.solver,
        "reason": result.reason,
        "tip_distance": distance,
        "tip_speed": speed,
        "cost": result.cost,
        "iterations": result.iterations,
        "compile_s": result.compile_s,
        "run_s": result.run_s,
        "duration": float(result.times[-1]),
        "dt": float(reach.dt),
        "n_elements": reach.scene.rod.n_elements,
        "dtype": str(result.controls.dtype),
    }


def _write(out: Path, result: Solution, summary: dict[str, Any]) -> None:
    import numpy as np

    from jaxrod import viz
    from jaxrod.files import write_atomically

    out.mkdir(parents=True, exist_ok=True)
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["iteration", *result.history])
    for index, row in enumerate(zip(*result.history.values(), strict=True)):
        writer.writerow([index, *(f"{number:.9g}" for number in row)])
    write_atomically(out / "history.csv", table.getvalue().encode())
    assert result.knots is not None
    shape: tuple[int, ...] = result.problem.data.control_shape
    arrays = io.BytesIO()
    np.savez_compressed(
        arrays,
        knot_times=_knot_times(result),
        knots=np.asarray(result.knots).reshape(-1, *shape),
        times=result.times,
        controls=np.asarray(result.controls).reshape(-1, *shape),
        positions=np.asarray(result.states.positions),
        orientations=np.asarray(result.states.orientations),
        velocities=np.asarray(result.states.velocities),
        angular_momenta=np.asarray(result.states.angular_momenta),
    )
    write_atomically(out / "trajectory.npz", arrays.getvalue())
    viz.save_html(result.replay("Optimised trajectory"), out / "replay.html")
    try:
        write_atomically(out / "convergence.png", _draw(result))
    except ModuleNotFoundError as missing:
        if missing.name != "matplotlib":
            raise
        print(
            'the picture needs matplotlib: pip install "jaxrod[viz]"', file=sys.stderr
        )
    # Written last: its presence shows that the folder is complete.
    write_atomically(
        out / "summary.json", (json.dumps(summary, indent=2) + "\n").encode()
    )


def _knot_times(result: Solution) -> Any:
    """Times of the knots of the control values, evenly spaced [s]."""
    import numpy as np

    assert result.knots is not None
    return np.linspace(0.0, result.times[-1], result.knots.shape[0])


DIRECTIONS = ("bending about d1", "bending about d2", "twist about d3")
"""Names of the rows of control values."""


def _draw(result: Solution) -> bytes:
    picture = io.BytesIO()
    _figure(result).savefig(picture, format="png")
    return picture.getvalue()


def _figure(result: Solution) -> Any:
    import numpy as np

    from jaxrod.viz.style import COLOURS, charts

    figure, ((left, right),) = charts(8, 3.6, columns=2)
    for name, values in result.history.items():
        left.semilogy(values, label=name.replace("_", " "))
    left.set_xlabel("iteration")
    left.xaxis.get_major_locator().set_params(integer=True)
    left.legend(frameon=False, fontsize=9)
    assert result.knots is not None
    shape: tuple[int, ...] = result.problem.data.control_shape
    values = np.asarray(result.knots).reshape(-1, *shape)
    times = _knot_times(result)
    # One colour per direction, paler towards the base.
    for row, (name, colour) in enumerate(zip(DIRECTIONS, COLOURS, strict=False)):
        for point in range(shape[1] if row < shape[0] else 0):
            is_tip = point == shape[1] - 1
            right.plot(
                times,
                values[:, row, point],
                color=colour,
                alpha=0.25 + 0.75 * (point + 1) / shape[1],
                marker=".",
                linewidth=1,
                label=name if is_tip else None,
            )
    right.legend(frameon=False, fontsize=9, title="pale: at the base", title_fontsize=9)
    right.set_xlabel("time [s]")
    right.set_ylabel("control value")
    return figure
