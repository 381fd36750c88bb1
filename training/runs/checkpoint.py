"""Checkpoints: a train state and a few facts, written completely or not at all.

Each checkpoint is one `.npz` file, without pickle. It has an array for every leaf,
under the leaf's path in the state, and JSON text with the facts and a description of
the leaves. The file gets its final name only once it is on the disk, and every array
has a checksum, because a process may be killed, and a disk may fail, at any moment.

The arrays do not depend on the number of devices, so a run may continue on another
number (its results are then equal up to round-off).
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxrod.files import (
    OBJECT,
    check_entries,
    make_folder,
    parse_json,
    reading,
    whole,
    write_atomically,
)
from jaxrod.training.leaves import (
    described,
    differences_of_leaves,
    from_array,
    named_leaves,
    to_array,
    with_leaves,
)

NAMES = r"[0-9]{10}\.npz"
"""Regular expression for the names of checkpoint files: the number, in 10 digits."""

FORMAT = 1
"""Version of the file format, increased when the meaning of a file changes."""

_ABOUT, _STATE = "about", "state"


class Checkpoints:
    """The newest checkpoints of a run, in one folder."""

    def __init__(self, folder: Path, keep: int = 2) -> None:
        """Sets the folder.

        Args:
            folder: Folder of the checkpoints; created with the first one if missing.
            keep: Number of checkpoints to keep.
        """
        self.folder, self._keep = folder, keep
        self._latest: int | None = None

    def path(self, step: int) -> Path:
        """Path of the checkpoint with number `step`."""
        return self.folder / f"{step:010d}.npz"

    def steps(self) -> list[int]:
        """Numbers of the existing checkpoints, newest first."""
        if not self.folder.is_dir():
            return []
        names = (file.name for file in self.folder.iterdir() if file.is_file())
        found = (int(name[:10]) for name in names if re.fullmatch(NAMES, name))
        return sorted(found, reverse=True)

    def save(self, step: int, state: Any, facts: dict[str, Any]) -> None:
        """Writes a checkpoint and removes the oldest ones.

        Args:
            step: Number of the checkpoint, which increases during the run. Nothing is
                written if this was the last number to be saved or restored.
            state: The train state.
            facts: Further facts to store; anything JSON can hold.

        Raises:
            OSError: The file cannot be written; the message names it.
        """
        if step == self._latest:
            return
        leaves = named_leaves(state, _STATE)
        about = {
            "format": FORMAT,
            "step": step,
            "facts": facts,
            "leaves": {name: described(leaf) for name, leaf in leaves.items()},
        }
        arrays = {name: to_array(leaf) for name, leaf in leaves.items()}
        arrays[_ABOUT] = np.array(json.dumps(about, allow_nan=False))
        make_folder(self.folder)
        write_atomically(
            self.path(step),
            lambda file: np.savez(file, allow_pickle=False, **arrays),
        )
        self._latest = step
        # Later checkpoints remain from a run that was resumed from an earlier one.
        for old in [one for one in self.steps() if one <= step][self._keep :]:
            self.path(old).unlink()

    def restore(
        self,
        template: Any,
        step: int | None = None,
        check: Callable[[dict[str, Any]], None] = lambda facts: None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reads a checkpoint.

        Args:
            template: A train state of the same structure and shapes.
            step: Number of the checkpoint, None for the newest.
            check: Function of the facts that raises if they are not as expected; called
                before the state is restored.

        Returns:
            The state, in host memory, and the facts.

        Raises:
            ValueError: There is no checkpoint, or its leaves do not fit the template.
            jaxrod.files.DamagedFileError: The file is damaged.
        """
        step = next(iter(self.steps()), None) if step is None else step
        if step is None:
            raise ValueError(f"no checkpoint in {str(self.folder)!r}")
        file = self.path(step)
        about, arrays = _read(file)
        if about["step"] != step:
            raise ValueError(f"{file} is checkpoint {about['step']}, renamed")
        check(about["facts"])
        leaves = named_leaves(template, _STATE)
        _check_structure(file, leaves, about["leaves"])
        with reading(file):
            restored = {
                name: from_array(arrays[name], leaf) for name, leaf in leaves.items()
            }
        self._latest = step
        return with_leaves(template, _STATE, restored), about["facts"]


def _read(file: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Description and arrays of a checkpoint file, with verified checksums."""
    with reading(file):
        if not zipfile.is_zipfile(file):
            raise ValueError("it is torn")
        with np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        about = parse_json(str(arrays.pop(_ABOUT)[()]))
        if about.get("format") != FORMAT:
            raise ValueError(f"it is not of format {FORMAT}")
        check_entries(about, {"step": whole(0), "facts": OBJECT, "leaves": OBJECT})
        if set(about["leaves"]) != set(arrays):
            raise ValueError("it does not hold the arrays that it names")
    return about, arrays


def _check_structure(file: Path, leaves: dict[str, Any], found: dict[str, str]) -> None:
    """Raises ValueError unless the stored leaves fit the train state.

    `leaves` are those of the state, by name, and `found` has the descriptions of those
    in the file.
    """
    wanted = {name: described(leaf) for name, leaf in leaves.items()}
    apart = differences_of_leaves(wanted, found)
    if apart:
        raise ValueError(f"checkpoint {file} {apart}")
