"""Loads the programs of the folder examples/ by name."""

import importlib.util
import sys
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "examples"


def load(name):
    """The module of an example; its main part does not run."""
    spec = importlib.util.spec_from_file_location(
        f"example_{name}", FOLDER / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    # Scenes import the gallery beside them, as Python lets a program do.
    sys.path.insert(0, str(FOLDER))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module
