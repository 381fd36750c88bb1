"""Draw the learning curve and a replay of a run.

Writes RUN/learning_curve.png, and compares the curve with the paper's result if the
two are comparable. If the task can be drawn, also writes RUN/replay.html: an episode of
the deterministic policy, on a page that plays in any browser without a network. While a
run is still training, the command shows its last checkpoint.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrod.cli import runs, settings
from jaxrod.cli.runs import printable
from jaxrod.files import DamagedFileError

if TYPE_CHECKING:
    from jaxrod.training import Policy

EXAMPLES = """\
examples:
  jaxrod render runs/first
  jaxrod render runs/first --seed 3 --out episode3.html     another episode
  jaxrod render runs/first --seconds 3                      the first 3 s only
  jaxrod render runs/arm --trust examples/own_task.py       a run of your own task
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod render`."""
    parser.epilog = EXAMPLES
    runs.add_run(parser)
    parser.add_argument(
        "--out",
        type=settings.path,
        metavar="FILE",
        help="where to write the replay (default: RUN/replay.html)",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help="simulated time to show (default: a whole episode)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="which episode to show (default: 0)"
    )


def run(args: argparse.Namespace) -> int:
    """Draws the files and prints their names."""
    import jaxrod
    from jaxrod.validation import check_seed

    if args.seconds is not None and not 0 < args.seconds < float("inf"):
        raise ValueError(f"seconds must be positive and finite, got {args.seconds} s")
    check_seed(args.seed)
    jaxrod.configure_cpu()
    stored = runs.open_run(args.run_folder, args.trust, args.task)
    print_paths(draw_learning_curve(stored.path, stored.config))
    policy = stored.policy()
    print_paths(
        write_replay(stored, policy, args.out, seconds=args.seconds, seed=args.seed)
    )
    return 0


def draw_learning_curve(path: Path, config: Mapping[str, Any]) -> Path | None:
    """Draws `learning_curve.png` into a run folder, or prints why there is none."""
    from jaxrod import viz
    from jaxrod.training.runs.folder import LEARNING_CURVE

    out = path / LEARNING_CURVE
    try:
        viz.learning_curve(
            path / "progress.csv",
            out,
            title=runs.describe(config),
        )
    except ModuleNotFoundError as missing:
        if missing.name != "matplotlib":
            raise
        _note('the learning curve needs matplotlib: pip install "jaxrod[viz]"')
    except FileNotFoundError:
        _note("no learning curve: the run has not logged anything yet")
    except DamagedFileError:
        raise
    except ValueError as error:
        _note(f"no learning curve: {error}")
    else:
        return out
    return None


def write_replay(
    run: runs.StoredRun,
    policy: Policy,
    out: Path | None = None,
    *,
    seconds: float | None = None,
    seed: int = 0,
) -> Path | None:
    """Plays one episode of a policy and writes it as an HTML page.

    Args:
        run: The run.
        policy: Policy of the run.
        out: Page to write; None for `replay.html` in the run folder.
        seconds: Simulated time to show [s]; None for a whole episode.
        seed: Seed of the episode.

    Returns:
        The page; None if the task cannot be drawn, after a message.
    """
    from jaxrod import viz
    from jaxrod.cli import recording
    from jaxrod.envs import names
    from jaxrod.envs.drawing import missing
    from jaxrod.training.runs.folder import REPLAY

    if lacks := missing(run.env):
        # A user can add what a task lacks only if it is the user's own.
        built_in = run.config["task"] in names()
        _note(f"no replay: {f'{run.env.name} has no pictures' if built_in else lacks}")
        return None
    replay = recording.record(
        run.env, policy, seconds=seconds, seed=seed, title=run.title
    )
    out = out or run.path / REPLAY
    out.parent.mkdir(parents=True, exist_ok=True)
    viz.save_html(replay, out, frames_per_second=recording.FRAMES_PER_SECOND)
    return out


def print_paths(*paths: Path | None) -> None:
    """Prints the paths of the written files, one per line."""
    for path in paths:
        if path is not None:
            print(os.fspath(path))


def _note(text: str) -> None:
    print(printable(text), file=sys.stderr)
