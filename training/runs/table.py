"""CSV tables that grow by rows and can be cut back to an earlier length."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from jaxrod.files import (
    TEXT,
    check_entries,
    naming,
    open_to_write,
    read_csv,
    read_plain,
    reading,
    refuse_link,
    whole,
    write_atomically,
)

Mark = dict[str, Any]
"""Length of a table at some moment: number of rows and bytes, SHA-256 of the bytes."""


class Table:
    """A CSV file to which only this process appends.

    It remembers the length that it expects, to notice another writer. To continue an
    existing file, `cut` comes before the first `append`.
    """

    def __init__(self, path: Path) -> None:
        """Sets the path of the file, which need not exist."""
        self.path = path
        self._begin(b"")

    def _begin(self, content: bytes) -> None:
        head, newline, body = content.partition(b"\n")
        self._columns = head + newline
        self._rows, self._bytes = body.count(b"\n"), len(content)
        self._digest = hashlib.sha256(content)

    def append(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Appends rows; the first row of the file determines the columns.

        Raises:
            ValueError: Another process has written to the file, or a row has other
                columns.
            OSError: The file cannot be written; the message has its name.
        """
        rows = list(rows)
        if not rows:
            return
        columns = _lines([rows[0]])
        if self._columns and columns != self._columns:
            raise ValueError(
                f"{self.path} has the columns {self._columns.decode().strip()}; "
                f"a row of {columns.decode().strip()} does not fit"
            )
        added = _lines(row.values() for row in rows)
        if not self._columns:
            added = columns + added
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
        with (
            naming(self.path),
            os.fdopen(open_to_write(self.path, flags), "ab") as stream,
        ):
            found = os.fstat(stream.fileno()).st_size
            if found != self._bytes:
                raise ValueError(
                    f"another program has written to {self.path}: it has {found} "
                    f"bytes, but this run has left {self._bytes}"
                )
            try:
                stream.write(added)
                stream.flush()
            except OSError:
                with suppress(OSError):  # A row is there whole or not at all.
                    os.ftruncate(stream.fileno(), found)
                raise
        self._columns = columns
        self._rows, self._bytes = self._rows + len(rows), self._bytes + len(added)
        self._digest.update(added)

    def mark(self) -> Mark:
        """Waits until all rows are on the disk; returns the length of the table."""
        if self._bytes:
            with naming(self.path):
                handle = open_to_write(self.path, os.O_RDWR)
                try:
                    os.fsync(handle)
                finally:
                    os.close(handle)
        return {
            "rows": self._rows,
            "bytes": self._bytes,
            "sha256": self._digest.hexdigest(),
        }

    def check(self, mark: Mark | None) -> None:
        """Raises an error unless the file begins with its contents at an earlier mark.

        Args:
            mark: Result of an earlier `mark`; None checks only that the file is not a
                link.

        Raises:
            ValueError: Rows are missing or have changed.
            jaxrod.files.LinkedFileError: The file is a link.
        """
        refuse_link(self.path)
        if mark is None:
            return
        content = self._content()
        rows = max(content.count(b"\n") - 1, 0)
        if len(content) < mark["bytes"]:
            if rows < mark["rows"]:
                raise ValueError(
                    f"{self.path} has {rows} complete rows, but the checkpoint counts "
                    f"{mark['rows']}: rows are lost"
                )
            empty = _first_empty(content)
            raise ValueError(
                f"{self.path} has its {rows} rows, but {len(content)} bytes where the "
                f"checkpoint counts {mark['bytes']}: "
                f"{empty or 'values have become shorter'}"
            )
        if hashlib.sha256(content[: mark["bytes"]]).hexdigest() != mark["sha256"]:
            raise ValueError(
                f"{self.path} does not match the checkpoint: its first "
                f"{mark['rows']} rows ({mark['bytes']} bytes) have changed"
            )

    def cut(self, mark: Mark | None = None) -> None:
        """Cuts the table back to its length at an earlier mark; None removes the file.

        Raises:
            ValueError: See `check`.
        """
        if mark is None or not mark["bytes"]:
            self.path.unlink(missing_ok=True)
            self._begin(b"")
            return
        self.check(mark)
        content = self._content()
        kept = content[: mark["bytes"]]
        if len(kept) < len(content):
            write_atomically(self.path, kept)
        self._begin(kept)

    def read(self) -> list[dict[str, str]]:
        """Returns all complete rows; none if the file does not exist.

        Raises:
            ValueError: The file is damaged.
        """
        if not self.path.exists():
            return []
        columns, rows = read_csv(self.path)
        return [dict(zip(columns, row, strict=True)) for row in rows]

    def _content(self) -> bytes:
        if not self.path.exists():
            return b""
        with reading(self.path):
            return read_plain(self.path)


def check_mark(mark: Mapping[str, Any]) -> None:
    """Raises ValueError unless `mark` has the entries of a `Mark`."""
    check_entries(mark, {"rows": whole(0), "bytes": whole(0), "sha256": TEXT})


def _first_empty(content: bytes) -> str | None:
    """Phrase that names the row and column of an empty value; None if there is none.

    It is the first in a column that has values in earlier rows, or else the first of
    all: some columns have no values until an episode has ended.
    """
    lines = list(csv.reader(io.StringIO(content.decode(errors="replace"), newline="")))
    columns, rows = lines[0], lines[1:]
    seen: set[int] = set()
    places = []
    for number, row in enumerate(rows, 1):
        for k, value in enumerate(row[: len(columns)]):
            if value:
                seen.add(k)
                continue
            said = f"row {number} has an empty value in the column {columns[k]!r}"
            if k in seen:
                return said
            places.append(said)
    return places[0] if places else None


def _lines(rows: Iterable[Iterable[Any]]) -> bytes:
    """Rows as the bytes of CSV text."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()
