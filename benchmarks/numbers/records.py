"""Numbers out of records, and how pages write them."""

from __future__ import annotations

import csv
import itertools
import json
import math
import re
from statistics import fmean
from typing import Any

from benchmarks.numbers.quoting import WORDS
from benchmarks.shared.files import ROOT

CASES = {1: "tracking", 2: "reaching", 3: "structured", 4: "unstructured"}
LEARNERS = ("PPO", "TRPO", "SAC", "TD3", "DDPG")


def read(path: str) -> Any:
    """A JSON file of the checkout."""
    return json.loads((ROOT / path).read_text(encoding="utf-8"))


def rows(path: str, **where: str) -> list[dict[str, str]]:
    """Rows of a CSV file of the checkout that have these entries."""
    with (ROOT / path).open(newline="", encoding="utf-8") as stream:
        found = csv.DictReader(stream)
        return [r for r in found if all(r[key] == where[key] for key in where)]


def cells(path: str, *first: str) -> list[str]:
    """Cells of the first row of a page's tables that begins with these cells."""
    for line in (ROOT / path).read_text(encoding="utf-8").splitlines():
        found = [cell.strip() for cell in line.strip(" |").split("|")]
        if line.lstrip().startswith("|") and found[: len(first)] == list(first):
            return found
    raise ValueError(f"{path} has no row that begins with {' | '.join(first)}")


def numbers(text: str) -> list[str]:
    """All numbers of a text."""
    return re.findall(r"[-−]?\d[\d,]*(?:\.\d+)?", text)


def value(text: str) -> float:
    """A number as a page writes it."""
    return float(text.replace(",", "").replace("−", "-"))


def digits(number: float, count: int = 2) -> str:
    """A number of so many significant digits, without an exponent."""
    rounded = float(f"{number:.{count}g}")
    if abs(rounded) >= 10**count:
        return f"{rounded:,.0f}"
    return f"{number:#.{count}g}".rstrip(".")


def at_least(number: float, count: int = 2) -> float:
    """A number rounded down to so many significant digits."""
    unit = 10.0 ** (math.floor(math.log10(number)) + 1 - count)
    return math.floor(number / unit) * unit


def whole(number: float, to: int = 1) -> str:
    """A whole number, rounded to a multiple of `to`, with a real minus sign."""
    return f"{round(number / to) * to:,}".replace("-", "−")


def word(number: float) -> str:
    """A small number as a word."""
    return WORDS[round(number)]


def cheapest(path: str, simulator: str, error: float, batch: int = 1) -> dict[str, Any]:
    """The cheapest setting of a record of errors and costs with at most this error.

    Returns:
        Its number of elements, error, and cost [s per simulated second].
    """
    found = [
        {
            "n": int(row["n_elements"]),
            "error": float(row["error"]),
            "cost": float(row["wall_s_per_sim_s"]),
        }
        for row in rows(path, simulator=simulator)
        if int(row["batch"]) == batch and float(row["error"]) <= error
    ]
    return min(found, key=lambda row: row["cost"])


def mean(values: Any) -> float:
    """The mean of numbers."""
    return fmean(values)


def column(page: str, head: str, index: int) -> list[str]:
    """A column of the table of a page whose head begins with this."""
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    (begin,) = [n for n, line in enumerate(lines) if line.startswith(f"| {head}")]
    table = itertools.takewhile(lambda line: line.startswith("|"), lines[begin + 2 :])
    return [line.split("|")[index + 1].strip() for line in table]


def published(case: int, learner: str) -> dict[str, str]:
    """The paper's result of a cell."""
    (row,) = rows(
        "benchmarks/paper/published.csv",
        case=f"Case{case}",
        algorithm=learner,
        in_figure="1",
    )
    return row
