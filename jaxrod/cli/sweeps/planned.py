"""The properties of a run that are known before it is trained."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from jaxrod.training import RunFolder
from jaxrod.training.runs.folder import differences

_UNASKED = ("score_window",)
"""Entries that follow from the task and are not part of the request."""


class Planned(Protocol):
    """A planned run."""

    @property
    def name(self) -> str:
        """Name of its folder."""

    @property
    def steps(self) -> int:
        """Number of control steps."""

    @property
    def config(self) -> dict[str, Any]:
        """Configuration that determines the result, as in `config.json`."""

    @property
    def beside(self) -> str:
        """Text to show after its score, with a separator; empty for none."""

    def command(self, out: Path) -> list[str]:
        """Words of the command that trains it, after `jaxrod`."""


def differs(
    planned: Planned, folder: RunFolder, stored: Mapping[str, Any] | None = None
) -> list[str]:
    """Differences between a started run and its plan, one phrase per entry.

    Args:
        planned: The planned run.
        folder: Folder in which it was started, if it was.
        stored: Its configuration, if it is not to be read from the folder.
    """
    if stored is None:
        stored = folder.config() if folder.exists else planned.config
    return differences(stored, planned.config, _UNASKED)
