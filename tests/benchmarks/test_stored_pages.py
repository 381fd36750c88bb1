"""Pages that programs write are what these programs make of their records."""

import importlib
import re

import pytest

from benchmarks.first_order import page as first_order
from benchmarks.optimum import page as optimum
from benchmarks.optimum.run import SEED
from benchmarks.paper.cell_records import Records
from benchmarks.paper.report import report
from benchmarks.shared.files import ROOT
from jaxrod.files import read_json

BENCHMARKS = ROOT / "benchmarks"


def page_of(name):
    """What the program of a benchmark with one record makes of it."""
    program = importlib.import_module(f"benchmarks.{name}.run")
    return program.page(read_json(BENCHMARKS / name / "records" / f"{name}.json"))


def grid(name):
    """What `jaxrod reproduce` makes of the records of a grid."""
    return report(Records(BENCHMARKS / name / "records"))


PAGES = {
    "docs/clean_settings.md": lambda: page_of("clean_settings"),
    "docs/costs.md": lambda: page_of("costs"),
    "docs/environments.md": lambda: page_of("environments"),
    "docs/implicit.md": lambda: page_of("implicit"),
    "docs/first_order.md": lambda: first_order.text(first_order.recorded()),
    "docs/optimum.md": lambda: optimum.text(optimum.recorded(), SEED),
    "benchmarks/rod_steps/records/rod_steps.md": lambda: page_of("rod_steps"),
    "benchmarks/paper/records/results.md": lambda: grid("paper"),
    "benchmarks/clean/records/results.md": lambda: grid("clean"),
}
ELSEWHERE = {
    # tests/benchmarks/test_algorithms_page.py compares it.
    "docs/algorithms.md",
    # Its rows are the record: each test that runs asserts its own.
    "docs/validation.md",
    # Their tables need the reference of the run; tests/test_numbers.py compares
    # costs and ratios with tradeoff.csv.
    "benchmarks/tradeoff/records/rope/tradeoff.md",
    "benchmarks/tradeoff/records/slam/tradeoff.md",
    "benchmarks/tradeoff/records/swing/tradeoff.md",
    "benchmarks/tradeoff/records/tracking/tradeoff.md",
    # The page is the record: its program needs MuJoCo 4 in a Python of its own.
    "benchmarks/mujoco_rods/records/mujoco_rods.md",
}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_is_what_its_program_makes_of_the_record(page):
    assert PAGES[page]() == (ROOT / page).read_text()


def test_every_page_that_a_program_writes_is_compared():
    files = [*ROOT.glob("docs/*.md"), *BENCHMARKS.rglob("*.md")]
    written = {
        str(file.relative_to(ROOT))
        for file in files
        if re.search(r"^Written by `", file.read_text(), re.M)
    }
    assert written - set(PAGES) == ELSEWHERE
