"""Cases 3 and 4 of the published grid in the library's own physics.

Runs `jaxrod reproduce` for the `clean` variants of both cases, by default with SAC, TD3
and five seeds. Writes the same files into benchmarks/clean/records as `paper` writes
into its records.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.paper import run as paper


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod reproduce`, with other defaults."""
    paper.add_arguments(parser)
    parser.epilog = None
    parser.set_defaults(
        cases=["Case3", "Case4"],
        variant="clean",
        algorithms=["sac", "td3"],
        seeds=[0, 1, 2, 3, 4],
        out=Path("benchmarks/clean/records"),
    )


def run(args: argparse.Namespace) -> int:
    """Runs the grid, or lists what it would run."""
    return paper.run(args)
