"""PyElastica's muscular snake crawling in both libraries.

WHICH is `ours` (jaxrod), `ours+rods+joints+damping` (jaxrod with PyElastica's laws for
these parts), `theirs` (PyElastica) or `our_ground` (PyElastica with our law of the
ground). Prints the position of the body's centre of mass after every quarter of a
period, and its displacement in each period. A period is 200,000 steps.

`hovering` prints where a rod comes to rest above a plane in both libraries. `bellies`
prints how much the bellies of our muscles lean and stretch in the third period.
"""

from __future__ import annotations

import argparse

from benchmarks.muscular_snake.bellies import measure_bellies
from benchmarks.muscular_snake.crawling import crawl
from benchmarks.muscular_snake.hovering import hover


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares what to step, and for how long."""
    parser.add_argument("which", metavar="WHICH", help="see above")
    parser.add_argument(
        "periods", type=int, nargs="?", default=6, help="of crawling (6)"
    )
    parser.add_argument(
        "numbers",
        type=float,
        nargs="*",
        help="arguments of `scene.ours`, `scene.theirs` or `our_ground`",
    )


def run(args: argparse.Namespace) -> int:
    """Steps and prints a table."""
    if args.which == "hovering":
        hover()
    elif args.which == "bellies":
        measure_bellies()
    else:
        crawl(args.which, args.periods, *args.numbers)
    return 0
