"""Compilation of kernels by LLVM to machine code of this CPU, and its call by XLA.

If JAX has a folder for compiled programs (`jax_compilation_cache_dir`), a kernel's
object code is kept in it too. Its file name is a digest of the kernel's text, of the
processor's features and of LLVM's version. A file begins with a digest of its object
code: a damaged file is ignored and the kernel compiled again. Files are written
atomically.

The digest has no key, so anyone who can write to the folder could make this process run
any code. So kernels are neither read from nor written to a folder that others can write
to. They are compiled again instead, and a warning is logged once.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import hashlib
import importlib.util
import logging
import threading
from functools import cache
from pathlib import Path
from typing import Any

import jax

from jaxrod.files import write_atomically
from jaxrod.jax_internals.foreign_call import handler_text, unknown_layout
from jaxrod.jax_internals.primitives import unknown_rules
from jaxrod.lanes.graph import OPERATIONS
from jaxrod.lanes.llvm.kernel import Kernel
from jaxrod.private_folders import (
    make_private_folder,
    read_own,
    shared_with,
)

LONG = 1_000_000
"""Length of LLVM IR from which optimisation level 1 is used instead of 2 [characters].

Adjoints, implicit steps and searches for rest are as long. Level 1 compiles them in two
thirds of the time, and they run at most 3 % slower.
"""

_LIBRARY = (
    *(row.symbol for row in OPERATIONS.values() if row.symbol is not None),
    *("fma", "fmaf", "floor", "floorf", "ceil", "ceilf", "trunc", "truncf"),
    *("round", "roundf", "roundeven", "roundevenf", "fmod", "fmodf"),
    *("memcpy", "memset", "memmove"),
)
"""Names of functions of the C library that machine code may call: those of
`OPERATIONS`, then those to which LLVM translates its own instructions."""
_engines: dict[str, Any] = {}
"""LLVM engines by name of the kernel. They are kept for the life of the process because
XLA's programs call their code."""
_lock = threading.Lock()


def llvm_is_installed() -> bool:
    """Whether llvmlite, the package with LLVM's compiler, is installed."""
    return importlib.util.find_spec("llvmlite") is not None


@cache
def not_here() -> str | None:
    """Returns the reason why kernels cannot be compiled here; `None` if they can."""
    try:
        import llvmlite.binding as llvm
    except ImportError:
        return "llvmlite is not installed (pip install 'jaxrod[lanes]')"
    words = unknown_rules() or unknown_layout()
    if words is not None:
        return words
    try:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        _target_machine()
    except RuntimeError as error:
        return f"LLVM has no code for this processor: {error}"
    missing = _name_library()
    return f"the C library has no {missing}" if missing else None


@cache
def vector_bytes() -> int:
    """Size of the widest vector registers of this processor [bytes]: 16, 32 or 64."""
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 64
    return 32 if features.get("avx") else 16


@cache
def processor() -> str:
    """Returns LLVM's version, and this processor's name and features, as one text."""
    import llvmlite.binding as llvm

    version = ".".join(map(str, llvm.llvm_version_info))
    features = llvm.get_host_cpu_features().flatten()
    return f"{version} {llvm.get_host_cpu_name()} {features}"


def compiled_kernels() -> int:
    """Number of kernels that this process has registered with XLA."""
    return len(_engines)


def registered(kernel: Kernel) -> str:
    """Compiles a kernel and registers it with XLA, unless that has been done already.

    Returns:
        The kernel's name in XLA.
    """
    digest = hashlib.sha256((processor() + kernel.text).encode()).hexdigest()[:24]
    name = f"jaxrod_lanes_{digest}"
    with _lock:
        if name in _engines:
            return name
        text = kernel.text + handler_text(name, kernel.n_operands, kernel.n_results)
        _engines[name], address = native_function(text, name)
        jax.ffi.register_ffi_target(name, capsule(address), platform="cpu")
    return name


