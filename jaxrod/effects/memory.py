"""Memory of effects from step to step: values of fields declared with `memory()`.

They are part of the state, `RodState.memory`; the scene has their initial values.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.effects.base import Effect

Memory = tuple[dict[str, Any], ...]
"""Values of fields declared with `memory()`, by name, for each effect of a scene."""


def memory_fields(effect: Effect) -> list[str]:
    """Names of the fields of an effect that are declared with `memory()`."""
    fields: tuple[dataclasses.Field[Any], ...] = ()
    if dataclasses.is_dataclass(type(effect)):
        # An effect is a dataclass by its decorator, but its type does not show that.
        fields = dataclasses.fields(type(effect))  # type: ignore[arg-type]
    return [field.name for field in fields if field.metadata.get("memory")]


def remembers(effects: tuple[Effect, ...]) -> bool:
    """Whether any effect has a field declared with `memory()`."""
    return any(map(memory_fields, effects))


def memory_of(effects: tuple[Effect, ...]) -> Memory:
    """Present values of the memory fields of all effects, as arrays."""
    return tuple(
        {
            name: jax.tree.map(jnp.asarray, getattr(effect, name))
            for name in memory_fields(effect)
        }
        for effect in effects
    )


def recalled(effects: tuple[Effect, ...], memory: Memory) -> tuple[Effect, ...]:
    """Effects with the values of their memory fields set to `memory`."""
    # An effect with memory is a dataclass, but its type does not show that.
    return tuple(
        dataclasses.replace(effect, **values) if values else effect  # type: ignore[type-var]
        for effect, values in zip(effects, memory, strict=True)
    )


def stirred(memory: Memory) -> Memory:
    """Memory with 0.739 added to real numbers, to test which effects depend on it."""

    def other(leaf: Any) -> Any:
        inexact = jnp.issubdtype(leaf.dtype, jnp.floating)
        return leaf + jnp.asarray(0.739, leaf.dtype) if inexact else leaf

    return jax.tree.map(other, memory)
