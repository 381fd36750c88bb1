"""Counts the files that a scene enters on its way from `advance` to its first step.

    python tests/walk_of_a_scene.py

A file is entered when a function in it has a scene among its arguments. The way goes
through all checks, that of the step against the stability bound included, and ends
where the stepper of the scene begins. Nothing has been compiled before.
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

import jaxrod
from jaxrod.loaded_rod import LoadedRod

ROOT = Path(jaxrod.__file__).parent


def files_entered() -> dict[str, int]:
    """Files that a scene enters, in order, and how often, from `advance` to `begin`."""
    rod, state = jaxrod.straight_rod(
        13, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e7
    )
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
    dt = 1e-5
    entered: dict[str, int] = {}
    begun = False

    def look(frame: Any, event: str, _: Any) -> None:
        nonlocal begun
        if event != "call" or begun:
            return
        path = Path(frame.f_code.co_filename)
        if ROOT not in path.parents:
            return
        if frame.f_code.co_name == "begin":
            begun = True
            return
        code = frame.f_code
        # Pytrees are taken apart and put together by JAX; that is not a stay.
        if code.co_name in ("flatten", "flatten_with_keys", "unflatten"):
            return
        named = code.co_argcount + code.co_kwonlyargcount
        listed = bool(code.co_flags & inspect.CO_VARARGS)
        given = [frame.f_locals.get(n) for n in code.co_varnames[: named + listed]]
        if listed:
            given += given.pop()
        if any(isinstance(value, LoadedRod) for value in given):
            name = str(path.relative_to(ROOT.parent))
            entered[name] = entered.get(name, 0) + 1

    sys.setprofile(look)
    try:
        jaxrod.advance(scene, state, dt, 10)
    finally:
        sys.setprofile(None)
    assert begun
    return entered


def main() -> None:
    """Prints the number and the files."""
    entered = files_entered()
    print(f"{len(entered)} files, {sum(entered.values())} stays")
    for name, stays in entered.items():
        print(f"  {name}: {stays}")


if __name__ == "__main__":
    main()
