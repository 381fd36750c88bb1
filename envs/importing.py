"""A callable of somebody's own, found by `module:callable` or `file.py:callable`."""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any


class _NotThereError(ValueError):
    """There is no such module or file."""


def callable_at(where: str) -> Callable[..., Any]:
    """Imports what a path names.

    Args:
        where: `package.module:callable`, or `folder/file.py:callable` for a file that
            imports nothing from beside it. What follows the colon may have dots.

    Raises:
        ValueError: there is no such module, file or callable; it is of Python's own
            library; or importing it raises, with what it raised as the cause.
        ModuleNotFoundError: it imports something that is not installed.
    """
    place, _, name = where.rpartition(":")
    if not place or not _dotted(name):
        raise ValueError(
            "a task of your own must look like mypackage.mymodule:make_task or "
            f"folder/file.py:make_task, got {where!r}"
        )
    try:
        module = _from_file(Path(place)) if _is_file(place) else _by_name(place)
    except _NotThereError:
        raise
    except ModuleNotFoundError as error:
        said = f"importing {place} failed: {error}"
        raise ModuleNotFoundError(said, name=error.name) from error
    except Exception as error:
        raise ValueError(
            f"importing {place} raised {type(error).__name__}: {error}"
        ) from error
    try:
        found = functools.reduce(getattr, name.split("."), module)
    except AttributeError:
        raise ValueError(f"{place} has no {name!r}") from None
    if not callable(found):
        raise ValueError(f"{where} must be callable, got {found!r:.60}")
    return found


def spelt_out(where: str) -> str:
    """The same path, of a file the absolute one: valid in whatever folder."""
    place, _, name = where.rpartition(":")
    return f"{Path(place).resolve()}:{name}" if _is_file(place) else where


def _is_file(place: str) -> bool:
    return place.endswith(".py")


def _dotted(name: str) -> bool:
    return all(part.isidentifier() for part in name.split("."))


def _by_name(name: str) -> ModuleType:
    if not _dotted(name):
        raise _NotThereError(f"{name!r} is neither the name of a module nor a .py file")
    if name.partition(".")[0] in sys.stdlib_module_names:
        # What config.json names is called: not a shell, say.
        raise _NotThereError(f"{name!r} is a module of Python's own, without tasks")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        # Not what the module itself imports, that is another fault.
        if error.name and (name == error.name or name.startswith(error.name + ".")):
            raise _NotThereError(
                f"there is no module {error.name!r} where Python looks for modules"
            ) from None
        raise


def _from_file(path: Path) -> ModuleType:
    """The module in a file; the same one for the same file."""
    path = path.resolve()
    if not path.is_file():
        raise _NotThereError(f"there is no file {path}")
    digest = hashlib.sha256(str(path).encode()).hexdigest()[:8]
    # Nothing that can be imported has a name like this.
    name = f"{path.stem}@{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    # Before it runs: its dataclasses look themselves up there.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
