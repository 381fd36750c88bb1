"""Compiled programs kept on disk, so that a second process need not compile them.

JAX keeps them (its persistent compilation cache); this module chooses the folder. JAX
names a file after the program, XLA's options and the releases. The capabilities of the
processor are not known to be among them, and a home directory may be shared by several
machines. So there is a folder for every processor.

JAX does not write whole files at once. Files compressed by zlib have a checksum: one
that is damaged or half written is reported and compiled again. Files compressed by
zstandard have none, and a process that loads a damaged one can crash or worse. In that
case nothing is kept.

Files from the disk are executed. A folder that others can write to is therefore
refused, with a warning, and programs are compiled as if there were no cache.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import sys
import warnings
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from jaxrod.private_folders import make_private_folder, shared_with

VARIABLE = "JAXROD_CACHE"
"""Environment variable that asks for the cache: 1, or a folder."""

SHORTEST_COMPILATION = 0.3
"""Shortest compile time of programs that are kept [s], unless the user set it."""

_JAX_SHORTEST = 1.0

_LOUD = "0.10.1"
_LEVEL = "TF_CPP_MIN_LOG_LEVEL"


class UncheckedCacheWarning(UserWarning):
    """JAX would keep compiled programs without a checksum; they are not kept."""


class SharedCacheWarning(UserWarning):
    """Others can write to the folder of compiled programs; it is not used."""


def without_checksum() -> bool:
    """Whether JAX would compress the files by zstandard."""
    return sys.version_info >= (3, 14) or bool(importlib.util.find_spec("zstandard"))


def asked_for() -> bool | str:
    """Value of the environment variable: no, yes, or a folder."""
    value = os.environ.get(VARIABLE, "").strip()
    if value in ("", "0"):
        return False
    return True if value == "1" else value


def keep_programs(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Makes JAX keep the programs that it compiles from now on, and use those kept.

    Args:
        folder: Folder of the programs; by default `default_folder()`, or the one that
            JAX uses already. If it does not exist it is made, for this user alone.

    Returns:
        The folder; None if nothing is kept.

    Raises:
        ValueError: If it is not a folder, and cannot be made.

    Warns:
        UncheckedCacheWarning: If JAX would keep programs without a checksum.
        SharedCacheWarning: If others can write to the folder.
    """
    import jax

    # JAX defines its settings at run time, so their types are not known before.
    already = getattr(jax.config, "jax_compilation_cache_dir", None)
    if folder is None and already:
        return Path(already)
    if without_checksum():
        warnings.warn(
            "compiled programs are not kept: JAX compresses them by zstandard here, "
            "without a checksum, and one that is damaged on the disk would be run. "
            "Without the package zstandard, and with Python before 3.14, they are kept",
            UncheckedCacheWarning,
            stacklevel=3,
        )
        return None
    chosen = default_folder() if folder is None else Path(folder)
    chosen = chosen.expanduser().absolute()
    try:
        make_private_folder(chosen)
    except (OSError, ValueError) as error:
        # From the environment or an argument: in both cases a folder was meant.
        raise ValueError(
            f"the cache of compiled programs must be a folder that can be made, got "
            f"{str(chosen)!r}: {getattr(error, 'strerror', None) or error}"
        ) from error
    why = shared_with(chosen)
    if why is not None:
        warnings.warn(
            f"compiled programs are neither kept nor taken from the disk: {why}, and "
            "what lies there is run. Take a folder of your own, with mode 0700, in "
            f"folders of your own ({VARIABLE}=FOLDER)",
            SharedCacheWarning,
            stacklevel=3,
        )
        return None
    jax.config.update("jax_compilation_cache_dir", str(chosen))
    name = "jax_persistent_cache_min_compile_time_secs"
    if getattr(jax.config, name) == _JAX_SHORTEST:
        jax.config.update(name, SHORTEST_COMPILATION)
    return chosen


def default_folder() -> Path:
    """Folder `$XDG_CACHE_HOME/jaxrod/PROCESSOR`, or under `~/.cache` if not set."""
    home = os.environ.get("XDG_CACHE_HOME", "").strip()
    caches = Path(home) if home else Path.home() / ".cache"
    digest = hashlib.sha256(processor_features().encode()).hexdigest()
    return caches / "jaxrod" / digest[:16]


def processor_features() -> str:
    """Name and instruction sets of the processor, as the system reports them."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    # Those of the first core: x86 uses "flags", ARM "Features".
    wanted = ("model name", "flags", "Features", "CPU part")
    facts = [line for line in lines if line.partition(":")[0].strip() in wanted]
    first = dict(reversed([line.partition(":")[::2] for line in facts]))
    words = [
        f"{name.strip()}: {value.strip()}" for name, value in sorted(first.items())
    ]
    return "\n".join([platform.machine(), platform.processor(), *words])


def silence_false_alarms() -> None:
    """Hides XLA's lines about every program loaded from the cache. Call before JAX.

    JAX 0.10.1 writes two error lines for each on an AMD EPYC: it compares the features
    that LLVM was told to prefer (no gathers, no scatters) with those of the processor.
    Nothing is hidden with other releases, or if `TF_CPP_MIN_LOG_LEVEL` is set; errors
    that end the process are always shown.
    """
    if "jaxlib" in sys.modules or os.environ.get(_LEVEL):
        return
    with suppress(metadata.PackageNotFoundError):
        if metadata.version("jaxlib") == _LOUD:
            os.environ[_LEVEL] = "3"
