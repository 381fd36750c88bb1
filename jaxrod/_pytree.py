"""Frozen dataclasses that are JAX pytrees: the whole of jaxrod's "framework"."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, TypeVar, dataclass_transform

import jax

from jaxrod._jax_version import require_sound_jax

# No rod can be made without this module.
require_sound_jax()

T = TypeVar("T")

static = partial(dataclasses.field, metadata={"static": True})
"""Field specifier for structure: part of the pytree's type, never traced."""


@dataclass_transform(
    frozen_default=True, eq_default=False, field_specifiers=(dataclasses.field, static)
)
def pytree(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass registered as a JAX pytree.

    Every field is a traced leaf (or subtree) unless it is declared with
    `static()`. Use `dataclasses.replace` to make a changed copy. Nothing is
    validated or converted on construction, because JAX also constructs pytrees
    from placeholders while it traces; factories validate instead.
    """
    frozen: Any = dataclasses.dataclass(frozen=True, eq=False)(cls)
    return jax.tree_util.register_dataclass(frozen)
