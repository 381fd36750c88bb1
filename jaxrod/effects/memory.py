"""Memory of effects from step to step: fields declared with `memory()`.

The values are part of the state, `RodState.memory`; those in the scene are what they
begin with.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.effects.base import Effect

Memory = tuple[tuple[Any, ...], ...]
"""Of each effect of a scene, the values of its fields declared with `memory()`."""


def _names(effect: Effect) -> list[str]:
    """Fields of an effect that it remembers."""
    fields: tuple[dataclasses.Field[Any], ...] = ()
    if dataclasses.is_dataclass(type(effect)):
        fields = dataclasses.fields(type(effect))  # type: ignore[arg-type]
    return [field.name for field in fields if field.metadata.get("memory")]


def remembers(effects: tuple[Effect, ...]) -> bool:
    """Whether any effect has something to remember."""
    return any(map(_names, effects))


def memory_of(effects: tuple[Effect, ...]) -> Memory:
    """Memory of the effects, as arrays."""
    return tuple(
        tuple(jax.tree.map(jnp.asarray, getattr(effect, n)) for n in _names(effect))
        for effect in effects
    )


def recalled(effects: tuple[Effect, ...], memory: Memory) -> tuple[Effect, ...]:
    """The effects with other memories."""
    return tuple(
        dataclasses.replace(effect, **dict(zip(names, values, strict=True)))  # type: ignore[type-var]
        if (names := _names(effect))
        else effect
        for effect, values in zip(effects, memory, strict=True)
    )
