"""Event files, by which TensorBoard shows the progress table of a run.

The file repeats `progress.csv`: one event for each row, at the row's `env_steps` and
the time of its `wall_s`, with every other number as a scalar. It is rewritten from that
table whenever a run is resumed. So no step is duplicated or missing, no matter when the
run was killed and whether it had an event file before.

The events use the message types of tensorboardX, but not its writer. That writer passes
events to a thread, which a full disk ends silently, and it puts the machine's name into
the file name.
"""

from __future__ import annotations

import os
import re
import struct
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrod.files import make_folder, naming, open_to_write

if TYPE_CHECKING:
    from tensorboardX.proto.event_pb2 import Event

NAMES = r"events\.out\.tfevents\.\d+\.jaxrod"
"""Regular expression for the names of event files."""

_VERSION = "brain.Event:2"
"""Version of the event format, which determines how TensorBoard treats a restart."""


def check_installed() -> None:
    """Raises ModuleNotFoundError, with a clear message, if tensorboardX is missing."""
    try:
        import tensorboardX.proto.event_pb2  # noqa: F401
    except ModuleNotFoundError as missing:
        if (missing.name or "").partition(".")[0] not in ("tensorboardX", "google"):
            raise
        raise ModuleNotFoundError(
            f"log='tensorboard' needs {missing.name}; install it with: "
            'pip install "jaxrod[tensorboard]"',
            name=missing.name,
        ) from missing


class EventFile:
    """The event file of a run, which grows by one event per row of progress."""

    def __init__(
        self, folder: Path, rows: Iterable[Mapping[str, Any]], wall_s: float
    ) -> None:
        """Writes a new event file with the rows of the run so far.

        Args:
            folder: Folder of the file; created if missing. Older event files in it are
                removed.
            rows: Rows of the progress table, as numbers or as text from the table.
            wall_s: Time that the run has taken so far [s].

        Raises:
            ModuleNotFoundError: tensorboardX is not installed.
            OSError: The file cannot be written; the message has its name.
        """
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        check_installed()
        now = time.time()
        self._began = now - wall_s
        with naming(folder):
            make_folder(folder)
            earlier = [
                file for file in folder.iterdir() if re.fullmatch(NAMES, file.name)
            ]
        # TensorBoard reads files in the order of their names, and a restart at step 0
        # makes it forget the contents of the others.
        self.path = folder / f"events.out.tfevents.{time.time_ns()}.jaxrod"
        start = SessionLog(status=SessionLog.START)
        self._append(
            [
                Event(wall_time=now, file_version=_VERSION),
                Event(wall_time=now, step=0, session_log=start),
                *(event for row in rows if (event := self._event(row))),
            ]
        )
        for file in earlier:
            with naming(file):
                file.unlink(missing_ok=True)

    def append(self, row: Mapping[str, Any]) -> None:
        """Appends a row of progress as an event at its `env_steps` and `wall_s`.

        Raises:
            OSError: The file cannot be written; the message has its name.
        """
        event = self._event(row)
        if event:
            self._append([event])

    def _event(self, row: Mapping[str, Any]) -> Event | None:
        """Event with all scalars of a row of progress; None if the row has none."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.proto.summary_pb2 import Summary

        values = [
            Summary.Value(tag=name, simple_value=float(value))
            for name, value in row.items()
            # Missing values are None in a row, and empty in the table.
            if name not in ("env_steps", "wall_s") and value not in (None, "")
        ]
        if not values:
            return None
        return Event(
            wall_time=self._began + float(row["wall_s"]),
            step=int(row["env_steps"]),
            summary=Summary(value=values),
        )

    def _append(self, events: Iterable[Event]) -> None:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
        with (
            naming(self.path),
            os.fdopen(open_to_write(self.path, flags), "ab") as stream,
        ):
            stream.write(b"".join(map(_record, events)))


def _record(event: Event) -> bytes:
    """Bytes of an event in the file: length, its CRC, message, its CRC."""
    from tensorboardX.record_writer import masked_crc32c

    content = event.SerializeToString()
    length = struct.pack("<Q", len(content))
    sums = [struct.pack("<I", masked_crc32c(part)) for part in (length, content)]
    return length + sums[0] + content + sums[1]
