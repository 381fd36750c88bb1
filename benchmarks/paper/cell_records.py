"""Files that a grid leaves to be committed: a record and a curve per cell, results.csv.

OUT/cells/CELL.json    how the cell was run, on what, and how it ended
OUT/curves/CELL.csv    its learning curve, thinned
OUT/results.csv        one row per cell that ended

A row of results.csv that has no record stays as it is. A cell that diverged, or ended
before an episode was complete, has the score nan, so that no mean over seeds can hide
it.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper.plan import Cell
from jaxrod.cli.sweeps.results import csv_of
from jaxrod.files import DamagedFileError, make_folder, read_json, write_atomically

COLUMNS = (
    "case",
    "algorithm",
    "variant",
    "seed",
    "env_steps",
    "final_score",
    "wall_s",
    "flagged_fraction",
)
CURVE = ("env_steps", "wall_s", "episode_return_mean")
POINTS = 200
"""Points of a curve that are kept."""

Record = dict[str, Any]


class Records:
    """The records of a grid in its folder."""

    def __init__(self, out: Path) -> None:
        """Reads what is there.

        Raises:
            ValueError: a record or results.csv is damaged.
        """
        from jaxrod.training.runs.folder import renamed

        self.out = out
        self._records: dict[str, Record] = {}
        for file in sorted((out / "cells").glob("*.json")):
            try:
                record = read_json(file)
                _row(record)
                self._records[file.stem] = {
                    **record,
                    "config": renamed(record["config"]),
                }
            except DamagedFileError:
                raise
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(f"{file} is damaged: {error!r}") from error
        self._stored_rows()

    def __iter__(self) -> Iterator[Record]:
        """All records, by name of the cell."""
        return iter(self._records.values())

    def get(self, cell: Cell) -> Record | None:
        """The record of a cell, None if it has not ended."""
        return self._records.get(cell.name)

    def curve(self, name: str) -> Path:
        """Path of the curve of a cell."""
        return self.out / "curves" / f"{name}.csv"

    def add(
        self, name: str, record: Record, progress: Sequence[Mapping[str, str]]
    ) -> None:
        """Keeps how a cell ended: its curve first, so that a record has one.

        Args:
            name: of the cell.
            record: has all of `COLUMNS`; the final score is None if it diverged.
            progress: the rows of its progress.csv.
        """
        for folder in ("cells", "curves"):
            make_folder(self.out / folder)
        rows = [{k: row[k] for k in CURVE} for row in thinned(progress)]
        write_atomically(self.curve(name), csv_of(CURVE, rows))
        text = json.dumps(record, indent=2, allow_nan=False) + "\n"
        write_atomically(self.out / "cells" / f"{name}.json", text.encode())
        self._records[name] = record
        self.write_results()

    def write_results(self) -> None:
        """Rewrites results.csv; the rows of cells without a record stay."""
        rows = self._stored_rows()
        for record in self:
            row = _row(record)
            rows[_key(row)] = row
        content = csv_of(COLUMNS, [rows[key] for key in sorted(rows)])
        write_atomically(self.out / "results.csv", content)

    def _stored_rows(self) -> dict[tuple[str, str, str, int], dict[str, str]]:
        file = self.out / "results.csv"
        if not file.exists():
            return {}
        with file.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise ValueError(
                    f"{file} must have the columns {', '.join(COLUMNS)}, "
                    f"got {', '.join(reader.fieldnames or ())}"
                )
            return {_key(row): row for row in reader}


def thinned(rows: Sequence[Any]) -> list[Any]:
    """At most `POINTS` of the rows, evenly spread, the last among them."""
    count = min(POINTS, len(rows))
    return [rows[(k + 1) * len(rows) // count - 1] for k in range(count)]


def _row(record: Record) -> dict[str, str]:
    """The row of results.csv."""
    row = {name: record[name] for name in COLUMNS}
    row["wall_s"] = round(row["wall_s"], 2)
    row["variant"] = row["variant"] or ""
    row["final_score"] = "nan" if row["final_score"] is None else row["final_score"]
    return {name: str(value) for name, value in row.items()}


def _key(row: Mapping[str, str]) -> tuple[str, str, str, int]:
    return row["case"], row["algorithm"], row["variant"], int(row["seed"])
