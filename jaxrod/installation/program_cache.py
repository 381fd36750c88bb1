"""Compiled programs kept on disk, so that a second process need not compile them.

JAX keeps them (its persistent compilation cache); this module chooses the folder. JAX
names a file after the program, XLA's options and the releases. Whether the name covers
the capabilities of the processor is not documented, and several machines may share a
home directory. So there is a folder for every type of processor.

JAX does not write whole files at once. So each process has its own folder inside, with
hard links to all kept files. Files that it adds are moved to the common folder when the
process ends. So no process reads half a file, and a killed process leaves only its own
folder, which is removed after a week. The least recently used files are removed when
all files together exceed `MOST_BYTES`.

Files compressed by zlib have a checksum: a damaged file is reported, and its program is
compiled again. Files compressed by zstandard have no checksum, and a process that loads
a damaged one can crash or worse. So with zstandard nothing is kept.

Files from the disk are executed. A folder that others can write to is therefore
refused, and programs are compiled as if there were no cache.
"""

from __future__ import annotations

import atexit
import hashlib
import importlib.util
import os
import platform
import re
import shutil
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from jaxrod.private_folders import make_private_folder, shared_with

VARIABLE = "JAXROD_CACHE"
"""Environment variable of the cache: 0 for none, 1 for the default folder, or a
folder."""

SHORTEST_COMPILATION = 0.01
"""Shortest compile time of a kept program, unless the user has set another [s]."""

MOST_BYTES = 10**9
"""Largest size of all kept programs together [bytes]."""

_JAX_SHORTEST = 1.0
_OWN = "jaxrod-process-"
"""Beginning of the names of the folders of single processes."""
_KEPT = re.compile(r"jaxrod-(lanes|kernel)-.*|.*-cache|.*-atime")
"""Names of the files that JAX and jaxrod keep; others in the folder are not touched."""
_WEEK = 7 * 86_400.0

_LOUD = "0.10.1"
_LEVEL = "TF_CPP_MIN_LOG_LEVEL"
_UNCHECKED = (
    "JAX compresses them by zstandard here, without a checksum, and a damaged file "
    "would be executed. Without the package zstandard, and with Python "
    "before 3.14, they are kept"
)


class UncheckedCacheWarning(UserWarning):
    """JAX would keep compiled programs without a checksum; they are not kept."""


class SharedCacheWarning(UserWarning):
    """Others can write to the folder of compiled programs; it is not used."""


def without_checksum() -> bool:
    """Whether JAX would compress the files by zstandard."""
    return sys.version_info >= (3, 14) or bool(importlib.util.find_spec("zstandard"))


def asked_for() -> bool | str | None:
    """Value of `JAXROD_CACHE`: False for 0, True for 1, a folder; None if not set."""
    value = os.environ.get(VARIABLE, "").strip()
    return {"": None, "0": False, "1": True}.get(value, value)


def obstacle() -> str | None:
    """Returns the reason why compiled programs are not kept; None if they can be."""
    if asked_for() is False:
        return f"{VARIABLE} is 0"
    if without_checksum():
        return _UNCHECKED
    if asked_for() is None and _is_loud() and not os.environ.get(_LEVEL):
        return f"JAX {_LOUD} raises a false alarm for every program that was kept"
    try:
        return shared_with(chosen_folder())
    except RuntimeError as error:
        return str(error)


def chosen_folder() -> Path:
    """Folder that `JAXROD_CACHE` names, or the default folder."""
    asked = asked_for()
    return Path(asked).expanduser() if isinstance(asked, str) else default_folder()


def kept_files(folder: Path) -> list[tuple[float, int, Path]]:
    """Time of the last use [s since 1970], size [bytes] and path of each kept file.

    The least recently used file is first.
    """
    kept = []
    for entry in os.scandir(folder):
        if entry.is_file(follow_symlinks=False) and _KEPT.fullmatch(entry.name):
            found = entry.stat(follow_symlinks=False)
            used = max(found.st_atime, found.st_mtime)
            kept.append((used, found.st_size, Path(entry.path)))
    return sorted(kept)


