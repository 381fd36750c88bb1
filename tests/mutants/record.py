"""The record of planted faults: a page that is also what a later run goes on from."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

HEAD = "| fault | place | change | outcome | by |"


@dataclass(frozen=True)
class Row:
    """One fault and what came of it."""

    name: str
    place: str
    change: str
    outcome: str
    """killed, survived or equivalent."""
    by: str
    """The test that killed it, or why nothing could or did."""


def read(path: Path) -> list[Row]:
    """The rows of a record; none where there is no file."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if line.startswith("| ") and len(cells) == 5 and cells[0][1:].isdigit():
            rows.append(Row(*cells))
    return rows


def counts(rows: list[Row]) -> str:
    """A sentence with the number of killed ones."""
    killed = sum(row.outcome == "killed" for row in rows)
    same = sum(row.outcome == "equivalent" for row in rows)
    share = f"{100 * killed / (len(rows) - same):.0f} %" if len(rows) > same else "none"
    return (
        f"{len(rows)} run: {killed} killed, {len(rows) - killed - same} survived, "
        f"{same} equivalent. Killed of those that are not equivalent: {share}."
    )


def write(path: Path, rows: list[Row], seed: int, wanted: int) -> None:
    """Writes a record whole, or not at all."""
    rows = sorted(rows, key=lambda row: row.name)
    named = [row for row in rows if row.name.startswith("m")]
    drawn = [row for row in rows if row.name.startswith("d")]
    lines = [
        "# Planted faults",
        "",
        "`python -m tests.mutants` plants faults one by one in a copy of the tree and",
        "runs the fast tests that could see them. That program makes this page;",
        "`--resume` goes on from it.",
        "",
        "## By name",
        "",
        counts(named),
        "",
        *_table(named),
        "",
        "## Drawn",
        "",
        f"Seed {seed}, {wanted} drawn over all rooms. {counts(drawn)}",
        "",
        *_table(drawn),
    ]
    part = path.with_suffix(".part")
    part.write_text("\n".join(lines) + "\n")
    os.replace(part, path)


def _table(rows: list[Row]) -> list[str]:
    lines = [HEAD, "|---|---|---|---|---|"]
    for row in rows:
        cells = (row.name, row.place, row.change, row.outcome, row.by)
        lines.append(f"| {' | '.join(cells)} |")
    return lines
