"""What is known of a run before it is trained."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from jaxrod.training import RunFolder
from jaxrod.training.runs.folder import differences

_UNASKED = ("score_window",)
"""What follows from the task, and is no part of what was asked for."""


class Planned(Protocol):
    """A run as it is planned."""

    @property
    def name(self) -> str:
        """Name of its folder."""

    @property
    def steps(self) -> int:
        """Control steps."""

    @property
    def config(self) -> dict[str, Any]:
        """What decides how it ends, as in `config.json`."""

    @property
    def beside(self) -> str:
        """What its score is shown beside, after a separator; empty for nothing."""

    def command(self, out: Path) -> list[str]:
        """The words that run it, after `jaxrod`."""


def differs(
    planned: Planned, folder: RunFolder, stored: Mapping[str, Any] | None = None
) -> list[str]:
    """How a run that was begun differs from what is planned, one phrase per entry.

    Args:
        planned: The run.
        folder: Where it was begun, if it was.
        stored: Its configuration, if that of the folder is not to be read.
    """
    if stored is None:
        stored = folder.config() if folder.exists else planned.config
    return differences(stored, planned.config, _UNASKED)
