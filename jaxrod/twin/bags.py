"""Columns of a recording from the messages of a ROS bag or an MCAP file."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SUFFIXES = (".bag", ".mcap", ".db3")
"""Suffixes of files that are bags; bags of ROS 2 may also be folders."""
PART = re.compile(r"(\w+)((?:\[\d+\])*)")
"""One name of a field, with indices."""
ONE_CLOCK = 24 * 3600 * 10**9
"""Times of headers and of arrival that differ by more are those of two clocks [ns]."""


class Rows(NamedTuple):
    """Values of a field over time."""

    times: np.ndarray
    """Time of each message, rising [ns]."""
    values: np.ndarray
    """Values `(messages, size)`."""
    delay: float
    """Median time from the time of a message to its arrival [ns]."""


def is_bag(path: Path) -> bool:
    """Whether a path is that of a bag, by its suffix or because it is a folder."""
    return path.suffix.lower() in SUFFIXES or path.is_dir()


def read_columns(
    path: Path, topics: Mapping[str, str], inputs: Sequence[str], names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, inputs and markers of a bag, a row for each message of the first marker.

    Other markers are those seen within half a frame, else NaN. Inputs keep their last
    value; before the first message they have the first.

    Args:
        path: The bag.
        topics: Topic and field of each input and marker, "TOPIC:FIELD".
        inputs: Names of the inputs.
        names: Names of the markers, at least one.

    Returns:
        Times since the first frame [s], inputs `(frames, inputs)`, and positions of the
        markers in recorded units `(frames, markers, 3)`.

    Raises:
        ImportError: If rosbags is not installed.
        ValueError: If a topic or a field is missing, a field has another size, or times
            cannot be compared.
    """
    for one, other in itertools.combinations(names, 2):
        if topics[one] == topics[other]:
            raise ValueError(f"{one} and {other} have the same topic, {topics[one]!r}")
    sizes = dict.fromkeys(inputs, 1) | dict.fromkeys(names, 3)
    rows = _fields(path, {name: topics[name] for name in sizes}, sizes)
    first = topics[names[0]]
    frames, _, delay = rows[names[0]]
    for name, row in rows.items():
        if abs(row.delay - delay) > ONE_CLOCK:
            raise ValueError(
                f"the clock of {topics[name]!r} is not that of {first!r}: times from "
                "messages to their arrival differ by "
                f"{1e-9 * abs(row.delay - delay):.3g} s"
            )
    half = 0.5 * np.median(np.diff(frames)) if len(frames) > 1 else np.inf
    seen = np.full((len(frames), len(names), 3), np.nan)
    for k, name in enumerate(names):
        times, values, _ = rows[name]
        nearest = _nearest(times, frames)
        near = np.abs(times[nearest] - frames) <= half
        if not np.any(near):
            raise ValueError(
                f"{topics[name]!r} has no message within half a frame of those of "
                f"{first!r}: do both have the same clock?"
            )
        seen[near, k] = values[nearest[near]]
    pulled = np.empty((len(frames), len(inputs)))
    for k, name in enumerate(inputs):
        times, values, _ = rows[name]
        if times[0] > frames[-1]:
            raise ValueError(
                f"{topics[name]!r} begins after the last message of {first!r}: are "
                "both of one clock?"
            )
        last = np.searchsorted(times, frames, side="right") - 1
        pulled[:, k] = values[np.maximum(last, 0), 0]
    return 1e-9 * (frames - frames[0]), pulled, seen


