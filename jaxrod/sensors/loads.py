"""Sensors of loads on a rod: of supports, tendons, chambers and contact."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.actuation.chambers import Chamber, WoundChamber
from jaxrod.actuation.tendons import Tendon
from jaxrod.analysis.dynamics import reactions
from jaxrod.effects.base import Reaction
from jaxrod.effects.ends import End, check_end
from jaxrod.geometry import vectors
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.elasticity import elastic_law, internal_loads
from jaxrod.rods.motion import Loads, accumulate, motion_of
from jaxrod.rods.rod import RodState
from jaxrod.sensors.sensor import Sensor
from jaxrod.structure import pytree, static
from jaxrod.validation import check_count, check_kind


@pytree
class SupportForce(Sensor):
    """Sensor of the force of the supports at an end, made by `support_force`.

    Example:
        >>> cell = sensors.support_force("base")
        >>> cell.shape(scene), cell.unit
        ((3,), 'N')
    """

    unit: ClassVar[str] = "N"
    end: End = static(default="base")
    """End of the rod that is held, "base" or "tip"."""
    name: str = static(default="support force")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3"]:
        """Force of the supports on the end of the rod, world frame [N]."""
        held = _reactions_at(self.end, scene, state)
        return jnp.sum(jnp.stack([reaction.force for reaction in held]), axis=0)


@pytree
class SupportCouple(Sensor):
    """Sensor of the couple of the supports at an end, made by `support_couple`.

    Example:
        >>> cell = sensors.support_couple("base")
        >>> cell.shape(scene), cell.unit
        ((3,), 'N m')
    """

    unit: ClassVar[str] = "N m"
    end: End = static(default="base")
    """End of the rod that is held, "base" or "tip"."""
    name: str = static(default="support couple")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3"]:
        """Couple of the supports on the end of the rod, world frame [N m]."""
        held = _reactions_at(self.end, scene, state)
        return jnp.sum(jnp.stack([reaction.couple for reaction in held]), axis=0)


def _reactions_at(end: End, scene: LoadedRod, state: RodState) -> list[Reaction]:
    """Reactions of all supports at an end.

    Raises:
        ValueError: If there is none, or one also holds another part of the rod.
    """
    found = reactions(scene, state)
    index, rod = 0 if end == "base" else -1, scene.rod
    here = {index % (rod.n_elements + 1)}, {index % rod.n_elements}
    held = []
    for effect, reaction in zip(scene.effects, found, strict=True):
        parts = effect.held(rod)
        nodes = {p.node % (rod.n_elements + 1) for p in parts if p.node is not None}
        elements = {p.element % rod.n_elements for p in parts if p.element is not None}
        if reaction is None or not (nodes & here[0] or elements & here[1]):
            continue
        if not (nodes <= here[0] and elements <= here[1]):
            raise ValueError(
                f"{type(effect).__name__} holds the {end} of the rod and another "
                "place, so the share of the end in its reaction is not known: use one "
                "effect for each place"
            )
        held.append(reaction)
    if not held:
        raise ValueError(f"the scene has no support at the {end} of the rod")
    return held


@pytree
class TendonLength(Sensor):
    """Sensor of the lengths of a tendon's cables, made by `tendon_length`.

    Example:
        >>> pair = actuation.tendon(rod, [[0.01, 0.0], [-0.01, 0.0]], tension=5.0)
        >>> arm = jaxrod.make_scene(rod, jaxrod.clamp(state), pair)
        >>> encoder = sensors.tendon_length(1)  # the clamp is effect 0
        >>> encoder.shape(arm), encoder.unit
        ((2,), 'm')
    """

    unit: ClassVar[str] = "m"
    effect: int = static(default=0)
    """Index of the tendon in the scene's `effects`, from 0."""
    name: str = static(default="tendon length")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "k"]:
        """Length of each cable, from anchor or first eyelet to last eyelet [m]."""
        return _tendon(scene, self.effect).cable_lengths(motion_of(state))


