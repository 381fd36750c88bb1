"""Arguments that benchmarks share; those that need no jaxrod use them too."""

from __future__ import annotations

import argparse
from collections.abc import Iterable


def add_pages_only(parser: argparse.ArgumentParser) -> None:
    """Declares `--pages`, with which nothing is measured."""
    parser.add_argument(
        "--pages", action="store_true", help="write the page from the record"
    )


def add_names(
    parser: argparse.ArgumentParser,
    what: str,
    known: Iterable[str],
    metavar: str,
    default: Iterable[str] | None = None,
) -> None:
    """Adds an argument of any number of names.

    Args:
        parser: The parser.
        what: Name of the argument.
        known: All names.
        metavar: A name in the usage.
        default: The names if none is given; all if None.
    """
    names = list(known)
    usual = names if default is None else list(default)

    def name(word: str) -> str:
        if word not in names:
            raise argparse.ArgumentTypeError(f"{word!r} is none of {', '.join(names)}")
        return word

    words = "all" if default is None else ", ".join(usual)
    parser.add_argument(
        what,
        nargs="*",
        type=name,
        default=usual,
        metavar=metavar,
        help=f"{', '.join(names)} (default: {words})",
    )
