"""Folders of results: one process at a time writes, and replaces only jaxrod's files.

The entry `format` of `config.json` marks such a folder. Without the mark, nothing in
the folder is replaced or removed. With it, only files with the names that such a folder
holds are replaced or removed, one by one.

The operating system holds the lock of a folder and releases it when the process ends
for any reason, so a killed run leaves nothing to clean up. On network file systems that
forward locks (NFS, and Lustre with the right mount option) it also works between
machines. On a file system without locks there is a warning, and
`jaxrod.training.runs.table.Table` notices when another process has written.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from jaxrod.files import (
    TEMPORARY,
    DamagedFileError,
    naming,
    open_to_write,
    read_json,
    reading,
    refuse_link,
    write_atomically,
)

LOCK = ".jaxrod.lock"
"""Name of the locked file, which contains the id of the process that holds the lock."""

_TAKEN = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)


class FolderInUseError(ValueError):
    """Another process is writing to the folder."""


class UnlockedFolderWarning(UserWarning):
    """The file system cannot keep two processes out of one folder."""


@contextmanager
def only_process(folder: Path) -> Iterator[None]:
    """Locks a folder for this process while the context lasts.

    The folder is created if it is missing, and removed again if it is still empty at
    the end.

    Raises:
        FolderInUseError: Another process holds the lock; the message names the process.
        jaxrod.files.LinkedFileError: The lock file is a link.
        OSError: The folder cannot be made or written to.
    """
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = _take(folder / LOCK)
        try:
            with suppress(OSError):  # A full disk does not make the lock less good.
                os.ftruncate(lock, 0)
                os.write(lock, f"{os.getpid()} {platform.node()}\n".encode())
            yield
        finally:
            # Unlinked before it is released; see `_is_still`. Windows keeps open files.
            with suppress(OSError):
                os.unlink(folder / LOCK)
            os.close(lock)
    finally:
        if made:
            with suppress(OSError):  # There is something in it.
                folder.rmdir()


def _take(file: Path) -> int:
    """Opens and locks the file; returns its descriptor."""
    while True:
        lock = open_to_write(file, os.O_RDWR | os.O_CREAT)
        try:
            _lock(lock)
        except OSError as error:
            if error.errno in _TAKEN:
                holder = _holder(lock)
                os.close(lock)
                raise FolderInUseError(
                    f"{file.parent} is in use by {holder}: wait for its end, stop it, "
                    "or choose another folder"
                ) from None
            warnings.warn(
                f"the file system of {file.parent} has no locks "
                f"({error.strerror}): make sure that no two processes train there",
                UnlockedFolderWarning,
                stacklevel=2,
            )
            return lock
        if _is_still(lock, file):
            return lock
        # Its holder removed the file between our opening and our locking it.
        os.close(lock)


def _is_still(lock: int, file: Path) -> bool:
    """Whether the open file `lock` is still the file at the path `file`."""
    try:
        return os.path.samestat(os.fstat(lock), os.lstat(file))
    except FileNotFoundError:
        return False


def _holder(lock: int) -> str:
    """Description of the process that holds the lock, as read from the lock file."""
    words = os.pread(lock, 200, 0) if hasattr(os, "pread") else os.read(lock, 200)
    pid, _, host = words.decode(errors="replace").strip().partition(" ")
    return f"process {pid} on {host}" if pid and host else "another process"


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        """Locks a byte far beyond the contents: Windows locks also block readers."""
        os.lseek(handle, 2**30, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        os.lseek(handle, 0, os.SEEK_SET)

else:
    import fcntl

    def _lock(handle: int) -> None:
        """Locks the file for this process.

        `lockf` would lose the lock when any descriptor of the file is closed.
        """
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


CONFIG = "config.json"
"""Name of the file with the configuration and the mark of jaxrod."""


class OwnedFolder:
    """A folder of results that one command writes, with known names of files."""

    def __init__(
        self,
        path: str | Path,
        kind: str,
        files: Sequence[str],
        folders: Mapping[str, str] | None = None,
    ) -> None:
        """Sets the path of the folder, which need not exist.

        Args:
            path: The folder.
            kind: Kind of its contents, such as "training run".
            files: Names of the files in it, in addition to `config.json`.
            folders: Names of the folders in it, each with a regular expression for the
                names of its files.

        Raises:
            ValueError: `path` is empty.
        """
        if not os.fspath(path).strip():
            raise ValueError(f"out must name a folder, got {os.fspath(path)!r}")
        self.path = Path(path)
        self.kind = kind
        self._files = (CONFIG, *files)
        self._folders = dict(folders or {})

    @property
    def exists(self) -> bool:
        """Whether the folder has a `config.json`, of jaxrod or another program."""
        return os.path.lexists(self.path / CONFIG)

    def only_process(self) -> AbstractContextManager[None]:
        """Context that locks the folder for this process.

        See the function `jaxrod.training.runs.owned_folder.only_process`.
        """
        return only_process(self.path)

    def stored(self) -> dict[str, Any]:
        """Contents of `config.json` without its mark.

        Raises:
            ValueError: `config.json` is missing, is damaged, or has another mark.
        """
        file = self.path / CONFIG
        try:
            content = read_json(file)
        except FileNotFoundError:
            raise ValueError(f"no {CONFIG} in {str(self.path)!r}") from None
        with reading(file):
            mark = content.pop("format", self._mark)
            if mark != self._mark:
                raise ValueError(f"it is of the format {mark!r}, not {self._mark!r}")
        return content

    @property
    def _mark(self) -> str:
        return f"jaxrod {self.kind} 1"

    def check_replaceable(self) -> None:
        """Raises ValueError if writing could destroy files that are not jaxrod's."""
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path} is a file, not a folder")
        for name in self._folders:
            refuse_link(self.path / name)
        there = self._there()
        if not there:
            return
        strange = self._strange()
        if strange:
            raise ValueError(
                f"{self.path} holds {', '.join(there)}, and {strange}: jaxrod "
                "replaces nothing there. Choose another folder, or move them away"
            )
        for name in there:
            if (self.path / name).is_dir() != (name in self._folders):
                raise ValueError(f"{self.path / name} was not written by jaxrod")

    def _there(self) -> list[str]:
        """Names of jaxrod's files and folders that exist, without empty folders."""
        return [name for name in self._files if os.path.lexists(self.path / name)] + [
            name
            for name in self._folders
            if os.path.lexists(self.path / name)
            and not ((self.path / name).is_dir() and _is_empty(self.path / name))
        ]

    def _strange(self) -> str | None:
        """Reason why the folder does not bear jaxrod's mark; None if it does."""
        file = self.path / CONFIG
        if not os.path.lexists(file):
            return f"no {CONFIG} that says that they are of a {self.kind} of jaxrod"
        try:
            mark = read_json(file).get("format")
        except (DamagedFileError, OSError) as error:
            return str(error)
        if mark != self._mark:
            return f"its {CONFIG} does not say that it is a {self.kind} of jaxrod"
        return None

    def begin(self, config: Mapping[str, Any]) -> None:
        """Removes earlier results and writes `config.json`.

        Raises:
            ValueError: See `check_replaceable`; or the configuration cannot be written
                as JSON. Nothing is removed then.
        """
        text = as_json(CONFIG, {"format": self._mark, **config})
        self.check_replaceable()
        self._remove_results()
        self.path.mkdir(parents=True, exist_ok=True)
        write_atomically(self.path / CONFIG, text)

    def clear(self) -> None:
        """Removes the files that jaxrod has written here, and nothing else.

        Raises:
            ValueError: See `check_replaceable`; nothing is removed then.
        """
        self.check_replaceable()
        self._remove_results()
        _remove(self.path / CONFIG)

    def _remove_results(self) -> None:
        """Removes the files that jaxrod has written, except `config.json`."""
        for folder, names in self._folders.items():
            for file in _matching(self.path / folder, names):
                _remove(file)
            with suppress(OSError):  # There is more in it, or it is a link.
                (self.path / folder).rmdir()
        for name in self._files:
            if name != CONFIG:
                _remove(self.path / name)
        self.remove_temporary()

    def remove_temporary(self, but: Sequence[str] = ()) -> None:
        """Removes temporary files that a killed process left behind.

        Args:
            but: Files that other processes may be writing at this moment.
        """
        names = "|".join(re.escape(name) for name in self._files if name not in but)
        for folder, pattern in {".": names, **self._folders}.items():
            partial = rf"\.({pattern})\.[^.]+{re.escape(TEMPORARY)}"
            for file in _matching(self.path / folder, partial):
                _remove(file)


def _matching(folder: Path, names: str) -> list[Path]:
    """Files of a folder whose whole names match the regular expression `names`."""
    if not folder.is_dir():
        return []
    return [
        file
        for file in folder.iterdir()
        if re.fullmatch(names, file.name) and not file.is_dir()
    ]


def _is_empty(folder: Path) -> bool:
    return not any(folder.iterdir())


def _remove(file: Path) -> None:
    with naming(file):
        file.unlink(missing_ok=True)


def as_json(name: str, content: Mapping[str, Any]) -> bytes:
    """Bytes of a JSON file.

    Args:
        name: Name of the file, for messages.
        content: Entries of the file.

    Raises:
        ValueError: A number is not finite.
        TypeError: A value cannot be written as JSON.
    """
    try:
        text = json.dumps(dict(content), indent=2, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"{name} can hold only finite numbers: {error}") from error
    return (text + "\n").encode()
