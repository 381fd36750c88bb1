"""Files of the checkout: where it is, its examples, and records of runs."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

from jaxrod.files import write_atomically

ROOT = Path(__file__).resolve().parents[2]
"""The checkout."""


def example(name: str) -> Any:
    """The module `examples/NAME.py`."""
    folder = ROOT / "examples"
    spec = importlib.util.spec_from_file_location(
        f"example_{name}", folder / f"{name}.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Examples import the gallery beside them, as Python lets a program do.
    sys.path.insert(0, str(folder))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
    return module


def write_record(folder: Path, name: str, record: dict[str, Any]) -> None:
    """Writes a record of a run, `NAME.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(record, indent=1) + "\n"
    write_atomically(folder / f"{name}.json", text.encode())
