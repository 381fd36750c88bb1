"""Results of a sweep: the table results.csv, and a picture of curves per task."""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrod.cli.sweeps.plan import SweepRun
from jaxrod.cli.sweeps.running import last_row
from jaxrod.files import write_atomically
from jaxrod.training import RunFolder
from jaxrod.viz.curves import grid_curves

_MEASURED = (
    "state",
    "env_steps",
    "final_score",
    "evaluation_score",
    "wall_s",
    "flagged_fraction",
)


class Results:
    """Table of a sweep: for every run a row with its settings and results.

    The column `state` is `finished`, `failed` (in this call; `error` gives the reason),
    `unfinished` or `waiting`. A missing score is nan, so that no mean can hide it.
    """

    def __init__(self, runs: Sequence[SweepRun], out: Path) -> None:
        """Reads the run folders.

        Args:
            runs: All runs of the sweep.
            out: Folder of the sweep, which holds the run folders.

        Raises:
            ValueError: A file in a run folder is damaged.
        """
        self._runs, self._out = list(runs), out
        self._settings = sorted({name for run in runs for name in run.chosen})
        self._rows = {run.name: self._row(run, "") for run in runs}

    @property
    def rows(self) -> list[dict[str, Any]]:
        """All rows, in the order of the runs."""
        return list(self._rows.values())

    def update(self, run: SweepRun, error: str = "") -> dict[str, Any]:
        """Reads the folder of a run again and writes results.csv; returns the row.

        `error` is the reason why the run failed; empty if it did not.
        """
        self._rows[run.name] = self._row(run, error)
        self.write()
        return self._rows[run.name]

    def write(self) -> None:
        """Writes results.csv."""
        rows = [{k: str(v) for k, v in row.items()} for row in self.rows]
        write_atomically(self._out / "results.csv", csv_of(list(rows[0]), rows))

    def draw(self) -> list[Path]:
        """Draws learning curves of the finished runs: means and spreads over seeds.

        Nothing is drawn without matplotlib.

        Returns:
            Paths of the pictures, one per task and variant.
        """
        subjects: dict[str, dict[str, list[Path]]] = defaultdict(
            lambda: defaultdict(list)
        )
        for run in self._runs:
            row = self._rows[run.name]
            if row["state"] == "finished" and not math.isnan(row["final_score"]):
                file = RunFolder(self._out / run.name).progress.path
                subjects[run.subject][run.group].append(file)
        drawn = []
        for subject, groups in subjects.items():
            file = self._out / f"{subject}.png"
            try:
                grid_curves(groups, {}, file, title=subject)
            except ModuleNotFoundError as missing:
                if missing.name != "matplotlib":
                    raise
            else:
                drawn.append(file)
        return drawn

    def _row(self, run: SweepRun, error: str) -> dict[str, Any]:
        folder = RunFolder(self._out / run.name)
        found: Mapping[str, Any] = {}
        if folder.exists and folder.finished:
            state, found = "finished", folder.summary()
        elif folder.exists:
            state, found = "unfinished", last_row(folder) or {}
        else:
            state = "waiting"
        measured = {name: found.get(name, "") for name in _MEASURED}
        for name in ("final_score", "evaluation_score"):
            measured[name] = math.nan if found.get(name) is None else found[name]
        return {
            "run": run.name,
            "task": run.task,
            "variant": run.variant or "",
            "algorithm": run.algorithm,
            **{name: run.chosen.get(name, "") for name in self._settings},
            "seed": run.seed,
            "steps": run.steps,
            **measured,
            "state": "failed" if error else state,
            "error": error,
        }


def csv_of(columns: Sequence[str], rows: Sequence[Mapping[str, str]]) -> bytes:
    """Rows as the bytes of a CSV file."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
