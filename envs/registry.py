"""Environments by name, imported only when asked for."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

from jaxrod.envs.protocol import Environment

_FACTORIES = {
    "reaching": "jaxrod.envs.tasks.reaching:reaching",
    "structured": "jaxrod.envs.tasks.structured_obstacles:structured_obstacles",
    "tracking": "jaxrod.envs.tasks.tracking:tracking",
    "trivial": "jaxrod.envs.trivial:Trivial",
    "unstructured": "jaxrod.envs.tasks.unstructured_nest:unstructured_nest",
}


def names() -> tuple[str, ...]:
    """Returns the names that `make` knows, sorted."""
    return tuple(sorted(_FACTORIES))


def make(name: str, /, **options: Any) -> Environment:
    """Makes the environment called `name`.

    Args:
        name: one of `names()`.
        **options: handed to the environment's factory, for example
            `variant="paper"` for `"tracking"`.

    Raises:
        ValueError: nothing is registered under this name, or what is has no such
            option.
    """
    if name not in _FACTORIES:
        known = ", ".join(names())
        raise ValueError(f"name must be one of {known}; got {name!r}")
    module, factory = _FACTORIES[name].split(":")
    build = getattr(importlib.import_module(module), factory)
    known_options = inspect.signature(build).parameters
    for option in options:
        if option not in known_options:
            raise ValueError(
                f"{name!r} has no option {option!r}, it has {', '.join(known_options)}"
            )
    return build(**options)
