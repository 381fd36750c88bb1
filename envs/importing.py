"""Import of a user's own code from `module:NAME` or `file.py:callable`.

An import path that the user types is trusted. An import path in a saved file may come
from anybody. It is imported only if the user trusts its module (`check_trusted`). A
list of everything that is too dangerous to call could never be complete, so there is a
list of allowed modules instead. It is empty by default.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import os
import shlex
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from types import ModuleType
from typing import Any

from jaxrod.files import UntrustedError

_BEING_IMPORTED: list[str] = []
"""Modules and files whose import has begun and not ended."""


class NotThereError(ValueError):
    """Error: the module or file of an import path does not exist."""


class _TopLevelError(ValueError):
    """Error: a module trains while it is imported."""


def import_callable(
    where: str, trust: Collection[str] | None = None
) -> Callable[..., Any]:
    """Imports the callable at an import path.

    Args:
        where: `package.module:callable`, or `folder/file.py:callable` for a file that
            imports nothing from its own folder. One plain name follows the colon.
        trust: Trusted modules, for a path from a file, see `check_trusted`; None for a
            path that the user typed.

    Raises:
        ValueError: There is no such module, file or callable; it belongs to Python's
            standard library; or importing it raises, with that exception as the cause.
        UntrustedError: See `check_trusted` and `check_home`.
        ModuleNotFoundError: It imports something that is not installed.
    """
    if trust is not None:
        check_trusted(where, trust)
    place, _, name = where.rpartition(":")
    if not place or not name.isidentifier():
        raise ValueError(
            "a task of your own must look like mypackage.mymodule:make_task or "
            f"folder/file.py:make_task, got {where!r}"
        )
    _BEING_IMPORTED.append(place)
    try:
        module = _from_file(Path(place)) if _is_file(place) else _by_name(place)
    except (NotThereError, _TopLevelError):
        raise
    except ModuleNotFoundError as error:
        said = f"importing {place} failed: {error}"
        raise ModuleNotFoundError(said, name=error.name) from error
    except Exception as error:
        raise ValueError(
            f"importing {place} raised {type(error).__name__}: {error}"
        ) from error
    finally:
        _BEING_IMPORTED.pop()
    try:
        found = getattr(module, name)
    except AttributeError:
        own = [
            thing
            for thing, value in vars(module).items()
            if callable(value) and getattr(value, "__module__", "") == module.__name__
        ]
        there = f"; it has {', '.join(own[:8])}" if own else ""
        raise ValueError(f"{place} has no {name!r}{there}") from None
    if not callable(found):
        raise ValueError(f"{where} must be callable, got {found!r:.60}")
    if trust is not None:
        check_home(where, found, module, trust)
    return found


def refuse_while_importing(what: str) -> None:
    """Raises an error if a module is just being imported because it makes a task.

    A script that trains at its top level would otherwise train again each time that a
    command looks for its task.

    Args:
        what: The function that is called, for the message.

    Raises:
        ValueError: A module is being imported.
    """
    if _BEING_IMPORTED:
        raise _TopLevelError(
            f"{_BEING_IMPORTED[-1]} calls {what} when it is imported; move the call "
            'below a line `if __name__ == "__main__":`'
        )


def check_trusted(where: str, trust: Collection[str]) -> None:
    """Refuses an import path from a file, unless the user trusts its module.

    Nothing is imported here. Trust in a package does not extend to its modules. Trust
    in a module does not extend to its package, although importing the module runs the
    package's `__init__.py`.

    Args:
        where: `package.module:NAME` or `folder/file.py:NAME`, with one plain name.
        trust: Full dotted names of modules; paths of .py files; or single import paths
            such as `package.module:NAME`.

    Raises:
        UntrustedError: `where` is not an import path, or its module is not trusted or
            belongs to Python's standard library.
        ValueError: `trust` is a string instead of a tuple.
    """
    if isinstance(trust, str):
        raise ValueError(f"trust must be a tuple of names, such as ({trust!r},)")
    place, _, name = where.rpartition(":")
    if not place or not name.isidentifier():
        raise UntrustedError(
            f"{where!r} is not imported: it must be module:NAME or file.py:NAME, and "
            "NAME one plain name without dots"
        )
    if not _is_file(place) and not _dotted(place):
        raise UntrustedError(
            f"{where!r} is not imported: {place!r} is neither the name of a module nor "
            "a .py file"
        )
    if _is_standard(place):
        raise UntrustedError(
            f"{where!r} is not imported: {place.partition('.')[0]!r} is a module of "
            "Python's standard library, which no file may name"
        )
    if where in trust or place in trust:
        return
    if _is_file(place):
        place = str(Path(place).resolve())
        if any(_is_file(one) and str(Path(one).resolve()) == place for one in trust):
            return
    raise UntrustedError(
        f"{where!r} is not part of jaxrod, and jaxrod does not run code only because a "
        f"file names it. If you trust {place}, pass --trust {shlex.quote(place)}, in "
        f"Python trust=({place!r},)"
    )


def check_home(
    where: str, found: Any, module: ModuleType, trust: Collection[str]
) -> None:
    """Refuses a callable that a trusted module only imports from another package.

    A user's module may well begin with `from os import system`; trust in the module
    does not extend to that function.

    Args:
        where: The import path.
        found: Callable found at the path.
        module: Module in which it was found.
        trust: See `check_trusted`; a single import path is always trusted.

    Raises:
        UntrustedError: It is a function or class of another package.
    """
    if where in trust or not (inspect.isroutine(found) or isinstance(found, type)):
        return
    home = getattr(found, "__module__", None) or "builtins"
    if home.partition(".")[0] != module.__name__.partition(".")[0]:
        raise UntrustedError(
            f"jaxrod does not run {where!r} only because a file names it: it is part "
            f"of {home}, and the trusted module has only imported it. If you trust it, "
            f"pass --trust {shlex.quote(where)}, in Python trust=({where!r},)"
        )


def canonical_path(where: str) -> str:
    """Import path with an absolute file name, so that it is valid in every folder."""
    place, _, name = where.rpartition(":")
    return f"{Path(place).resolve()}:{name}" if _is_file(place) else where


def _is_file(place: str) -> bool:
    return place.endswith(".py")


def _is_standard(place: str) -> bool:
    return place.partition(".")[0] in sys.stdlib_module_names


def _dotted(name: str) -> bool:
    return all(part.isidentifier() for part in name.split("."))


def _by_name(name: str) -> ModuleType:
    if not _dotted(name):
        raise NotThereError(f"{name!r} is neither the name of a module nor a .py file")
    if _is_standard(name):
        raise NotThereError(f"{name!r} is a module of Python's library, without tasks")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        # A failed import inside the module itself is a different error.
        if error.name and (name == error.name or name.startswith(error.name + ".")):
            raise NotThereError(
                f"there is no module {error.name!r} where Python looks for modules"
            ) from None
        raise


def _from_file(path: Path) -> ModuleType:
    """Imports the module in a file; later calls return the same module object."""
    path = path.resolve()
    if not path.is_file():
        raise NotThereError(f"there is no file {path}")
    digest = hashlib.sha256(str(path).encode()).hexdigest()[:8]
    # No importable module has a name like this.
    name = f"{path.stem}@{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    # The module is registered before it runs, because its dataclasses look it up there.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def find_object(path: str, trust: Collection[str] | None = None) -> Any:
    """Imports the object at an import path.

    Modules are also searched in the current folder.

    Args:
        path: `module:NAME`, such as "my_package.learners:MY_ALGORITHM"; NAME is one
            plain name, without dots.
        trust: Modules that may be imported if the path was read from a file, see
            `jaxrod.envs.importing.check_trusted`; None if the user typed the path.

    Raises:
        ValueError: `path` is not an import path.
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


def import_path(value: Any, of_file: bool = False) -> str | None:
    """Import path `module:NAME` of a function or class, None if no path leads to it.

    Args:
        value: The function or class.
        of_file: Whether the path of a script is `/folder/file.py:NAME`, which is valid
            in every folder; otherwise the script's module has the name of the file.
    """
    module = getattr(value, "__module__", None)
    name = getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str):
        return None
    path = _path(module, name, value)
    if path is None or not of_file or (_dotted(module) and module != "__main__"):
        return path
    main = sys.modules[module]
    if module == "__main__" and main.__spec__ is not None:  # python -m package.module
        return path
    file = Path(main.__file__ or "").resolve()
    return f"{file}:{name}" if _is_file(str(file)) else None


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
