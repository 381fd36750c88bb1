"""Reactions: loads of supports that hold or drive a rod."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxrod.analysis.accelerations import total_loads
from jaxrod.effects.base import Reaction
from jaxrod.loaded_rod import LoadedRod, scene_of
from jaxrod.rods.motion import Loads, motion_of
from jaxrod.rods.rod import RodState


def reactions(scene: LoadedRod, state: RodState) -> tuple[Reaction | None, ...]:
    """Forces, couples and power of every support of a scene, in order of its effects.

    The force on a held node is its mass times its acceleration minus all other loads on
    it. Power is the power of a driven end on the rod: total energy grows at this rate,
    minus the power of damping. If two effects hold one node, each reports the whole
    force.

    Args:
        scene: The scene, under the consistent law; if it depends on time, the scene at
            the time of the state, `scene.at(time)`.
        state: The state.

    Returns:
        One reaction for each effect; `None` for effects that hold nothing.

    Raises:
        ValueError: If the law is another one, the scene depends on time, or the state
            is not of its rod.
        TypeError: If `scene` or `state` is of another type.

    Example:
        >>> wall = jaxrod.reactions(scene, state)[0]
        >>> round(float(wall.force[2]), 3)  # so far the weight of the first node [N]
        0.616
    """
    scene = scene_of(scene, state)
    if not scene.method.has_energy:
        raise ValueError(f"reactions need the consistent law, got {scene.method!r}")
    return _reactions(scene, state)


@jax.jit
def _reactions(scene: LoadedRod, state: RodState) -> tuple[Reaction | None, ...]:
    rod, motion = scene.rod, motion_of(state)
    total = total_loads(scene, motion)
    assert total.forces is not None and total.couples is not None
    x, y, z = (jnp.negative(component) for component in total.forces)
    a, b, c = (jnp.negative(component) for component in total.couples)
    needed = Loads((x, y, z), (a, b, c))
    return tuple(effect.reaction(rod, motion, needed) for effect in scene.effects)
