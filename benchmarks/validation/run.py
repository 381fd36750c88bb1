"""Values that the tests measured, and their limits: docs/validation.md.

Runs the tests of the physics and those against PyElastica, and tabulates the values
that they record. The table therefore has only values that a test asserts.

  python -m benchmarks validation                   all tests, with the slow ones
  python -m benchmarks validation -- -m "not slow"  takes some ten minutes
  python -m benchmarks validation --from a.xml      reads a run with --junitxml=a.xml
  python -m benchmarks validation --update a.xml    changes only the sections in a.xml

With `--update`, sections without rows in these runs do not change. Test files of the
same name in two folders share a section, so run them together.
"""

from __future__ import annotations

import argparse
import ast
import os
import platform
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree import ElementTree

import jax
import pytest

from benchmarks.shared.files import ROOT
from jaxrod.files import write_atomically

FOLDERS = (
    "tests/physics",
    "tests/extremes",
    "tests/systems",
    "tests/pyelastica",
    "tests/benchmarks/test_clean_settings.py",
    "tests/envs/test_clean_obstacles.py",
)
HEADER = """\
# Validation

Written by `python -m benchmarks validation` from runs of the tests; do not edit.
{outcome}

A test asserts every row. If the feature is not a ratio, an order or a count, the
measured value is the difference from the reference. The difference is relative if the
row gives no unit. `[lengths]` means lengths of the rod, and `n` is the number of
elements. Unless a row says otherwise, programs compute in float64 on one CPU core. "The
arm" is 1 m long and 5 cm in radius, with a Young's modulus of 10 MPa and a density of
1000 kg/m^3.

Measured on {machine} with {software}.
"""
COLUMNS = ("Feature", "Reference", "Measured", "Limit")


class Rows:
    """A pytest plugin that collects what the fixture `record` recorded."""

    def __init__(self) -> None:
        """Starts empty."""
        self.rows: dict[str, list[tuple[str, ...]]] = {}
        self.passed = 0
        self.failed: list[str] = []
        self.read_from_files = False
        self.kept: dict[str, str] = {}
        """Text of sections of earlier runs, by title."""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Takes the rows of one test."""
        if report.failed:
            self.failed.append(report.nodeid)
        if report.when != "call":
            return
        self.passed += report.passed
        section = Path(report.nodeid.split("::")[0]).stem
        for name, value in report.user_properties:
            if name == "validation":
                self.add(section, value)

    def add(self, section: str, value: tuple[str, str, float, str]) -> None:
        """Takes one row."""
        feature, reference, measured, bar = value
        row = (feature, reference, f"{measured:.3g}", bar)
        self.rows.setdefault(section, []).append(row)

    def text(self) -> Iterator[str]:
        """The document, line by line."""
        outcome = f"All {self.passed} tests passed."
        if self.failed:
            outcome = f"**{len(self.failed)} tests failed**: {', '.join(self.failed)}."
        if self.kept:
            new = {title_of(section) for section in self.rows}
            earlier = set(in_order(self.kept)) - new
            outcome += f" Sections of earlier runs: {len(earlier)}."
        python = ".".join(platform.python_version_tuple()[:2])
        here = f"Python {python} and JAX {jax.__version__}"
        # What is read from files may have run elsewhere.
        software = "the releases of constraints.txt"
        yield HEADER.format(
            outcome=outcome,
            machine=f"{platform.system()} on {platform.machine()}",
            software=software if self.read_from_files else here,
        )
        made = {title_of(section): rows for section, rows in self.rows.items()}
        left = {title: text for title, text in self.kept.items() if title not in made}
        for title in in_order(made.keys() | left.keys()):
            yield f"## {title}\n"
            if title in left:
                yield left[title]
                continue
            yield f"| {' | '.join(COLUMNS)} |"
            yield "|---|---|---:|---:|"
            yield from (f"| {' | '.join(row)} |" for row in made[title])
            yield ""

    def read(self, runs: Iterable[Path]) -> None:
        """Takes the rows of finished runs from their JUnit XML files.

        In the order of the code, whichever ran first: workers of a parallel run end
        their tests in any.

        Raises:
            ValueError: none of the tests is in them.
        """
        self.read_from_files = True
        found = [
            (*place, case)
            for run in runs
            for case in ElementTree.parse(run).iter("testcase")
            if (place := place_of(case)) is not None
        ]
        if not found:
            raise ValueError(f"no test of {', '.join(FOLDERS)} in these files")
        for _, file, _, case in sorted(found, key=lambda one: one[:3]):
            if case.find("failure") is not None or case.find("error") is not None:
                self.failed.append(f"{file}::{case.get('name')}")
                continue
            self.passed += case.find("skipped") is None
            for recorded in case.iter("property"):
                if recorded.get("name") == "validation":
                    value = ast.literal_eval(recorded.get("value", ""))
                    self.add(Path(file).stem, value)


def title_of(section: str) -> str:
    """The title of a test file's section, by the file's name."""
    words = section.removeprefix("test_").replace("_", " ")
    title = words.replace("side by side", "beside PyElastica")
    return title[0].upper() + title[1:]


def in_order(titles: Iterable[str]) -> list[str]:
    """Titles in the order of the test files; those of deleted files are left out."""
    files = [
        file
        for folder in FOLDERS
        for file in sorted([ROOT / folder, *(ROOT / folder).glob("test_*.py")])
        if file.suffix == ".py"
    ]
    known = dict.fromkeys(title_of(file.stem) for file in files)
    return [title for title in known if title in set(titles)]


def sections(document: str) -> dict[str, str]:
    """The text below each title of a document."""
    _, *found = document.split("\n## ")
    parted = (section.partition("\n\n") for section in found)
    return {title: text.rstrip("\n") + "\n" for title, _, text in parted}


def place_of(case: ElementTree.Element) -> tuple[int, str, int] | None:
    """Folder, file and line of a test in a JUnit XML file; None if it is not ours."""
    file = case.get("file", "")
    for i, folder in enumerate(FOLDERS):
        if file == folder or file.startswith(f"{folder}/"):
            return i, file, int(case.get("line", 0))
    return None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares pytest's words, or runs that have ended."""
    parser.add_argument("words", nargs="*", metavar="WORD", help="for pytest, after --")
    ended = parser.add_mutually_exclusive_group()
    for flag, words in (("--from", "of all"), ("--update", "of their own files")):
        ended.add_argument(
            flag,
            dest=flag.strip("-") + "_runs",
            nargs="+",
            type=Path,
            default=[],
            metavar="XML",
            help=f"JUnit XML of runs that have ended: write the sections {words}",
        )


def run(args: argparse.Namespace) -> int:
    """Runs the tests, or reads runs of them, and writes the document.

    Returns:
        pytest's exit code, or 1 if a test of the given run had failed.
    """
    rows, target = Rows(), ROOT / "docs" / "validation.md"
    if runs := args.from_runs + args.update_runs:
        if args.update_runs:
            rows.kept = sections(target.read_text())
        rows.read(runs)
        code = int(bool(rows.failed))
    else:
        os.chdir(ROOT)
        words = [*FOLDERS, "-q", "-p", "no:xdist", *args.words]
        code = int(pytest.main(words, plugins=[rows]))
    if not rows.passed:
        print("docs/validation.md is left as it is: no test passed", file=sys.stderr)
        return code or 1
    target.parent.mkdir(exist_ok=True)
    write_atomically(target, "\n".join(rows.text()).encode())
    return code