@pytree
class TendonTension(Sensor):
    """Sensor of the tensions of a tendon's cables, made by `tendon_tension`.

    Example:
        >>> pair = actuation.tendon(rod, [[0.01, 0.0], [-0.01, 0.0]], tension=5.0)
        >>> cell = sensors.tendon_tension(0)
        >>> cell.shape(jaxrod.make_scene(rod, pair)), cell.unit
        ((2,), 'N')
    """

    unit: ClassVar[str] = "N"
    effect: int = static(default=0)
    """Index of the tendon in the scene's `effects`, from 0."""
    name: str = static(default="tendon tension")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "k"]:
        """Tension of each cable at its base [N]."""
        return _tendon(scene, self.effect).cable_tensions(motion_of(state))


@pytree
class ChamberPressure(Sensor):
    """Sensor of the pressures in chambers, made by `chamber_pressure`.

    Example:
        >>> places = [[0.01, 0.0], [-0.01, 0.0]]  # of two chambers [m]
        >>> pair = actuation.chamber(rod, [1e4, 2e4], area=1e-4, offsets=places)
        >>> arm = jaxrod.make_scene(rod, jaxrod.clamp(state), pair)
        >>> gauge = sensors.chamber_pressure(1)  # the clamp is effect 0
        >>> gauge.shape(arm), gauge.unit
        ((2,), 'Pa')
    """

    unit: ClassVar[str] = "Pa"
    effect: int = static(default=0)
    """Index of the chambers in the scene's `effects`, from 0."""
    name: str = static(default="chamber pressure")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "k"]:
        """Pressure in each chamber above the pressure outside [Pa]."""
        chosen = _effect(scene, self.effect, (Chamber, WoundChamber))
        return jnp.broadcast_to(chosen.pressure, (chosen.path.count,))


def _effect(scene: LoadedRod, number: int, kinds: type | tuple[type, ...]) -> Any:
    """Effect of a scene by its index; raises if it is missing or not of `kinds`."""
    check_count("effect", number, 0, len(scene.effects) - 1)
    chosen = scene.effects[number]
    check_kind(f"effect {number} of the scene", chosen, kinds)
    return chosen


def _tendon(scene: LoadedRod, number: int) -> Tendon:
    """Tendon of a scene, by its index in `effects`."""
    chosen: Tendon = _effect(scene, number, Tendon)
    return chosen


@pytree
class ContactForce(Sensor):
    """Sensor of the force of all bodies that touch a rod, made by `contact_force`.

    Example:
        >>> floor = jaxrod.contact(shapes.plane((0.0, 0.0, -0.01)), stiffness=1e4)
        >>> skin = sensors.contact_force(per_node=True)
        >>> skin.shape(jaxrod.make_scene(rod, floor)), skin.unit
        ((3, 11), 'N')
    """

    unit: ClassVar[str] = "N"
    per_node: bool = static(default=False)
    """Whether to read the force on each node, instead of the sum."""
    name: str = static(default="contact force")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *nodes"]:
        """Force of the bodies on the rod or on each node, world frame [N]."""
        motion, rod = motion_of(state), scene.rod
        internal = internal_loads(elastic_law(rod), motion)
        forces, couples = internal.forces, internal.couples
        assert forces is not None and couples is not None
        none = jnp.zeros_like(rod.node_masses)
        touching, found = (none, none, none), False
        # Contact may depend on the loads of the effects listed before it.
        for effect in scene.effects:
            loads = effect.loads_after(rod, motion, Loads(forces, couples))
            if effect.obstacle is not None:
                touching, found = accumulate(touching, loads.forces), True
            forces = accumulate(forces, loads.forces)
            couples = accumulate(couples, loads.couples)
        if not found:
            raise ValueError("the scene has no contact")
        each = vectors.join(touching)
        return each if self.per_node else jnp.sum(each, axis=1)


def support_force(end: End = "base") -> SupportForce:
    """Makes a sensor of the force with which supports hold an end of the rod.

    It is the force that `jaxrod.reactions` gives for the end node, from a clamp, a
    fixed end, a pin, a hinge or a driven end.

    Args:
        end: End that is held, "base" or "tip".

    Returns:
        A sensor that reads three components, world frame [N]. It needs a method with
        the consistent law, and a support that holds only that end.

    Raises:
        ValueError: If `end` is neither "base" nor "tip".

    Example:
        >>> longer = replace(state, positions=1.01 * state.positions)  # by 1 %
        >>> force = sensors.support_force().read(scene, longer)
        >>> round(float(force[0]), 1)  # the clamp pulls back [N]
        -12.6
    """
    return SupportForce(check_end(end))


