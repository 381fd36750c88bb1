"""Twist and writhe of a rod that is twisted until it winds around itself.

`twisted` is PyElastica's plectoneme with ten turns, in jaxrod and in PyElastica.
`pulled` is a rod between guides under tension, turned 13 times, in jaxrod.
"""

from __future__ import annotations

import argparse

from benchmarks.plectoneme.pulled import pull
from benchmarks.plectoneme.twisted import twist


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the scenes and their numbers."""
    scenes = parser.add_subparsers(dest="scene", metavar="SCENE", required=True)
    twisted = scenes.add_parser("twisted", help="ten turns, both libraries")
    twisted.add_argument("n", type=int, nargs="?", default=50, help="elements (50)")
    twisted.add_argument(
        "seconds", type=float, nargs="?", default=50.0, help="simulated time (50) [s]"
    )
    twisted.add_argument(
        "count",
        type=float,
        nargs="?",
        help="our contact over one pair of PyElastica's per element (measured)",
    )
    pulled = scenes.add_parser("pulled", help="13 turns under a pull, between guides")
    pulled.add_argument("force", type=float, nargs="?", default=300.0, help="(300) [N]")
    pulled.add_argument("turns", type=float, nargs="?", default=13.0, help="(13)")
    pulled.add_argument(
        "contact",
        type=float,
        nargs="?",
        default=1e7,
        help="stiffness of contact (1e7) [N/m^2]",
    )


def run(args: argparse.Namespace) -> int:
    """Steps and prints a table."""
    if args.scene == "twisted":
        twist(args.n, args.seconds, args.count)
    else:
        pull(args.force, args.turns, args.contact)
    return 0
