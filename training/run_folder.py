"""The folder of a run: what lies where, written so that it is never half there.

config.json     what was asked for: enough to run it again
progress.csv    one row per chunk: env_steps, wall_s, episode_return_mean, ...
episodes.csv    one row per complete training episode, in order of completion
summary.json    the result
checkpoints/    to continue from
policy/         the trained policy, see `jaxrod.training.load_policy`

The command line draws learning_curve.png and replay.html beside them.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxrod._files import write_atomically

LEARNING_CURVE = "learning_curve.png"
REPLAY = "replay.html"
"""What the command line draws of a run."""


class Table:
    """A CSV file that grows by rows and can be cut back to a known length."""

    def __init__(self, path: Path) -> None:
        """Names the file; it need not exist."""
        self.path = path

    def append(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Adds rows; the first row of the file decides the columns."""
        rows = list(rows)
        if not rows:
            return
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if not self.path.exists():
            writer.writerow(rows[0])
        writer.writerows(row.values() for row in rows)
        with self.path.open("a") as stream:
            stream.write(text.getvalue())

    def read(self) -> list[dict[str, str]]:
        """Returns all rows, none if the file does not exist."""
        if not self.path.exists():
            return []
        with self.path.open(newline="") as stream:
            return list(csv.DictReader(stream))

    def cut(self, length: int) -> None:
        """Keeps the first `length` rows: what came later was not checkpointed."""
        if not self.path.exists():
            return
        lines = self.path.read_text().splitlines(keepends=True)
        write_atomically(self.path, "".join(lines[: length + 1]).encode())


class RunFolder:
    """The files of one run."""

    def __init__(self, path: str | Path) -> None:
        """Names the folder; it need not exist."""
        self.path = Path(path)
        self.progress = Table(self.path / "progress.csv")
        self.episodes = Table(self.path / "episodes.csv")
        self.checkpoints = self.path / "checkpoints"
        self.policy = self.path / "policy"

    @property
    def exists(self) -> bool:
        """Whether a run was started here."""
        return (self.path / "config.json").exists()

    @property
    def finished(self) -> bool:
        """Whether the run here came to its end."""
        if not (self.path / "summary.json").exists():
            return False
        return self.summary()["status"] == "finished"

    def config(self) -> dict[str, Any]:
        """Reads `config.json`.

        Raises:
            ValueError: there is no run in this folder.
        """
        return self._read("config.json")

    def summary(self) -> dict[str, Any]:
        """Reads `summary.json`.

        Raises:
            ValueError: there is no finished run in this folder.
        """
        return self._read("summary.json")

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Writes `config.json`, and the folder if it is missing."""
        self.path.mkdir(parents=True, exist_ok=True)
        self._write("config.json", config)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Writes `summary.json`."""
        self._write("summary.json", summary)

    def clear(self) -> None:
        """Removes the run and its pictures, and nothing else."""
        for name in ("config.json", "summary.json", LEARNING_CURVE, REPLAY):
            (self.path / name).unlink(missing_ok=True)
        for table in (self.progress, self.episodes):
            table.path.unlink(missing_ok=True)
        for folder in (self.checkpoints, self.policy):
            shutil.rmtree(folder, ignore_errors=True)

    def _read(self, name: str) -> dict[str, Any]:
        try:
            return json.loads((self.path / name).read_text())
        except FileNotFoundError as missing:
            raise ValueError(f"no {name} in {str(self.path)!r}") from missing

    def _write(self, name: str, content: Mapping[str, Any]) -> None:
        text = json.dumps(dict(content), indent=2, allow_nan=False) + "\n"
        write_atomically(self.path / name, text.encode())


def recorded(settings: Any) -> dict[str, Any]:
    """The settings of a learner, a dataclass, as `config.json` keeps them."""
    return {
        field.name: plain(getattr(settings, field.name))
        for field in dataclasses.fields(settings)
    }


def plain(value: Any) -> Any:
    """A value as JSON holds it; what JSON cannot hold stays what it is."""
    if isinstance(value, tuple):
        return [plain(one) for one in value]
    arrays = (jax.Array, np.ndarray, np.generic)
    return value.tolist() if isinstance(value, arrays) else value


def differences(
    stored: Mapping[str, Any], wanted: Mapping[str, Any], ignore: Sequence[str] = ()
) -> list[str]:
    """Says how two configurations differ, one phrase per entry."""
    found = []
    for name in sorted({*stored, *wanted} - set(ignore)):
        a, b = stored.get(name), wanted.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found += [f"{name}.{inner}" for inner in differences(a, b)]
        elif a != b:
            found.append(f"{name} was {a!r}, now {b!r}")
    return found
