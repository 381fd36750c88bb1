"""Dotted paths of parameters, such as "arm.rod.radii" or "effects.0.stiffness"."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

import jax


def dotted(path: Any) -> str:
    """Dotted path of a leaf, from a path as JAX returns them."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def by_path(tree: Any) -> dict[str, Any]:
    """Leaves of a pytree by their dotted paths."""
    return {dotted(path): leaf for path, leaf in jax.tree.leaves_with_path(tree)}


def is_below(path: str, above: str) -> bool:
    """Whether a path is `above`, or leads to something inside it."""
    return f"{path}.".startswith(f"{above}.")


def nearest(path: str, known: Iterable[str]) -> str:
    """Up to five known paths that are inside a path, or spelt like it, as text."""
    names = list(known)
    inside = [name for name in names if is_below(name, path)]
    return ", ".join((inside or difflib.get_close_matches(path, names, 5, 0.0))[:5])
