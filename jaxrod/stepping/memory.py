"""Initial memory of a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from jaxrod.composite import Composite
from jaxrod.effects.memory import memory_of
from jaxrod.rods.rod import RodState
from jaxrod.scene import Model, check_scene
from jaxrod.validation import check_kind


def with_memory(scene: Model, state: Any) -> Any:
    """State with the initial memory of the scene's effects, if it has none yet.

    Runs do this themselves. A loop that you write (`jax.lax.scan`) and `freeze` need it
    before the first run, so that states before and after it have the same structure.

    Args:
        scene: The scene.
        state: A state of its rod.
    """
    if isinstance(scene, Composite):
        return scene.with_memory(state)
    check_scene(scene)
    check_kind("state", state, RodState)
    if state.memory is not None or not scene.remembers:
        return state
    return replace(state, memory=memory_of(scene.effects))