def keep_programs(
    folder: str | os.PathLike[str] | None = None, *, asked: bool = True
) -> Path | None:
    """Makes JAX keep the programs that it compiles from now on, and load kept ones.

    Args:
        folder: Folder of the programs; by default the one that JAX uses already, else
            `default_folder()`. If it does not exist it is made, for this user alone.
        asked: Whether the user asked for it. If not, there is neither an error nor a
            warning when programs cannot be kept.

    Returns:
        The folder; None if nothing is kept.

    Raises:
        ValueError: If the user asked for a folder that does not exist and cannot be
            made.

    Warns:
        UncheckedCacheWarning: If JAX would keep programs without a checksum.
        SharedCacheWarning: If others can write to the folder.
    """
    import jax

    # JAX defines its settings at run time, so their types are not known before.
    already = getattr(jax.config, "jax_compilation_cache_dir", None)
    if folder is None and already:
        own = Path(already)
        return own.parent if own.name.startswith(_OWN) else own
    if not asked and obstacle() is not None:
        return None
    if without_checksum():
        warnings.warn(
            f"jaxrod does not keep compiled programs: {_UNCHECKED}",
            UncheckedCacheWarning,
            stacklevel=3,
        )
        return None
    try:
        chosen = default_folder() if folder is None else Path(folder)
        chosen = chosen.expanduser().absolute()
        make_private_folder(chosen)
    except (OSError, ValueError, RuntimeError) as error:
        if not asked:
            return None
        # The folder comes from the environment or an argument; both name a folder.
        raise ValueError(
            f"jaxrod cannot make the folder of compiled programs, "
            f"{str(folder or 'the default')!r}: "
            f"{getattr(error, 'strerror', None) or error}"
        ) from error
    why = shared_with(chosen)
    if why is not None:
        warnings.warn(
            f"compiled programs are neither kept nor taken from the disk: {why}, and "
            f"files there would be executed. Use a folder of your own, with mode 0700, "
            f"in folders of your own ({VARIABLE}=FOLDER)",
            SharedCacheWarning,
            stacklevel=3,
        )
        return None
    try:
        own = _folder_of_this_process(chosen)
    except OSError:
        # A disk that is full or read-only costs time, not results.
        return None
    jax.config.update("jax_compilation_cache_dir", str(own))
    name = "jax_persistent_cache_min_compile_time_secs"
    if getattr(jax.config, name) == _JAX_SHORTEST:
        jax.config.update(name, SHORTEST_COMPILATION)
    return chosen


def _folder_of_this_process(folder: Path) -> Path:
    """Makes a folder for this process, with hard links to all kept programs.

    Folders that processes abandoned a week ago are removed. So are the least recently
    used programs in `folder`, until the others take at most `MOST_BYTES`.
    """
    for abandoned in folder.glob(f"{_OWN}*"):
        with suppress(OSError):  # Another process may remove it at the same time.
            if abandoned.stat().st_mtime < time.time() - _WEEK:
                shutil.rmtree(abandoned, ignore_errors=True)
    kept = kept_files(folder)
    size = sum(bytes_of_it for _, bytes_of_it, _ in kept)
    own = Path(tempfile.mkdtemp(prefix=_OWN, dir=folder))
    atexit.register(_give_back, own, os.getpid())
    for _, bytes_of_it, file in kept:
        with suppress(OSError):
            if size > MOST_BYTES:
                size -= bytes_of_it
                file.unlink()
            else:
                os.link(file, own / file.name)
    return own


def _give_back(own: Path, process: int) -> None:
    """Moves the programs in a process's folder `own` to the common folder.

    Then `own` is removed. Nothing is done in a process other than `process`, such as a
    fork.
    """
    if os.getpid() != process:
        return
    with suppress(OSError):
        for file in own.iterdir():
            if file.is_file() and not (own.parent / file.name).exists():
                file.replace(own.parent / file.name)
    shutil.rmtree(own, ignore_errors=True)


def default_folder() -> Path:
    """Returns the default folder, `$XDG_CACHE_HOME/jaxrod/HASH`.

    HASH is a hash of `processor_features`. If `XDG_CACHE_HOME` is not set, `~/.cache`
    is used instead.
    """
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
    # Lines of the first core: x86 uses "flags", ARM "Features".
    wanted = ("model name", "flags", "Features", "CPU part")
    facts = [line for line in lines if line.partition(":")[0].strip() in wanted]
    first = dict(reversed([line.partition(":")[::2] for line in facts]))
    words = [
        f"{name.strip()}: {value.strip()}" for name, value in sorted(first.items())
    ]
    return "\n".join([platform.machine(), platform.processor(), *words])


def silence_false_alarms() -> None:
    """Hides XLA's lines about every program loaded from the cache. Call before JAX.

    JAX 0.10.1 writes two error lines for each program on an AMD EPYC, because it
    compares LLVM's tuning preferences (no gathers, no scatters) with the features of
    the processor. Nothing is hidden with other releases, or if `TF_CPP_MIN_LOG_LEVEL`
    is set; errors that end the process are always shown.
    """
    if "jaxlib" not in sys.modules and not os.environ.get(_LEVEL) and _is_loud():
        os.environ[_LEVEL] = "3"


def _is_loud() -> bool:
    """Whether this release of JAX raises false alarms about kept programs."""
    with suppress(metadata.PackageNotFoundError):
        return metadata.version("jaxlib") == _LOUD
    return False
