"""Runs a benchmark: `python -m benchmarks NAME [arguments]`.

Nothing but the standard library is imported before the benchmark itself, so that a
Python without jaxrod can run `jax_faults`.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).parent
COMMAND = "python -m benchmarks"


def names() -> list[str]:
    """Names of all benchmarks: folders with a program `run.py`."""
    return sorted(program.parent.name for program in FOLDER.glob("*/run.py"))


def title(name: str) -> str:
    """First line of the docstring of a benchmark's program."""
    tree = ast.parse((FOLDER / name / "run.py").read_text(encoding="utf-8"))
    return (ast.get_docstring(tree) or "").partition("\n")[0]


def parser_of(name: str) -> argparse.ArgumentParser:
    """The arguments of a benchmark; `run` of what they parse to runs it."""
    program = importlib.import_module(f"benchmarks.{name}.run")
    parser = argparse.ArgumentParser(
        prog=f"{COMMAND} {name}",
        description=program.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=program.run)
    program.add_arguments(parser)
    return parser


def main(words: Sequence[str]) -> int:
    """Lists the benchmarks, or runs one.

    Args:
        words: A name and its arguments, or nothing.

    Returns:
        The exit code: 2 if there is no such benchmark.
    """
    known = names()
    if not words or words[0] in ("-h", "--help"):
        print(f"usage: {COMMAND} NAME [arguments], {COMMAND} NAME --help\n")
        width = max(map(len, known))
        for name in known:
            print(f"  {name:<{width}}  {title(name)}")
        return 0
    name, *rest = words
    if name not in known:
        (nearest,) = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
        print(
            f"{COMMAND}: there is no benchmark {name!r}; the nearest name is "
            f"{nearest!r}, and `{COMMAND}` lists all",
            file=sys.stderr,
        )
        return 2
    # Times of first calls are those of programs that have to be compiled.
    os.environ.setdefault("JAXROD_CACHE", "0")
    args = parser_of(name).parse_args(rest)
    return int(args.run(args))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
