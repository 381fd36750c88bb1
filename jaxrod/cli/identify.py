"""Estimate the parameters of a real arm from recordings of its markers.

A TOML file describes the arm: its rod, tendons and markers as designed, and a standard
deviation for each parameter that is not known exactly. Recordings are CSV files with
the time, the inputs of the tendons, and the coordinates of the markers, in any order.
They may also be ROS bags or MCAP files, and then the TOML file names their topics
(docs/twin.md). A recording at rest gives a pose, and one of a moving arm gives a
motion.

The folder gets twin.json (the parameters with their standard deviations, and the errors
of all recordings) and report.html. With --forecast, the command also predicts
recordings that the fit does not use. Judge the result by these predictions.

Exits with 1 if the search did not converge.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrod.cli import settings
from jaxrod.cli.runs import add_out, check_folder

if TYPE_CHECKING:
    from jaxrod.twin import Comparison, Twin

EXAMPLES = """\
examples:
  jaxrod identify poses/*.csv --arm arm.toml --out runs/twin
  jaxrod identify poses/*.csv --arm arm.toml --forecast others/*.csv
  jaxrod identify log.csv --arm arm.toml --robust 3       markers that jump count less
"""

FILES = ("twin.json", "report.html")
"""Files that are written, in addition to config.json."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod identify`."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "recordings",
        nargs="+",
        type=settings.path,
        metavar="LOG",
        help="recordings to fit: CSV, ROS bag or MCAP",
    )
    parser.add_argument(
        "--arm",
        type=settings.path,
        required=True,
        metavar="FILE",
        help="the arm as drawn: TOML",
    )
    parser.add_argument(
        "--forecast",
        nargs="+",
        type=settings.path,
        default=[],
        metavar="LOG",
        help="recordings to predict with the result",
    )
    parser.add_argument(
        "--noise",
        type=float,
        metavar="M",
        help="noise of a coordinate of a frame, or of the median of a pose [m] "
        "(default: estimated from the residuals)",
    )
    parser.add_argument(
        "--robust",
        type=float,
        metavar="SD",
        help="markers farther off than this many standard deviations count less",
    )
    add_out(parser, "runs/twin")
    parser.add_argument(
        "--json", action="store_true", help="print twin.json instead of text"
    )


def run(args: argparse.Namespace) -> int:
    """Fits the arm to the recordings, writes the folder, and prints the result."""
    import jaxrod

    jaxrod.configure_cpu(1)
    import jax

    from jaxrod import twin
    from jaxrod.files import write_atomically
    from jaxrod.training.runs.owned_folder import OwnedFolder
    from jaxrod.twin.report import save_report

    arm = twin.read_arm(args.arm)
    recordings = [twin.read_recording(path, arm) for path in args.recordings]
    others = [twin.read_recording(path, arm) for path in args.forecast]
    folder = OwnedFolder(args.out, "twin", FILES)
    check_folder(folder, args.overwrite)
    with folder.only_process(), jax.enable_x64(True):
        check_folder(folder, args.overwrite)
        found = twin.identify(arm, recordings, noise=args.noise, robust=args.robust)
        folder.begin(
            {
                "arm": str(args.arm),
                "recordings": _names(args.recordings),
                "forecast": _names(args.forecast),
            }
        )
        fitted = found.compare(found.recordings)
        # The fit is kept, whatever becomes of the forecasts.
        for predicted in ([], others) if others else ([],):
            forecasts = found.compare(predicted)
            content = _content(found, fitted, forecasts)
            words = json.dumps(content, indent=2, allow_nan=False)
            write_atomically(args.out / "twin.json", (words + "\n").encode())
            save_report(args.out / "report.html", found, forecasts)
    if args.json:
        print(json.dumps(content, indent=2))
    else:
        print(found)
        for title, rows in (("fitted", "recordings"), ("forecast", "forecasts")):
            error = content[rows].get("root mean square [mm]")
            if error is not None:
                print(f"{title}: {error:.2f} mm")
        print(args.out / "report.html")
    return 0 if bool(found.fit.converged) else 1


def _names(paths: list[Path]) -> list[str]:
    return [str(path) for path in paths]


def _content(
    found: Twin, fitted: list[Comparison], forecasts: list[Comparison]
) -> dict[str, Any]:
    """Contents of twin.json: fitted parameters, and errors of fits and forecasts."""
    import numpy as np

    from jaxrod.twin.identification import root_mean_square

    def numbers(values: Any) -> Any:
        """Numbers as nested lists, with None for those that are not finite."""
        array = np.asarray(values, float).astype(object)
        array[~np.isfinite(values)] = None
        return array.tolist()

    def errors(rows: list[Comparison]) -> dict[str, Any]:
        if not rows:
            return {}
        every = np.array([1000 * row.errors for row in rows])
        return {
            "root mean square [mm]": numbers(root_mean_square(np.ravel(every))),
            "markers": [marker.name for marker in found.arm.markers],
            "errors [mm]": [
                {"recording": row.recording.name, "errors": numbers(one.round(3))}
                for row, one in zip(rows, every, strict=True)
            ],
        }

    fit = found.fit
    return {
        "values": {name: numbers(value) for name, value in fit.values.items()},
        "standard_deviations": {
            name: numbers(sd) for name, sd in fit.standard_deviations.items()
        },
        "noise [m]": found.noise,
        "converged": bool(fit.converged),
        "remarks": list(found.remarks),
        "frame": {
            "rotation": numbers(found.registration.rotation),
            "shifts [m]": numbers(found.registration.shifts),
            "orders": found.registration.orders.tolist(),
        },
        "recordings": errors(fitted),
        "forecasts": errors(forecasts),
    }
