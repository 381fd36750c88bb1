"""Programs that show why jaxrod rejects releases of JAX.

Each program runs in a separate process, because a faulty release may kill it. The
programs need JAX and NumPy, but not jaxrod. Run this with the Python of an environment
that has the release.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from benchmarks.shared.arguments import add_names

PROGRAMS = ("wrong_rows", "seven_axes", "slow_writes")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the programs."""
    add_names(parser, "programs", PROGRAMS, "PROGRAM")


def run(args: argparse.Namespace) -> int:
    """Runs the programs.

    Returns:
        0, or 1 if one was killed or failed.
    """
    failed = False
    for name in args.programs:
        file = Path(__file__).with_name(f"{name}.py")
        code = subprocess.run([sys.executable, str(file)]).returncode
        if code:
            print(f"{name}: exit status {code}")
            failed = True
    return int(failed)
