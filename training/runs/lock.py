"""A lock on a folder that lets only one process at a time write to it.

The operating system holds the lock and releases it when the process ends for any
reason, so a killed run leaves nothing to clean up. On network file systems that forward
locks (NFS, and Lustre with the right mount option) it also works between machines. On a
file system without locks there is a warning, and `jaxrod.training.runs.table.Table`
notices when another process has written.
"""

from __future__ import annotations

import errno
import os
import platform
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from jaxrod.files import open_to_write

NAME = ".jaxrod.lock"
"""Name of the locked file; its content names the process that holds the lock."""

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
        lock = _take(folder / NAME)
        try:
            with suppress(OSError):  # A full disk does not make the lock less good.
                os.ftruncate(lock, 0)
                os.write(lock, f"{os.getpid()} {platform.node()}\n".encode())
            yield
        finally:
            # Unlinked before it is released; see `_is_still`. Windows keeps open files.
            with suppress(OSError):
                os.unlink(folder / NAME)
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
                f"({error.strerror}): see to it that no two processes train there",
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
        """Locks a byte far behind the content: locks on Windows also block readers."""
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
