"""Recordings of an arm: markers and inputs over time, from tables of numbers."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxrod.files import DamagedFileError, read_csv
from jaxrod.twin.arm import Arm

STILL = 1e-3
"""Largest movement of a marker of an arm at rest, as a fraction of the arm's length."""


@dataclass(frozen=True)
class Recording:
    """Markers of an arm and the inputs that moved it."""

    name: str
    times: Float[np.ndarray, " frames"]
    """Time of each frame [s], rising."""
    inputs: Float[np.ndarray, "frames inputs"]
    """Recorded inputs, in the order of `Arm.inputs`."""
    points: Float[np.ndarray, "frames markers 3"]
    """Places of the markers [m]; NaN where one was not seen."""
    labelled: bool = True
    """Whether the order of the markers is that of the arm's."""

    def __post_init__(self) -> None:
        """Checks the shapes.

        Raises:
            ValueError: If they do not fit, times do not rise, or an input is missing.
        """
        frames = len(self.times)
        if self.inputs.shape[:1] != (frames,) or self.inputs.ndim != 2:
            raise ValueError(
                f"{self.name}: inputs must have a row for each of {frames} times, got "
                f"shape {self.inputs.shape}"
            )
        if self.points.shape[:1] != (frames,) or self.points.shape[2:] != (3,):
            raise ValueError(
                f"{self.name}: points must have the shape (frames, markers, 3) with "
                f"{frames} frames, got {self.points.shape}"
            )
        if frames == 0 or not np.all(np.diff(self.times) > 0):
            raise ValueError(f"{self.name}: times must rise from each to the next")
        if not np.all(np.isfinite(self.inputs)):
            raise ValueError(f"{self.name}: an input is not finite")

    def is_at_rest(self, length: float) -> bool:
        """Whether inputs are constant and markers stay within their noise.

        Args:
            length: Length of the arm [m].
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # A marker never seen.
            low, high = np.nanpercentile(self.points, [5, 95], axis=0)
        moved = (high - low)[np.isfinite(high - low)]
        constant = bool(np.all(self.inputs == self.inputs[:1]))
        return constant and bool(np.all(moved < 10 * STILL * length))

    def averaged(self) -> Recording:
        """One frame: the median of each marker over all frames."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # A marker never seen.
            points = np.nanmedian(self.points, axis=0)[None]
        return replace(
            self, times=self.times[:1], inputs=self.inputs[:1], points=points
        )


def read_recording(path: str | Path, arm: Arm) -> Recording:
    """Reads a recording from a CSV file with a header.

    Columns are `time` [s], one for each of `Arm.inputs`, and `NAME_x`, `NAME_y`,
    `NAME_z` for each marker, in recorded units (`Frame.scale`). If the names are those
    of the arm's markers, they say which is which; otherwise there must be as many, and
    `register` finds out. Other columns are not read. An empty place, or `nan`, is a
    marker that was not seen.

    Raises:
        DamagedFileError: If the file is not such a table; with its name.
        OSError: If it cannot be opened.
    """
    file = Path(path)
    columns, rows = read_csv(file)
    numbers = {name: k for k, name in enumerate(columns)}
    names = [
        name[:-2]
        for name in columns
        if name.endswith("_x") and {name[:-2] + "_y", name[:-2] + "_z"} <= {*columns}
    ]
    wanted = [marker.name for marker in arm.markers]
    labelled = set(wanted) <= set(names)
    names = wanted if labelled else names
    try:
        for name in ("time", *arm.inputs):
            if name not in numbers:
                raise ValueError(f"it has no column {name!r}")
        if len(names) != len(wanted):
            raise ValueError(
                f"it has the markers {', '.join(names) or 'none'}, and the arm has "
                f"{', '.join(wanted)}: as many are needed"
            )
        table = _numbers(columns, rows)
        marked = [[numbers[f"{name}_{axis}"] for axis in "xyz"] for name in names]
        return Recording(
            name=file.stem,
            times=table[:, numbers["time"]],
            inputs=table[:, [numbers[name] for name in arm.inputs]],
            points=arm.frame.scale * table[:, np.array(marked)],
            labelled=labelled,
        )
    except ValueError as error:
        raise DamagedFileError(f"{file}: {error}") from error


def _numbers(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> np.ndarray:
    """All numbers of a table; NaN where there is none."""
    table = np.full((len(rows), len(columns)), np.nan)
    for r, row in enumerate(rows):
        for c, word in enumerate(row):
            try:
                table[r, c] = float(word) if word.strip() else np.nan
            except ValueError:
                table[r, c] = np.nan
    return table