def native_function(text: str, name: str, *, keep: bool = True) -> tuple[Any, int]:
    """Compiles an LLVM module, or reads its machine code from the cache on disk.

    Args:
        text: LLVM IR of the module.
        name: Name of a function in it.
        keep: Whether the cache on disk may be used.

    Returns:
        The engine that owns the code, and the address of the function.
    """
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(text)
    module.verify()
    level = 2 if len(text) < LONG else 1
    engine = llvm.create_mcjit_compiler(module, _target_machine(level))
    if keep:
        keeps_objects(engine, f"{processor()} {level} {text}")
    engine.finalize_object()
    return engine, engine.get_function_address(name)


def _target_machine(level: int = 2) -> Any:
    """LLVM's compiler for this processor, at an optimisation level from 0 to 3."""
    import llvmlite.binding as llvm

    target = llvm.Target.from_default_triple()
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=level,
    )


def _name_library() -> str | None:
    """Registers the addresses of C library functions with LLVM.

    Returns:
        The name of a missing function; `None` if all are there.
    """
    import llvmlite.binding as llvm

    found = ctypes.util.find_library("m")
    libraries = [ctypes.CDLL(None), *([ctypes.CDLL(found)] if found else [])]
    for name in _LIBRARY:
        for library in libraries:
            function = getattr(library, name, None)
            if function is not None:
                address = ctypes.cast(function, ctypes.c_void_p).value
                llvm.add_symbol(name, address)
                break
        else:
            return name
    return None


def capsule(address: int) -> Any:
    """Returns the address of a handler as a Python capsule, as XLA requires."""
    make = ctypes.pythonapi.PyCapsule_New
    make.restype = ctypes.py_object
    make.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return make(address, None, None)


_log = logging.getLogger("jaxrod.lanes")
_told: set[Path] = set()
"""Folders for which the warning that others can write to them has been logged."""

_DIGEST = 32
"""Size of the SHA-256 digest at the beginning of a file [bytes]."""


def keeps_objects(engine: Any, key: str) -> None:
    """Makes an LLVM engine read its object code from disk if possible, or store it.

    Args:
        engine: An engine of LLVM with a single module.
        key: Text that determines the object code: the processor, the optimisation level
            and the LLVM IR.
    """
    if folder_of_kernels() is None:
        return
    engine.set_object_cache(
        lambda module, code: write(key, code), lambda module: read(key)
    )


def read(key: str, what: str = "lanes") -> bytes | None:
    """Returns what is kept under a key, or `None`: not there, damaged, or not ours.

    The name of its file begins with `what` it is, machine code by default.
    """
    folder = folder_of_kernels()
    if folder is None:
        return None
    found = read_own(_path(folder, key, what))
    if found is None:
        return None
    content = found[_DIGEST:]
    return content if hashlib.sha256(content).digest() == found[:_DIGEST] else None


def write(key: str, content: bytes, what: str = "lanes") -> None:
    """Keeps bytes under a key, if there is a folder for them; see `read`."""
    folder = folder_of_kernels()
    if folder is None:
        return
    try:
        make_private_folder(folder)
        whole = hashlib.sha256(content).digest() + content
        write_atomically(_path(folder, key, what), whole, private=True)
    except OSError:
        # A folder that is full or read-only costs time, not results.
        return


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


def _path(folder: Path, key: str, what: str) -> Path:
    return folder / f"jaxrod-{what}-{hashlib.sha256(key.encode()).hexdigest()}"


def folder_of_kernels() -> Path | None:
    """Returns JAX's folder of compiled programs; `None` without one that is safe."""
    # JAX defines its settings at run time, so that type checkers do not know them.
    settings: Any = jax.config
    folder = settings.jax_compilation_cache_dir
    if not folder or "://" in folder or not settings.jax_enable_compilation_cache:
        return None
    return None if _is_refused(Path(folder)) else Path(folder)
