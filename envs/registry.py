"""Environments by name, imported only when asked for."""

from __future__ import annotations

import importlib
from typing import Any

from jaxrod.envs.protocol import Environment

_FACTORIES = {
    "reaching": "jaxrod.envs.reaching:reaching",
    "structured": "jaxrod.envs.structured_obstacles:structured_obstacles",
    "tracking": "jaxrod.envs.tracking:tracking",
    "trivial": "jaxrod.envs.trivial:Trivial",
    "unstructured": "jaxrod.envs.unstructured_nest:unstructured_nest",
}


def names() -> tuple[str, ...]:
    """Returns the names that `make` knows, sorted."""
    return tuple(sorted(_FACTORIES))


def make(name: str, **options: Any) -> Environment:
    """Makes the environment called `name`.

    Args:
        name: one of `names()`.
        **options: handed to the environment's factory, for example
            `variant="paper"` for `"tracking"`.

    Raises:
        ValueError: nothing is registered under this name.
    """
    if name not in _FACTORIES:
        known = ", ".join(names())
        raise ValueError(f"name must be one of {known}; got {name!r}")
    module, factory = _FACTORIES[name].split(":")
    return getattr(importlib.import_module(module), factory)(**options)
