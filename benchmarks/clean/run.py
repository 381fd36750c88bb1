"""Cases 3 and 4 of the published grid in the library's own physics.

`jaxrod reproduce` with the variant `clean` of both, SAC and TD3 and five seeds, by
default. Writes into benchmarks/clean/records what `paper` writes into its records.
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
    """Runs the grid, or says what it would run."""
    return paper.run(args)
