"""Commands whose programs are in the folder `benchmarks` of a checkout.

They run the published grid and compare with other simulators. They are useful for
people who work on jaxrod, and are not installed. A program is a module with the same
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
    "reproduce": "benchmarks.paper.run",
    "tradeoff": "benchmarks.tradeoff.run",
    "benchmark": "benchmarks.rod_steps.run",
}


class NoCheckoutError(ImportError):
    """The package is not installed from a checkout."""


def program(command: str) -> ModuleType:
    """Imports the module of a command.

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
        # Imported by its path: the current folder may have its own `benchmarks`.
        place = root / package / "__init__.py"
        spec = importlib.util.spec_from_file_location(package, place)
        assert spec is not None and spec.loader is not None
        sys.modules[package] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[package])
    return importlib.import_module(name)
