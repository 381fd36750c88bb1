"""How far a scene has come that depends on time or remembers."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Int

from jaxrod.effects.memory import Memory, memory_of, recalled
from jaxrod.effects.time import Clock, at_clock
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.structure import pytree


@pytree
class Now:
    """How far a scene has come in time."""

    step: Int[Array, ""]
    """Whole steps since time zero."""
    memory: Memory
    """Memory of the effects."""


def scene_at(scene: Scene, now: Now, fraction: ArrayLike, dt: Array) -> Scene:
    """The scene as it is a part of a step after a whole one."""
    clock = Clock(now.step, jnp.asarray(fraction, dt.dtype), dt)
    effects = at_clock(recalled(scene.effects, now.memory), clock)
    return replace(scene, effects=effects)


def memory_in(scene: Scene, state: RodState) -> Memory:
    """Memory of the effects of a scene in a state."""
    return memory_of(scene.effects) if state.memory is None else state.memory


def remembering(scene: Scene, motion: Motion, dt: Array, now: Now) -> Now:
    """One step later, with what the effects remember then."""
    effects = tuple(e.after_step(scene.rod, motion, dt) for e in scene.effects)
    memory = jax.tree.map(
        lambda new, old: jnp.asarray(new, old.dtype), memory_of(effects), now.memory
    )
    return Now(now.step + 1, memory)