def _nearest(times: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Indices of the times nearest to each frame."""
    after = np.clip(np.searchsorted(times, frames), 1, max(len(times) - 1, 1))
    after = np.minimum(after, len(times) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(times[before] - frames) <= np.abs(times[after] - frames)
    return np.where(closer, before, after)


def _fields(
    path: Path, wanted: Mapping[str, str], sizes: Mapping[str, int]
) -> dict[str, Rows]:
    """Rows of each field, by name, in the order of their times."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(
            'bags need the package rosbags: pip install "jaxrod[ros]"'
        ) from error
    places = {name: _place(name, text) for name, text in wanted.items()}
    found: dict[str, list[tuple[int, int, list[float]]]]
    found = {name: [] for name in wanted}
    children: dict[str, set[str]] = {name: set() for name in wanted}
    # Bags of ROS 2 before Iron do not say how their messages are built.
    known = get_typestore(Stores.LATEST)
    with AnyReader([path], default_typestore=known) as reader:
        for name, (topic, _) in places.items():
            if topic not in reader.topics:
                raise ValueError(
                    f"it has no topic {topic!r} for {name!r}; its topics are "
                    f"{', '.join(sorted(reader.topics)) or 'none'}"
                )
        topics = {topic for topic, _ in places.values()}
        chosen = [c for c in reader.connections if c.topic in topics]
        for connection, received, data in reader.messages(connections=chosen):
            message = reader.deserialize(data, connection.msgtype)
            for name, (topic, parts) in places.items():
                if topic == connection.topic:
                    led = _path(message, parts, wanted[name])
                    value = _value(led[-1], wanted[name], sizes[name])
                    stamp = next(filter(None, map(_stamp, led)), 0)
                    found[name].append((stamp, received, value))
                    children[name] |= {getattr(x, "child_frame_id", "") for x in led}
    for name, several in children.items():
        if len(moving := sorted(several - {""})) > 1:
            raise ValueError(
                f"{wanted[name]!r} has transforms of {' and of '.join(moving)}: each "
                "needs a separate topic"
            )
    return {name: _rows(wanted[name], some) for name, some in found.items()}


def _rows(text: str, found: Sequence[tuple[int, int, list[float]]]) -> Rows:
    """Values of a field as arrays, in the order of their times.

    `found` are time in the header (0 if it has none), time of arrival, and value of
    each message.
    """
    if not found:
        raise ValueError(f"{text!r} has no messages")
    stamps, received = (np.array([row[k] for row in found], np.int64) for k in (0, 1))
    values = np.array([row[2] for row in found], float)
    has = stamps != 0
    # A simulated time may begin at zero; others that are zero were never set.
    unset = not np.any(has) or np.median((received - stamps)[has]) < ONE_CLOCK
    times = np.where(has | (not unset), stamps, received)
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    same = np.diff(times) == 0
    if values.shape[1] > 1 and not np.array_equal(
        values[1:][same], values[:-1][same], equal_nan=True
    ):
        raise ValueError(f"{text!r} has different positions at the same time")
    last = np.append(~same, True)
    return Rows(times[last], values[last], float(np.median(received[order] - times)))


def _place(name: str, text: str) -> tuple[str, list[str | int]]:
    """The topic of "TOPIC:FIELD", and the names and indices that lead to the field."""
    topic, colon, field = text.rpartition(":")
    parts: list[str | int] = []
    for word in field.split("."):
        match = PART.fullmatch(word)
        if not colon or match is None:
            raise ValueError(
                f"the topic of {name!r} must be TOPIC:FIELD, such as "
                f"'/mocap/tip:pose.position' or '/motors:effort[1]', got {text!r}"
            )
        parts.append(match[1])
        parts += [int(index) for index in re.findall(r"\d+", match[2])]
    return topic, parts


def _stamp(message: Any) -> int:
    """Time in the header of a message, or of a part of one [ns]; 0 if it has none."""
    stamp: Any = getattr(getattr(message, "header", None), "stamp", None)
    seconds = getattr(stamp, "sec", None)
    return 0 if seconds is None else int(seconds * 10**9 + stamp.nanosec)


def _path(message: Any, parts: Sequence[str | int], text: str) -> list[Any]:
    """The message, and all that leads from it to a field, which is the last."""
    path = [message]
    for part in parts:
        here = path[-1]
        try:
            there = here[part] if isinstance(part, int) else getattr(here, part)
        except (AttributeError, IndexError, TypeError):
            has = ", ".join(_names(here)) or f"{np.size(here)} entries"
            raise ValueError(f"{text!r}: there is no {part!r}; it has {has}") from None
        path.append(there)
    return path


def _names(message: Any) -> list[str]:
    """Names of the fields of a message; none for a number or a list."""
    fields = getattr(message, "__dataclass_fields__", ())
    return [name for name in fields if not name.startswith("_")]


def _value(message: Any, text: str, size: int) -> list[float]:
    """Numbers of a field: one, or the x, y and z of a point."""
    is_place = _names(message) == ["x", "y", "z"]
    place = [message.x, message.y, message.z] if is_place else message
    numbers = np.asarray(place).reshape(-1)
    if numbers.dtype.kind not in "fiub" or numbers.size != size:
        kind = "a number" if size == 1 else "a point with x, y and z"
        raise ValueError(f"{text!r} must be {kind}, got {type(message).__name__}")
    return numbers.astype(float).tolist()
