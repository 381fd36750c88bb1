"""Cache of machine code on disk, in the folder where JAX keeps compiled programs.

If JAX has a folder for compiled programs (`jax_compilation_cache_dir`), a kernel's
object code is kept in it too. Its file name is a digest of the kernel's text, of the
processor's features and of LLVM's version. A file begins with a digest of its content:
a damaged file is ignored and the kernel compiled again. Files are written atomically.

The digest has no key, so anyone who can write to the folder could make this process run
any code. So kernels are neither read from nor written to a folder that others can write
to. They are compiled again instead, and a warning is logged once.
"""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Any

import jax

from jaxrod.files import write_atomically
from jaxrod.private_folders import (
    make_private_folder,
    read_own,
    shared_with,
)

_log = logging.getLogger("jaxrod.lanes")
_told: set[Path] = set()
"""Folders for which the warning that others can write to them has been logged."""

_DIGEST = 32
"""Size of the SHA-256 digest at the beginning of a file [bytes]."""


def keeps_objects(engine: Any, key: str) -> None:
    """Makes an LLVM engine read its object code from disk if possible, or store it.

    Args:
        engine: An engine of LLVM with a single module.
        key: Everything on which the object code depends.
    """
    path = _path(key)
    if path is None or _is_refused(path.parent):
        return

    def kept(module: Any) -> bytes | None:
        del module
        found = read_own(path)
        if found is None:
            return None
        code = found[_DIGEST:]
        return code if hashlib.sha256(code).digest() == found[:_DIGEST] else None

    def keep(module: Any, code: bytes) -> None:
        del module
        try:
            make_private_folder(path.parent)
            content = hashlib.sha256(code).digest() + code
            write_atomically(path, content, private=True)
        except OSError:
            # A folder that is full or read-only costs time, not results.
            return

    engine.set_object_cache(keep, kept)


def _is_refused(folder: Path) -> bool:
    """Whether others can write to the folder, so that no machine code is read from it.

    A warning is logged once for each folder.
    """
    why = shared_with(folder)
    if why is None:
        return False
    if folder not in _told:
        _told.add(folder)
        _log.warning(
            "kernels are not kept on disk: %s, and machine code from there could be "
            "anybody's. Use a folder of your own, with mode 0700",
            why,
        )
    return True


def _path(key: str) -> Path | None:
    # JAX defines its settings at run time, so that type checkers do not know them.
    settings: Any = jax.config
    folder = settings.jax_compilation_cache_dir
    if not folder or "://" in folder or not settings.jax_enable_compilation_cache:
        return None
    return Path(folder) / f"jaxrod-lanes-{hashlib.sha256(key.encode()).hexdigest()}"
