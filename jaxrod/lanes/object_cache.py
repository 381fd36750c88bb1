"""Machine code kept on disk, beside the programs that JAX keeps there.

Where JAX has a folder for compiled programs (`jax_compilation_cache_dir`), a kernel's
object code is kept in it too, under a digest of its text, of the processor's features
and of LLVM's version. A file begins with a digest of what follows: one that is damaged
is compiled anew. Files are written whole or not at all.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import jax

from jaxrod.files import write_atomically

_DIGEST = 32
"""Bytes of a digest."""


def keeps_objects(engine: Any, key: str) -> None:
    """Has an engine look for its object code on disk first, and put it there.

    Args:
        engine: LLVM's, with a single module.
        key: What the object code depends on, all of it.
    """
    path = _path(key)
    if path is None:
        return

    def kept(module: Any) -> bytes | None:
        del module
        try:
            found = path.read_bytes()
        except OSError:
            return None
        code = found[_DIGEST:]
        return code if hashlib.sha256(code).digest() == found[:_DIGEST] else None

    def keep(module: Any, code: bytes) -> None:
        del module
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, hashlib.sha256(code).digest() + code)
        except OSError:
            # A folder that is full or read-only costs time, not results.
            return

    engine.set_object_cache(keep, kept)


def _path(key: str) -> Path | None:
    # JAX defines its settings when it runs: their types are not known before.
    settings: Any = jax.config
    folder = settings.jax_compilation_cache_dir
    if not folder or "://" in folder or not settings.jax_enable_compilation_cache:
        return None
    return Path(folder) / f"jaxrod-lanes-{hashlib.sha256(key.encode()).hexdigest()}"
