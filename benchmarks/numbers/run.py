"""Numbers that README and the pages quote, compared with the records.

Prints every sentence whose numbers are not those of its record, and fails if there is
one. `--write` writes the numbers of the records into the pages. Measures nothing.
"""

from __future__ import annotations

import argparse

from benchmarks.numbers.quotes import quotes
from benchmarks.numbers.quoting import differences, write
from benchmarks.shared.files import ROOT


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares whether to change the pages."""
    parser.add_argument(
        "--write", action="store_true", help="write the numbers into the pages"
    )


def run(args: argparse.Namespace) -> int:
    """Compares, and writes if asked."""
    every = quotes()
    if args.write:
        write(ROOT, every)
    found = differences(ROOT, every)
    for line in found:
        print(line)
    print(f"{len(every)} quotes, {len(found)} of them differ from their records")
    return 1 if found else 0
