"""Folders of executable code, which must belong to this user alone.

Compiled programs and machine code on the disk are executed: whoever can change them
controls the process. The rules are those of `ssh` for its keys.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def shared_with(folder: Path) -> str | None:
    """Returns the reason why others may change a folder's files; None if they cannot.

    The folder must belong to this user, must not be a link, and must be writable by
    nobody else. The folders above it must belong to this user or to the system, and may
    be writable by others only if they are sticky, like /tmp. Windows has no such modes:
    there the answer is always None, as it is for a folder that does not exist.
    """
    if not hasattr(os, "getuid"):
        return None
    folder = folder.absolute()
    try:
        found = folder.lstat()
        above = {*folder.parents, *folder.resolve().parents}
        modes = {parent: parent.stat() for parent in sorted(above)}
    except FileNotFoundError:
        return None
    except OSError as error:
        return f"{folder} cannot be examined: {error.strerror}"
    if stat.S_ISLNK(found.st_mode):
        return f"{folder} is a link to {os.readlink(folder)}"
    if found.st_uid != os.getuid():
        return f"{folder} belongs to user {found.st_uid}, not to user {os.getuid()}"
    if found.st_mode & _OTHERS_WRITE:
        return f"{folder} is writable by others (mode {found.st_mode & 0o7777:04o})"
    for parent, mode in modes.items():
        if mode.st_uid not in (0, os.getuid()):
            return f"{parent}, above it, is of user {mode.st_uid}"
        if mode.st_mode & _OTHERS_WRITE and not mode.st_mode & stat.S_ISVTX:
            shown = f"mode {mode.st_mode & 0o7777:04o}"
            return f"{parent}, above it, is writable by others ({shown})"
    return None


def make_private_folder(folder: Path) -> None:
    """Makes a folder and any missing parent folders, for this user alone.

    Raises:
        OSError: If it cannot be made; the message names it.
    """
    for missing in reversed([folder, *folder.parents]):
        if not missing.is_dir():
            missing.mkdir(mode=0o700, exist_ok=True)


def read_own(path: Path) -> bytes | None:
    """Returns the contents of a file that only this user can have written.

    Returns:
        The contents; None if there is no such file, or others could have written it.
    """
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        handle = os.open(path, flags | getattr(os, "O_BINARY", 0))
    except OSError:
        return None
    with os.fdopen(handle, "rb") as file:
        found = os.fstat(handle)
        theirs = hasattr(os, "getuid") and (
            found.st_uid != os.getuid() or found.st_mode & _OTHERS_WRITE
        )
        if theirs or not stat.S_ISREG(found.st_mode):
            return None
        try:
            return file.read()
        except OSError:
            return None
