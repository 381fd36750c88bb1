"""Atomic writes of files, and reads whose errors name the file."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

TEMPORARY = ".partial"
"""Ending of the names of files that are not yet complete."""


class DamagedFileError(ValueError):
    """The contents of a file are damaged, or not of the expected kind."""


class LinkedFileError(ValueError):
    """A path to write to is a link, has other hard links, or is not a plain file."""


class UntrustedError(ValueError):
    """A file names code that is neither part of jaxrod nor trusted by the user."""


def refuse_link(path: Path) -> None:
    """Raises if a file or folder is a link; call it before writing there.

    A folder that was unpacked from an archive may contain links to anywhere. The folder
    that the user names may itself be a link; files and folders in it must not be.

    Raises:
        LinkedFileError: If it is a link.
    """
    if path.is_symlink() or _is_junction(path):
        raise LinkedFileError(
            f"{path} is a link to {os.readlink(path)}, and jaxrod does not write "
            "through links in the folder of a run: remove the link, or choose another "
            "folder"
        )


def make_folder(path: Path) -> None:
    """Makes a folder and any missing parent folders, unless it exists already.

    Raises:
        LinkedFileError: If it is a link, regardless of its target.
        OSError: If it cannot be made; the message names it.
    """
    refuse_link(path)
    path.mkdir(parents=True, exist_ok=True)


def open_to_write(path: Path, flags: int) -> int:
    """Opens a plain file for writing in place, and returns its descriptor.

    The file is not truncated: the caller does that after checking that it is the right
    one.

    Args:
        path: A plain file with no other hard link; created if `flags` has `os.O_CREAT`.
        flags: Flags of `os.open`.

    Returns:
        The descriptor of the open file.

    Raises:
        LinkedFileError: If it is a link, has other hard links, or is not a plain file.
        OSError: If it cannot be opened; the message names it.
    """
    refuse_link(path)
    # A pipe in its place must not block the process; Windows has neither flag.
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    flags |= getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
    try:
        handle = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):
            raise LinkedFileError(f"{path} is not a plain file: remove it") from error
        raise
    found = os.fstat(handle)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
        os.close(handle)
        what = "not a plain file"
        if stat.S_ISREG(found.st_mode):
            what = f"one file with {found.st_nlink} names (hard links)"
        raise LinkedFileError(
            f"{path} is {what}, so writing to it would change another file: replace it "
            "by a copy, or remove it"
        )
    return handle


def _is_junction(path: Path) -> bool:
    """Whether a path is a junction, the link to a folder on Windows."""
    return bool(getattr(os.path, "isjunction", lambda path: False)(path))


def write_atomically(
    path: str | os.PathLike[str],
    content: bytes | Callable[[BinaryIO], object],
    *,
    private: bool = False,
) -> None:
    """Replaces the contents of a file in one step, even if the process dies.

    When this returns, the new contents are on the disk. A link is itself replaced; its
    target does not change.

    Args:
        path: File to write; its folder must exist.
        content: Bytes to write, or a function that writes them into an open file.
        private: Whether only this user may read it.

    Raises:
        OSError: If it cannot be written; the message names it.
    """
    target = Path(path)
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
    with naming(target):
        handle, temporary = tempfile.mkstemp(
            dir=target.parent, prefix=f".{target.name}.", suffix=TEMPORARY
        )
        try:
            with os.fdopen(handle, "wb") as file:
                if callable(content):
                    content(file)
                else:
                    file.write(content)
                file.flush()
                os.fsync(file.fileno())
            if not private:
                # mkstemp makes private files; this sets the usual permissions.
                mask = os.umask(0)
                os.umask(mask)
                os.chmod(temporary, 0o666 & ~mask)
            os.replace(temporary, target)
        except BaseException:
            with suppress(OSError):
                os.unlink(temporary)
            raise
        _keep_names(target.parent)


def _keep_names(folder: Path) -> None:
    """Flushes a folder's list of files to the disk (`fsync`), if the system can."""
    if os.name != "posix":
        return
    with suppress(OSError):  # Some network file systems cannot.
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Context in which errors of the operating system name the file `path`."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename == str(path):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Context in which any failure to read a file becomes an error that names it.

    Raises:
        DamagedFileError: If any other error than the following is raised inside.
        UntrustedError: If one is raised inside; the path is added to its message.
        ImportError: If one is raised inside; it is passed on unchanged.
        OSError: If the file cannot be opened.
    """
    try:
        yield
    except (DamagedFileError, ImportError):
        raise
    except UntrustedError as error:
        raise UntrustedError(f"{path}: {error}") from error
    except OSError as error:
        # Only errors of opening have the name of a file.
        if error.filename is None:
            raise DamagedFileError(f"{path} is damaged: {error}") from error
        raise
    except Exception as error:
        raise DamagedFileError(f"{path} is damaged: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """Explanation of an error for a message, as one short line of text."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    said = " ".join(str(error).split())
    if len(said) > 300:
        said = f"{said[:300]} ..."
    known = isinstance(error, ValueError) and not isinstance(error, UnicodeError)
    return said if known and said else f"{type(error).__name__}: {said}"


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON file that contains one object.

    Raises:
        DamagedFileError: If it is not JSON, or not an object.
        OSError: If the file cannot be opened.
    """
    with reading(path):
        return parse_json(read_plain(path).decode())


def parse_json(text: str) -> dict[str, Any]:
    """Reads one object from JSON text.

    Raises:
        ValueError: If it is not JSON, or not an object; or if an object in it repeats a
            key, because readers disagree on which value counts.
    """
    content = json.loads(
        text, parse_constant=_refuse_constant, object_pairs_hook=_without_doubles
    )
    if not isinstance(content, dict):
        raise ValueError(f"it holds {_shown(content)}, not an object")
    return content


def with_tuples(value: Any) -> Any:
    """Converts lists, JSON's only sequences, to tuples at any depth."""
    return tuple(map(with_tuples, value)) if isinstance(value, list) else value


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        double = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"it has the key {_shown(double)} twice")
    return content


