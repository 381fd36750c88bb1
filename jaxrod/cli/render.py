"""Draw the learning curve and a replay of a run.

Writes RUN/learning_curve.png, with the paper's result if the run compares with it, and
RUN/replay.html: one episode of the deterministic policy, if the task can be drawn, as a
page that plays in any browser without a network. Also works while the run is still
training, from its last checkpoint.
"""

from __future__ import annotations

import argparse

from jaxrod.cli import runs, settings

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
    parser.add_argument(
        "run_folder", type=settings.path, metavar="RUN", help="folder of a run"
    )
    runs.add_trust(parser)
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
    from jaxrod.cli import pictures
    from jaxrod.validation import check_seed

    if args.seconds is not None and not 0 < args.seconds < float("inf"):
        raise ValueError(f"seconds must be positive and finite, got {args.seconds} s")
    check_seed(args.seed)
    jaxrod.configure_cpu()
    stored = runs.open_run(args.run_folder, args.trust)
    pictures.print_paths(pictures.draw_learning_curve(stored.path, stored.config))
    policy = stored.policy()
    pictures.print_paths(
        pictures.write_replay(
            stored, policy, args.out, seconds=args.seconds, seed=args.seed
        )
    )
    return 0
