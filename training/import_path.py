"""Import paths `module:NAME`, by which a run records and finds a user's code."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

from jaxrod.envs.importing import check_home, check_trusted


def find_object(path: str, trust: Collection[str] | None = None) -> Any:
    """Imports the object at an import path.

    Modules are also searched in the current folder.

    Args:
        path: `module:NAME`, such as "my_package.learners:MY_ALGORITHM"; NAME is one
            plain name, without dots.
        trust: Modules that may be imported if the path was read from a file, see
            `jaxrod.envs.importing.check_trusted`; None if the user typed the path.

    Raises:
        ValueError: `path` is no import path.
        UntrustedError: The path was read from a file and its module is not trusted.
        ImportError: There is no such module or object, or importing it failed.
    """
    name, colon, attribute = path.partition(":")
    if not (name and colon and attribute.isidentifier()):
        raise ValueError(f"an import path is module:NAME, got {path!r}")
    if trust is not None:
        check_trusted(path, trust)
    module = _import(name, path)
    try:
        found = getattr(module, attribute)
    except AttributeError:
        raise ImportError(f"{path}: module {name} has no {attribute}") from None
    if trust is not None:
        check_home(path, found, module, trust)
    return found


def import_path(value: Any) -> str | None:
    """Import path `module:NAME` of a function or class, None if no path leads to it.

    If its module is run as a script, the module's name is that of the file.
    """
    module = getattr(value, "__module__", None)
    name = getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str):
        return None
    return _path(module, name, value)


def import_path_in(module: str, value: Any) -> str | None:
    """Import path of a variable of a module, None if no variable holds `value`."""
    held = getattr(sys.modules.get(module), "__dict__", {})
    names = [name for name, one in held.items() if one is value]
    return _path(module, names[0], value) if names else None


def _path(module: str, name: str, value: Any) -> str | None:
    if not name.isidentifier():  # Names in a class or function, and lambdas.
        return None
    try:
        found = getattr(sys.modules[module], name)
    except (AttributeError, KeyError):
        return None
    importable = _importable(module)
    return f"{importable}:{name}" if found is value and importable else None


def _importable(module: str) -> str | None:
    """Name by which another process can import a module, None if it cannot."""
    if module != "__main__":
        return module
    main = sys.modules["__main__"]
    spec = getattr(main, "__spec__", None)
    if spec is not None:  # python -m package.module
        return spec.name
    file = getattr(main, "__file__", None)
    return Path(file).stem if file else None


def _import(name: str, path: str) -> Any:
    if _importable("__main__") == name:
        return sys.modules["__main__"]  # A second import would make new objects.
    here = os.getcwd()
    sys.path.append(here)
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name and f"{name}.".startswith(f"{error.name}."):
            raise ImportError(
                f"{path}: there is no module {error.name}, neither installed nor in "
                f"{here}"
            ) from None
        raise
    except ImportError:
        raise
    except Exception as error:
        raise ImportError(
            f"{path}: importing {name} failed: {type(error).__name__}: {error}"
        ) from error
    finally:
        sys.path.remove(here)
