"""Commands whose programs a checkout has in its folder `benchmarks`.

They run the published grid and compare with other simulators: of use to whoever works
on jaxrod, and not part of what is installed. A program is a module with the same
docstring, `add_arguments` and `run` as the commands of `jaxrod.cli`.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import jaxrod

PROGRAMS = {
    "reproduce": "benchmarks.paper.command",
    "tradeoff": "benchmarks.tradeoff.command",
    "benchmark": "benchmarks.rod_steps.command",
}


class NoCheckoutError(ImportError):
    """The package is not installed from a checkout."""


def program(command: str) -> ModuleType:
    """The module of a command.

    Args:
        command: One of `PROGRAMS`.

    Raises:
        NoCheckoutError: There is no checkout around the package.
    """
    root = Path(jaxrod.__file__).resolve().parents[1]
    name = PROGRAMS[command]
    if not root.joinpath(*name.split(".")).with_suffix(".py").is_file():
        raise NoCheckoutError(
            f"`jaxrod {command}` is a program of the folder benchmarks/ of jaxrod's "
            "repository, which is not installed: clone the repository, and in it "
            "`pip install -e .`"
        )
    package, _, _ = name.partition(".")
    if package not in sys.modules:
        # By its place: the current folder may well have `benchmarks` of its own.
        place = root / package / "__init__.py"
        spec = importlib.util.spec_from_file_location(package, place)
        assert spec is not None and spec.loader is not None
        sys.modules[package] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[package])
    return importlib.import_module(name)
