"""Reactions: loads of supports that hold or drive a rod."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxrod.effects.base import Reaction
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.loaded_rod import LoadedRod, damping_rates, external_loads, scene_of
from jaxrod.rods.elasticity import elastic_law, internal_loads
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
    """
    scene = scene_of(scene, state)
    if not scene.method.has_energy:
        raise ValueError(f"reactions need the consistent law, got {scene.method!r}")
    return _reactions(scene, state)


@jax.jit
def _reactions(scene: LoadedRod, state: RodState) -> tuple[Reaction | None, ...]:
    rod, motion = scene.rod, motion_of(state)
    internal = internal_loads(elastic_law(rod), motion)
    assert internal.forces is not None and internal.couples is not None
    total = external_loads(scene, motion, internal.forces, internal.couples)
    assert total.forces is not None and total.couples is not None
    forces, couples = total.forces, total.couples
    rates = damping_rates(scene)
    if rates is not None:
        frame = directors(motion.orientation)
        drag = vectors.scale(rates[0] * rod.node_masses, motion.velocity)
        forces = vectors.subtract(forces, drag)
        spin = to_material(frame, vectors.scale(rates[1], motion.spin))
        couples = vectors.subtract(couples, spin)
    x, y, z = (jnp.negative(component) for component in forces)
    a, b, c = (jnp.negative(component) for component in couples)
    needed = Loads((x, y, z), (a, b, c))
    return tuple(effect.reaction(rod, motion, needed) for effect in scene.effects)
