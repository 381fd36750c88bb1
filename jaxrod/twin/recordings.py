"""Recordings of an arm: markers and inputs over time, read from CSV files or bags."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxrod.files import DamagedFileError, read_csv, reading
from jaxrod.twin.arm import Arm
from jaxrod.twin.bags import is_bag, read_columns

STILL = 2e-3
"""An arm counts as at rest if no coordinate of a marker has a larger standard deviation
over time, after its noise is subtracted; divided by the arm's length [1]."""
FEW = 30
"""Number of frames below which noise cannot be separated from movement."""
DOUBT = 3.0
"""Number of standard deviations of the estimated noise variance that are subtracted
before a variance counts as movement [1]."""
LOUDEST = 2e-2
"""Largest distance between the quartiles of a coordinate at rest, including noise,
divided by the arm's length [1]. A larger one is a movement faster than the frame
rate."""


@dataclass(frozen=True)
class Recording:
    """Positions of an arm's markers over time, and the inputs that moved the arm.

    Example:
        >>> times, points = np.linspace(0.0, 1.0, 11), np.zeros((11, 2, 3))
        >>> pose = twin.Recording("pose", times, np.ones((11, 1)), points)
        >>> pose.is_at_rest(length=0.3), pose.averaged().points.shape
        (True, (1, 2, 3))
    """

    name: str
    times: Float[np.ndarray, " frames"]
    """Time of each frame [s], rising."""
    inputs: Float[np.ndarray, "frames inputs"]
    """Recorded inputs, in the order of `Arm.inputs`."""
    points: Float[np.ndarray, "frames markers 3"]
    """Positions of the markers [m]; NaN where a marker was not seen."""
    labelled: bool = True
    """Whether the markers are in the order of `Arm.markers`; if not, their order is
    not known."""

    def __post_init__(self) -> None:
        """Validates shapes, times and inputs.

        Raises:
            ValueError: If shapes do not match, times do not rise, or an input is not
                finite.
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
            raise ValueError(f"{self.name}: times must increase")
        if not np.all(np.isfinite(self.inputs)):
            raise ValueError(f"{self.name}: an input is not finite")

    def is_at_rest(self, length: float) -> bool:
        """Whether the markers do not move, apart from noise between frames.

        The variance over time of every coordinate, minus that of its noise, must be
        small, and so must the distance between its quartiles. The noise variance is
        half the mean squared difference of successive frames. With fewer than `FEW`
        frames, no noise is subtracted.

        Args:
            length: Length of the arm [m].

        Source: J. von Neumann, Distribution of the ratio of the mean square successive
        difference to the variance, 1941.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # A marker never seen.
            spread = np.nanvar(self.points, axis=0)
            if len(self.times) >= FEW:
                steps = np.diff(self.points, axis=0)
                unsure = DOUBT / np.sqrt(len(self.times)) * spread
                spread = spread - unsure - 0.5 * np.nanmean(steps**2, axis=0)
            low, high = np.nanpercentile(self.points, [25, 75], axis=0)
        seen = np.isfinite(spread)
        still = spread[seen] < (STILL * length) ** 2
        return bool(np.all(still) and np.all((high - low)[seen] < LOUDEST * length))

    def averaged(self) -> Recording:
        """Recording of one frame: the medians of markers and inputs over all frames."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # A marker never seen.
            points = np.nanmedian(self.points, axis=0)[None]
        inputs = np.median(self.inputs, axis=0)[None]
        return replace(self, times=self.times[:1], inputs=inputs, points=points)


def read_recording(path: str | Path, arm: Arm) -> Recording:
    """Reads a recording from a CSV file with a header, or from a bag.

    Columns are `time` [s], one for each of `Arm.inputs`, and `NAME_x`, `NAME_y`,
    `NAME_z` for each marker, in recorded units (`Frame.scale`). If the names are those
    of the arm's markers, they identify the markers. Otherwise there must be as many
    markers as the arm has, and `register` identifies them. Other columns are ignored.
    An empty cell, or `nan`, is a marker that was not seen.

    Bags are ROS bags (`.bag`, folders of ROS 2) and MCAP files of ROS 2; they need the
    extra `ros`: `pip install "jaxrod[ros]"`. `Arm.topics` names the topic and field of
    each input and marker. Each message of the first marker is a frame. Other markers
    are those seen within half a frame, and inputs keep their last value.

    Args:
        path: Path of the file.
        arm: The arm, whose inputs and markers are read.

    Returns:
        The recording; its points are in metres. `labelled` says whether the order of
        the markers is the arm's.

    Raises:
        DamagedFileError: If the file is not such a table or bag; the message names the
            file.
        ImportError: If the file is a bag and rosbags is not installed.
        OSError: If the file cannot be opened.

    Example:
        >>> drawn = twin.Arm(
        ...     elements=4,
        ...     length=0.3,
        ...     radius=0.01,
        ...     density=1100.0,
        ...     youngs_modulus=4e5,
        ...     poisson_ratio=0.45,
        ...     direction=(0.0, 0.0, -1.0),
        ...     normal=(0.0, 1.0, 0.0),
        ...     gravity=(0.0, 0.0, -9.81),
        ...     tendons=(twin.TendonDrawing("pull", angle=0.0, distance=0.008),),
        ...     markers=(twin.Marker("tip", at=0.3),),
        ...     unknown={"youngs_modulus": 0.5},
        ... )
        >>> columns = "time,pull,tip_x,tip_y,tip_z"
        >>> rows = [[0.0, 1.0, 0.0, 0.05, -0.29], [0.1, 1.0, 0.0, 0.06, -0.28]]
        >>> np.savetxt("swing.csv", rows, delimiter=",", header=columns, comments="")
        >>> swing = twin.read_recording("swing.csv", drawn)
        >>> swing.points.shape, swing.labelled  # frames, markers, x y z
        ((2, 1, 3), True)
    """
    file = Path(path)
    if is_bag(file):
        with reading(file):
            return _from_bag(file, arm)
    columns, rows = read_csv(file)
    numbers = {name: k for k, name in enumerate(columns)}
    names = [
        name[:-2]
        for name in columns
        if name.endswith("_x") and {name[:-2] + "_y", name[:-2] + "_z"} <= {*columns}
    ]
    try:
        for name in ("time", *arm.inputs):
            if name not in numbers:
                raise ValueError(f"it has no column {name!r}")
        names, labelled = _chosen(names, arm)
        marked = [numbers[f"{name}_{axis}"] for name in names for axis in "xyz"]
        points = _numbers(rows, marked, columns)
        return Recording(
            name=file.stem,
            times=_numbers(rows, [numbers["time"]], columns)[:, 0],
            inputs=_numbers(rows, [numbers[name] for name in arm.inputs], columns),
            points=arm.frame.scale * points.reshape(-1, len(names), 3),
            labelled=labelled,
        )
    except ValueError as error:
        raise DamagedFileError(f"{file}: {error}") from error


def _from_bag(file: Path, arm: Arm) -> Recording:
    """The recording in a bag."""
    file.stat()  # Raises the error of a file that is not there.
    try:
        if file.is_dir() and not (file / "metadata.yaml").exists():
            raise ValueError(
                "it is a folder without metadata.yaml, so no bag: name the files in it"
            )
        for name in arm.inputs:
            if name not in arm.topics:
                raise ValueError(
                    f"the arm has no topic of the input {name!r} ([topics])"
                )
        others = [name for name in arm.topics if name not in arm.inputs]
        names, labelled = _chosen(others, arm)
        times, inputs, points = read_columns(file, arm.topics, arm.inputs, names)
        return Recording(file.stem, times, inputs, arm.frame.scale * points, labelled)
    except ValueError as error:
        raise DamagedFileError(f"{file}: {error}") from error


def _chosen(found: list[str], arm: Arm) -> tuple[list[str], bool]:
    """Names of the markers to read, and whether they are the arm's, in its order.

    `found` are the names of all markers that are recorded.
    """
    wanted = [marker.name for marker in arm.markers]
    known = [name for name in wanted if name in found]
    if len(known) == len(wanted):
        return wanted, True
    if known:
        missing = ", ".join(name for name in wanted if name not in known)
        raise ValueError(
            f"it has columns of the markers {', '.join(known)}, and none of "
            f"{missing}: name all of them, or none"
        )
    if len(found) != len(wanted):
        raise ValueError(
            f"it has the markers {', '.join(found) or 'none'}, and the arm has "
            f"{', '.join(wanted)}: the numbers must be equal"
        )
    return found, False


def _numbers(
    rows: Sequence[Sequence[str]], chosen: Sequence[int], columns: Sequence[str]
) -> np.ndarray:
    """Converts the cells of the columns `chosen` to numbers; NaN for empty cells.

    `columns` are the names of all columns, for the error message.
    """
    table = np.empty((len(rows), len(chosen)))
    for r, row in enumerate(rows):
        for c, column in enumerate(chosen):
            word = row[column].strip()
            try:
                table[r, c] = float(word or "nan")
            except ValueError:
                raise ValueError(
                    f"row {r + 1} has {word!r} in the column {columns[column]!r}, "
                    "which is not a number"
                ) from None
    return table
