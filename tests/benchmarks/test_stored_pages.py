"""Pages that programs write are what these programs make of their records."""

import csv
import importlib
import re

import pytest

from benchmarks.first_order import page as first_order
from benchmarks.optimum import page as optimum
from benchmarks.optimum.run import SEED
from benchmarks.paper.cell_records import Records
from benchmarks.paper.report import report
from benchmarks.randomised import run as randomised
from benchmarks.shared.files import ROOT
from jaxrod.files import read_json

BENCHMARKS = ROOT / "benchmarks"


def page_of(name):
    """Page that the program of a benchmark writes from its only record."""
    program = importlib.import_module(f"benchmarks.{name}.run")
    return program.page(read_json(BENCHMARKS / name / "records" / f"{name}.json"))


def grid(name):
    """Page that `jaxrod reproduce` writes from the records of a grid."""
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
    # They also state the error of the reference and the times of the chosen setting,
    # which tradeoff.csv does not have. A test below compares the rest.
    "benchmarks/tradeoff/records/rope/tradeoff.md",
    "benchmarks/tradeoff/records/slam/tradeoff.md",
    "benchmarks/tradeoff/records/swing/tradeoff.md",
    "benchmarks/tradeoff/records/tracking/tradeoff.md",
    # The page is the record: its program needs MuJoCo 4 in a Python of its own.
    "benchmarks/mujoco_rods/records/mujoco_rods.md",
}


def test_the_table_of_randomised_tasks_is_that_of_the_records():
    page = (ROOT / "docs" / "randomisation.md").read_text()
    assert "\n".join([randomised.HEAD, *randomised.rows(), ""]) in page


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


@pytest.mark.parametrize("scene", ["rope", "slam", "swing", "tracking"])
def test_other_simulators_have_the_costs_of_the_record(scene):
    """In the table, each has its cheapest run within 1 %, or else its best run."""
    folder = BENCHMARKS / "tradeoff" / "records" / scene
    with (folder / "tradeoff.csv").open(newline="") as stream:
        runs = list(csv.DictReader(stream))
    names = {"PyElastica": "pyelastica", "MuJoCo's cable": "mujoco"}
    compared = 0
    for line in (folder / "tradeoff.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) < 7 or cells[1] not in names:
            continue
        theirs = [
            (float(run["error"]), float(run["wall_s_per_sim_s"]), run["n_elements"])
            for run in runs
            if (run["simulator"], run["batch"]) == (names[cells[1]], cells[0])
        ]
        good = [run for run in theirs if run[0] <= 0.01]
        assert (">" in cells[6]) == (not good)
        best = min(good, key=lambda run: run[1]) if good else min(theirs)
        error, cost, elements = best
        assert [cells[2], cells[4], cells[5]] == [
            elements,
            f"{error:.2g}",
            f"{cost:.2g}",
        ]
        compared += 1
    assert compared == {"rope": 6, "slam": 0, "swing": 6, "tracking": 3}[scene]