def support_couple(end: End = "base") -> SupportCouple:
    """Makes a sensor of the couple with which supports hold an end of the rod.

    Args:
        end: End that is held, "base" or "tip".

    Returns:
        A sensor that reads three components, world frame [N m]. It needs a method with
        the consistent law, and a support that holds only that end.

    Raises:
        ValueError: If `end` is neither "base" nor "tip".

    Example:
        >>> _, raised = jaxrod.straight_rod(
        ...     10,
        ...     length=1.0,
        ...     radius=0.02,
        ...     density=1000.0,
        ...     youngs_modulus=1e6,
        ...     direction=(1.0, 0.0, 0.1),
        ... )
        >>> couple = sensors.support_couple().read(scene, raised)
        >>> print(couple.round(2))  # it turns the rod down [N m]
        [0.   0.25 0.  ]
    """
    return SupportCouple(check_end(end))


def tendon_length(effect: int) -> TendonLength:
    """Makes a sensor of the lengths of a tendon's cables, such as a winch encoder.

    Args:
        effect: Index of the tendon in the scene's `effects`, from 0.

    Returns:
        A sensor that reads one number per cable [m]. Reading it raises a `TypeError` if
        that effect is not a `tendon`.

    Raises:
        ValueError: If `effect` is not an integer from 0.

    Example:
        >>> pulled = actuation.tendon(rod, (0.01, 0.0), tension=5.0)
        >>> arm = jaxrod.make_scene(rod, jaxrod.clamp(state), pulled)
        >>> round(float(sensors.tendon_length(1).read(arm, state)[0]), 3)  # [m]
        0.9
    """
    return TendonLength(check_count("effect", effect, 0))


def tendon_tension(effect: int) -> TendonTension:
    """Makes a sensor of the tensions of a tendon's cables at their base.

    Args:
        effect: Index of the tendon in the scene's `effects`, from 0.

    Returns:
        A sensor that reads one number per cable [N]. Reading it raises a `TypeError` if
        that effect is not a `tendon`.

    Raises:
        ValueError: If `effect` is not an integer from 0.

    Example:
        >>> pull = schedules.ramp(0.0, 5.0, duration=1.0)
        >>> tendon = actuation.tendon(rod, (0.01, 0.0), tension=pull)
        >>> arm = jaxrod.make_scene(rod, tendon)
        >>> sensors.tendon_tension(0).read(arm.at(0.5), state).tolist()  # [N]
        [2.5]
    """
    return TendonTension(check_count("effect", effect, 0))


def chamber_pressure(effect: int) -> ChamberPressure:
    """Makes a sensor of the pressures in chambers, above the pressure outside.

    Args:
        effect: Index of the chambers in the scene's `effects`, from 0.

    Returns:
        A sensor that reads one number per chamber [Pa]. Reading it raises a `TypeError`
        if that effect is not a `chamber` or `wound_chamber`.

    Raises:
        ValueError: If `effect` is not an integer from 0.

    Example:
        >>> pump = schedules.ramp(0.0, 2e4, duration=1.0)
        >>> arm = jaxrod.make_scene(rod, actuation.chamber(rod, pump, area=1e-4))
        >>> sensors.chamber_pressure(0).read(arm.at(0.5), state).tolist()  # [Pa]
        [10000.0]
    """
    return ChamberPressure(check_count("effect", effect, 0))


def contact_force(*, per_node: bool = False) -> ContactForce:
    """Makes a sensor of contact forces on the rod: normal forces and friction.

    Args:
        per_node: Whether to read the force on each node, instead of the sum.

    Returns:
        A sensor that reads three components, or `(3, n + 1)`, world frame [N]. Reading
        it raises a `ValueError` if the scene has no contact.

    Example:
        >>> floor = jaxrod.contact(shapes.plane((0.0, 0.0, -0.01)), stiffness=1e4)
        >>> lying = jaxrod.make_scene(rod, floor)  # 1 m of rod, 1 cm deep in the floor
        >>> print(sensors.contact_force().read(lying, state).round())  # [N]
        [  0.   0. 100.]
    """
    return ContactForce(bool(per_node))
