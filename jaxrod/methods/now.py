"""Step number and memory of a scene that depends on time or has memory."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Int

from jaxrod.effects.base import Memory, memory_of, recalled
from jaxrod.effects.time import Clock, at_clock
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import RodState
from jaxrod.structure import pytree


@pytree
class Now:
    """Step number and memory of effects, which integrators carry from step to step."""

    step: Int[Array, ""]
    """Number of completed steps since time zero."""
    memory: Memory
    """Current memory of the effects."""


def scene_at(scene: LoadedRod, now: Now, fraction: ArrayLike, dt: Array) -> LoadedRod:
    """Scene at the time `(now.step + fraction) * dt`, with the memory in `now`."""
    clock = Clock(now.step, jnp.asarray(fraction, dt.dtype), dt)
    effects = at_clock(recalled(scene.effects, now.memory), clock)
    return replace(scene, effects=effects)


def memory_in(scene: LoadedRod, state: RodState) -> Memory:
    """Memory that a state has, or the initial memory of the effects if it has none."""
    return memory_of(scene.effects) if state.memory is None else state.memory


def remembering(scene: LoadedRod, motion: Motion, dt: Array, now: Now) -> Now:
    """Step number plus one, and the memory after `Effect.after_step` of all effects."""
    effects = tuple(e.after_step(scene.rod, motion, dt) for e in scene.effects)
    for before, after in zip(scene.effects, effects, strict=True):
        if type(after) is not type(before):
            raise TypeError(
                f"{type(before).__name__}.after_step must return an effect of its own "
                f"class, got {type(after).__name__}"
            )
    return Now(now.step + 1, _alike(memory_of(effects), now.memory))


def _alike(new: Memory, old: Memory) -> Memory:
    """New memory, converted to the dtypes of the old one.

    Raises:
        TypeError: If shapes differ, or integers have become floating-point numbers.
    """
    before, after = jax.tree.leaves_with_path(old), jax.tree.leaves_with_path(new)
    if [path for path, _ in before] != [path for path, _ in after]:
        raise TypeError("after_step must keep the structure of the memory")
    for (path, was), (_, is_now) in zip(before, after, strict=True):
        name = path[1].key
        if was.shape != is_now.shape:
            raise TypeError(
                f"after_step must keep the shape of {name}, which was {was.shape}, got "
                f"{is_now.shape}"
            )
        whole = not jnp.issubdtype(was.dtype, jnp.floating)
        if whole and jnp.issubdtype(is_now.dtype, jnp.floating):
            raise TypeError(
                f"after_step makes a number of {name}, which began as {was.dtype}: "
                "begin with 0.0"
            )
    return jax.tree.map(lambda was, is_now: is_now.astype(was.dtype), old, new)
