r"""Dynamics of a state under the consistent law: loads, accelerations, reactions.

All forces $f$ on nodes of mass $m$ and couples $c$ on elements with frames $R$, damping
included, give $\dot v = f/m$ and $\dot P = Rc$ with the angular momentum $P$. Supports
then set the accelerations of the components that they hold. Their reactions are the
loads required for this.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, overload

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.effects.base import Reaction
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    directors,
    multiply_quaternions,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import (
    LoadedRod,
    MassCoupling,
    damping_rates,
    dissipate,
    dissipates,
    external_loads,
    scene_of,
)
from jaxrod.methods.drag_kick import drag_on, without_drag
from jaxrod.model import Model, check_model
from jaxrod.rods.drag import drag_loads
from jaxrod.rods.elasticity import elastic_law, internal_loads
from jaxrod.rods.motion import Loads, Motion, accumulate, motion_of
from jaxrod.rods.rod import RodState


def total_loads(scene: LoadedRod, motion: Motion) -> Loads:
    """All loads under the consistent law, including the damping by decay rates.

    Returns:
        Forces on nodes (world frame) [N], couples on elements (material frame) [N m].
    """
    internal = internal_loads(elastic_law(scene.rod), motion)
    assert internal.forces is not None and internal.couples is not None
    coupling = MassCoupling.of(scene.rod)
    if coupling is None:
        total = external_loads(scene, motion, internal.forces, internal.couples)
    else:
        dry = without_drag(scene)
        total = external_loads(dry, motion, internal.forces, internal.couples)
        assert total.forces is not None and total.couples is not None
        # As in a step, damping and drag slow every node by itself.
        forces = coupling.forces(scene, motion, total.forces)
        couples = total.couples
        drag = drag_on(scene, motion)
        if drag is not None:
            slowed = drag_loads(scene.rod, motion, drag)
            forces = accumulate(forces, slowed.forces)
            couples = accumulate(couples, slowed.couples)
        total = Loads(forces, couples)
    rates = damping_rates(scene)
    if rates is None:
        return total
    assert total.forces is not None and total.couples is not None
    slowing = vectors.scale(rates[0] * scene.rod.node_masses, motion.velocity)
    frame = directors(motion.orientation)
    braking = to_material(frame, vectors.scale(rates[1], motion.spin))
    return Loads(
        vectors.subtract(total.forces, slowing),
        vectors.subtract(total.couples, braking),
    )


def rates_of_change(scene: LoadedRod, motion: Motion) -> Motion:
    """Time derivative of a motion, in which spins are angular momenta.

    Damping by `Effect.dissipate` counts with its rate in an infinitesimal step. A
    filter that removes the same fraction at every step, however short, has no such
    rate.
    """
    # A barrier: without it XLA's CPU compiler fuses the loads with all that follows.
    total = lax.optimization_barrier(total_loads(scene, motion))
    assert total.forces is not None and total.couples is not None
    change = Motion(
        position=motion.velocity,
        orientation=_turning(motion.orientation, motion.angular_velocities(scene.rod)),
        velocity=vectors.scale(1 / scene.rod.node_masses, total.forces),
        spin=to_world(directors(motion.orientation), total.couples),
        remainder=jax.tree.map(jnp.zeros_like, motion.remainder),
    )
    if dissipates(scene):
        one = jnp.ones((), change.velocity[0].dtype)
        _, slowed = jax.jvp(lambda dt: dissipate(scene, motion, dt), (0 * one,), (one,))
        change = replace(
            change,
            velocity=vectors.add(change.velocity, slowed.velocity),
            spin=vectors.add(change.spin, slowed.spin),
        )
    for effect in scene.effects:
        change = effect.constrain_accelerations(scene.rod, motion, change)
    return change


def _turning(orientation: Quaternion, spin: Vec3) -> Quaternion:
    """Time derivative of quaternions, 1/2 (0, w) q, with w in the world frame."""
    half = vectors.scale(0.5, spin)
    return multiply_quaternions((jnp.zeros_like(half[0]), *half), orientation)


@overload
def reactions(scene: LoadedRod, state: RodState) -> tuple[Reaction | None, ...]: ...


@overload
def reactions(scene: Model, state: Any) -> Any: ...


def reactions(scene: Any, state: Any) -> Any:
    """Forces, couples and power of every support of a scene, in order of its effects.

    The force on a held node is its mass times its acceleration minus all other loads on
    it. Power is the power of a driven end on the rod: total energy grows at this rate,
    minus the power of damping. If two effects hold one node, each reports the whole
    force.

    Supports of a system's rods also bear what joints, ties, attachments and contact put
    on the rods. The result, a `SystemReactions`, has these loads too.

    Args:
        scene: The scene or the system, with the consistent law (any method but
            `pyelastica()`); if it depends on time, the scene at the time of the state,
            `scene.at(time)`.
        state: The state.

    Returns:
        One reaction for each effect; `None` for effects that hold nothing. For a system
        a `SystemReactions`.

    Raises:
        ValueError: If the scene has PyElastica's law or depends on time, or the state
            does not match its rod.
        TypeError: If `scene` or `state` has the wrong type.

    Example:
        >>> wall = jaxrod.reactions(scene, state)[0]
        >>> round(float(wall.force[2]), 3)  # so far the weight of the first node [N]
        0.616
    """
    check_model(scene)
    return scene.reactions(state)


def scene_reactions(scene: LoadedRod, state: RodState) -> tuple[Reaction | None, ...]:
    """Reactions of the supports of one rod; see `reactions`."""
    scene = scene_of(scene, state)
    if not scene.method.has_energy:
        raise ValueError(f"reactions need the consistent law, got {scene.method!r}")
    return reactions_of(scene, state)


@jax.jit
def reactions_of(scene: LoadedRod, state: RodState) -> tuple[Reaction | None, ...]:
    """Reactions of a scene; the caller has checked it and its state."""
    rod, motion = scene.rod, motion_of(state)
    total = total_loads(scene, motion)
    assert total.forces is not None and total.couples is not None
    x, y, z = (jnp.negative(component) for component in total.forces)
    a, b, c = (jnp.negative(component) for component in total.couples)
    needed = Loads((x, y, z), (a, b, c))
    return tuple(effect.reaction(rod, motion, needed) for effect in scene.effects)
