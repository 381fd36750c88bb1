"""The folder of a run: its files, each written completely or not at all.

config.json     the request: task, algorithm, settings, seed; marks the folder
progress.csv    one row per chunk: env_steps, wall_s, episode_return_mean, ...
episodes.csv    one row per complete training episode, in order of completion
summary.json    the result
checkpoints/    states to resume from, see `jaxrod.training.runs.checkpoint`
policy/         the trained policy, see `jaxrod.training.load_policy`
tensorboard/    the rows of progress.csv as an event file, if requested

The command line also draws learning_curve.png and replay.html there. While a process
trains in the folder it holds a lock, see `jaxrod.training.runs.owned_folder`. Other
files in the folder are never changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrod.files import (
    NUMBER,
    OBJECT,
    TEXT,
    check_entries,
    one_of,
    optional,
    read_json,
    reading,
    whole,
    write_atomically,
)
from jaxrod.training.runs import checkpoint, event_file
from jaxrod.training.runs.owned_folder import CONFIG, OwnedFolder, as_json
from jaxrod.training.runs.table import Table
from jaxrod.validation import LARGEST_SEED

SUMMARY = "summary.json"
LEARNING_CURVE = "learning_curve.png"
REPLAY = "replay.html"
"""Name of the page with a replay of one episode, which the command line draws."""

_CONFIG_KINDS = {
    "task": TEXT,
    "env_options": optional(OBJECT),
    "algorithm": TEXT,
    "steps": whole(1),
    "seed": whole(0, LARGEST_SEED),
    "settings": OBJECT,
}
_CONFIG_MAY_LACK = {
    "variant": optional(TEXT),
    "score_window": whole(1),
    "environment": TEXT,
}
_SUMMARY_KINDS = {
    "status": one_of("finished", "interrupted"),
    "final_score": optional(NUMBER),
    "env_steps": whole(0),
    "wall_s": NUMBER,
    "steps_per_s": NUMBER,
    "episodes": whole(0),
    "flagged_fraction": NUMBER,
    "score_window": whole(1),
}
_SUMMARY_MAY_LACK = {
    "first_score": optional(NUMBER),
    "evaluation_score": NUMBER,
    "evaluation_std": NUMBER,
    "evaluation_episodes": whole(1),
}


_MOVED = "jaxrod.envs.action_repeat: ", "jaxrod.envs.wrappers: "
"""Module of environment wrappers as recorded by older versions and by this one."""


class RunFolder(OwnedFolder):
    """Paths and contents of the files of one run.

    Example:
        >>> run = training.RunFolder("runs/first")
        >>> run.finished, run.summary_file.name
        (False, 'summary.json')
    """

    def __init__(self, path: str | Path) -> None:
        """Sets the path of the folder, which need not exist.

        Raises:
            ValueError: `path` is empty.
        """
        super().__init__(
            path,
            "training run",
            (SUMMARY, "progress.csv", "episodes.csv", LEARNING_CURVE, REPLAY),
            {
                "checkpoints": checkpoint.NAMES,
                "policy": r"policy\.(json|npz)",
                "tensorboard": event_file.NAMES,
            },
        )
        self.progress = Table(self.path / "progress.csv")
        self.episodes = Table(self.path / "episodes.csv")
        self.summary_file = self.path / SUMMARY
        self.checkpoints = self.path / "checkpoints"
        self.policy = self.path / "policy"
        self.tensorboard = self.path / "tensorboard"

    @property
    def finished(self) -> bool:
        """Whether the run in this folder has finished.

        Example:
            >>> training.RunFolder("runs/nothing").finished
            False
        """
        if not self.summary_file.exists():
            return False
        return self.summary()["status"] == "finished"

    def config(self) -> dict[str, Any]:
        """Reads `config.json`.

        Raises:
            ValueError: There is no run in this folder, or the file is damaged.
        """
        content = renamed(self.stored())
        with reading(self.path / CONFIG):
            check_entries(content, _CONFIG_KINDS, _CONFIG_MAY_LACK)
        return content

    def summary(self) -> dict[str, Any]:
        """Reads `summary.json`.

        Raises:
            ValueError: There is no `summary.json`, because no run has ended in this
                folder, or the file is damaged.
        """
        file = self.summary_file
        try:
            content = read_json(file)
        except FileNotFoundError:
            raise ValueError(f"no {SUMMARY} in {str(self.path)!r}") from None
        with reading(file):
            check_entries(content, _SUMMARY_KINDS, _SUMMARY_MAY_LACK)
        return content

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Writes `summary.json`."""
        write_atomically(self.summary_file, as_json(SUMMARY, summary))


def renamed(config: Mapping[str, Any]) -> dict[str, Any]:
    """Converts a `config.json` of any version to the entry names of this version.

    Older versions called the task `case`. In the description of an environment that
    `make` had not made, they also recorded an older module name.
    """
    today = {"task" if name == "case" else name: config[name] for name in config}
    words = today.get("environment")
    if isinstance(words, str):
        today["environment"] = words.replace(*_MOVED, 1)
    return today


def differences(
    stored: Mapping[str, Any], wanted: Mapping[str, Any], ignore: Sequence[str] = ()
) -> list[str]:
    """Differences of two configurations, one phrase per entry that differs.

    Args:
        stored: The earlier configuration.
        wanted: The present configuration.
        ignore: Names of entries that may differ.
    """
    found = []
    for name in sorted({*stored, *wanted} - set(ignore)):
        a, b = stored.get(name), wanted.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found += [f"{name}.{inner}" for inner in differences(a, b)]
        elif a != b:
            found.append(f"{name} was {a!r}, now {b!r}")
    return found