def read_plain(path: Path) -> bytes:
    """Reads a whole file; refuses pipes and devices, which may have no end.

    Raises:
        ValueError: If it is neither a file nor a folder.
        OSError: If the file cannot be opened.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError("it is not a plain file")
    return path.read_bytes()


def read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    """Returns the names of the columns and the rows of a CSV file, as text.

    A last line with too few values and no newline is still being written, so it is
    skipped. Blank lines at the end and a byte order mark are skipped too.

    Raises:
        DamagedFileError: If it is not CSV, or a row has more or fewer values than there
            are columns.
        OSError: If the file cannot be opened.
    """
    with reading(path):
        text = read_plain(path).decode("utf-8-sig")
        lines = csv.reader(io.StringIO(text, newline=""), strict=True)
        columns, rows = next(lines, []), list(lines)
        if rows and len(rows[-1]) < len(columns) and not text.endswith("\n"):
            rows.pop()
        while rows and not rows[-1]:
            rows.pop()
        for number, row in enumerate(rows, 1):
            if len(row) != len(columns):
                raise ValueError(
                    f"row {number} has {len(row)} values for {len(columns)} columns"
                )
    return columns, rows


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


Kind = tuple[str, Callable[[Any], bool]]
"""Kind of a JSON value: its description, and a test that is true for such values."""

TEXT: Kind = ("text", lambda value: isinstance(value, str))
OBJECT: Kind = ("an object", lambda value: isinstance(value, dict))
NUMBER: Kind = (
    "a number",
    lambda value: isinstance(value, int | float) and not isinstance(value, bool),
)
POSITIVE: Kind = (
    "a positive number",
    lambda value: NUMBER[1](value) and 0 < value < float("inf"),
)


def whole(smallest: int, largest: int = 2**63 - 1) -> Kind:
    """Kind for integers from `smallest` to `largest`, both included."""
    return (
        f"a whole number from {smallest} to {largest}",
        lambda value: type(value) is int and smallest <= value <= largest,
    )


def one_of(*choices: str) -> Kind:
    """Kind for text that is one of the given words."""
    return (
        f"one of {', '.join(choices)}",
        lambda value: isinstance(value, str) and value in choices,
    )


def optional(kind: Kind) -> Kind:
    """Kind for null and for values of the given kind."""
    words, test = kind
    return f"{words} or null", lambda value: value is None or test(value)


def check_entries(
    content: Mapping[str, Any],
    kinds: Mapping[str, Kind],
    may_lack: Mapping[str, Kind] | None = None,
) -> None:
    """Checks the kinds of the named entries of a JSON object; others are ignored.

    Args:
        content: The JSON object.
        kinds: Kind of each required entry.
        may_lack: Kind of each optional entry.

    Raises:
        ValueError: If an entry is missing or of another kind.
    """
    for name, (words, test) in kinds.items():
        if name not in content:
            raise ValueError(f"it has no {name!r}")
        _check_entry(name, content[name], words, test)
    for name, (words, test) in (may_lack or {}).items():
        if name in content:
            _check_entry(name, content[name], words, test)


def _check_entry(
    name: str, value: Any, words: str, test: Callable[[Any], bool]
) -> None:
    if not test(value):
        raise ValueError(f"{name!r} must be {words}, got {_shown(value)}")


def _shown(value: Any) -> str:
    """Short text for a value, for use in a message."""
    try:
        said = repr(value)
    except (ValueError, RecursionError):  # An integer of thousands of digits.
        said = f"a {type(value).__name__}"
    return said if len(said) <= 60 else f"{said[:60]} ..."
