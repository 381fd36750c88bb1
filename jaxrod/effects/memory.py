"""Memory of effects from step to step: fields declared with `memory()`.

The values are part of the state, `RodState.memory`; the scene has their initial values.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.effects.base import Effect

Memory = tuple[dict[str, Any], ...]
"""Fields declared with `memory()`, by name, for each effect of a scene."""


def memory_fields(effect: Effect) -> list[str]:
    """Names of the fields of an effect that are memory."""
    fields: tuple[dataclasses.Field[Any], ...] = ()
    if dataclasses.is_dataclass(type(effect)):
        # An effect is a dataclass by its decorator, but its type does not show that.
        fields = dataclasses.fields(type(effect))  # type: ignore[arg-type]
    return [field.name for field in fields if field.metadata.get("memory")]


def remembers(effects: tuple[Effect, ...]) -> bool:
    """Whether any effect has memory."""
    return any(map(memory_fields, effects))


def memory_of(effects: tuple[Effect, ...]) -> Memory:
    """Memory of the effects, as arrays."""
    return tuple(
        {
            name: jax.tree.map(jnp.asarray, getattr(effect, name))
            for name in memory_fields(effect)
        }
        for effect in effects
    )


def recalled(effects: tuple[Effect, ...], memory: Memory) -> tuple[Effect, ...]:
    """The effects with the given memory."""
    # An effect with memory is a dataclass, but its type does not show that.
    return tuple(
        dataclasses.replace(effect, **values) if values else effect  # type: ignore[type-var]
        for effect, values in zip(effects, memory, strict=True)
    )


def stirred(memory: Memory) -> Memory:
    """Memory with arbitrary values, to test how effects depend on it."""

    def other(leaf: Any) -> Any:
        inexact = jnp.issubdtype(leaf.dtype, jnp.floating)
        return leaf + jnp.asarray(0.739, leaf.dtype) if inexact else leaf

    return jax.tree.map(other, memory)
