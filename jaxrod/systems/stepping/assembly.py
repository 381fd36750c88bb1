"""Rods and rigid bodies by name with their couplings, and their stepper."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxrod.effects.time import (
    Clock,
    at_clock,
    at_largest,
    clock_at,
    depends_on_time,
)
from jaxrod.methods.consistent import ConsistentStepper
from jaxrod.methods.pyelastica import PyElasticaStepper
from jaxrod.rods.motion import motion_of
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.statics.freedoms import free_rates
from jaxrod.structure import pytree, static
from jaxrod.systems.joints.attachments import Attachment
from jaxrod.systems.members.parts import Parts, in_one_row, parts_of
from jaxrod.systems.members.rigid_bodies import RigidBodies
from jaxrod.systems.members.rigid_stepper import Carried, RigidStepper
from jaxrod.systems.members.steppers import (
    BodiesStepper,
    MemberStepper,
    RodsStepper,
    RodStepper,
)
from jaxrod.systems.sites.coupling import Coupling
from jaxrod.systems.stepping.stepper import SystemStepper

Member = Scene | RigidBodies
"""A rod with its effects, equal rods with a leading axis, or rigid bodies."""
SystemState = Mapping[str, Any]
"""States of the members, by name: `RodState` or `BodyState`."""


@pytree
class Assembly:
    """Rods and rigid bodies by name, and the couplings between them."""

    members: dict[str, Member]
    """The members, by name."""
    couplings: tuple[Coupling, ...] = ()
    """Couplings between them."""
    shapes: tuple[tuple[int, ...], ...] = static(default=())
    """Shapes of each member's elements or bodies, as the system was made."""

    @property
    def dtype(self) -> Any:
        """Type of all numbers."""
        first = next(iter(self.members.values()))
        if isinstance(first, RigidBodies):
            return first.masses.dtype
        return first.rod.rest_lengths.dtype

    @property
    def depends_on_time(self) -> bool:
        """Whether a number of an effect or a coupling is a schedule."""
        return depends_on_time((self.couplings, _effects(self)))

    @property
    def remembers(self) -> bool:
        """Whether an effect on a rod has memory."""
        return any(m.remembers for m in self.members.values() if isinstance(m, Scene))

    @property
    def evolves(self) -> bool:
        """Whether the system depends on time or has memory."""
        return self.depends_on_time or self.remembers

    def at(self, time: ArrayLike | Clock) -> Self:
        """The system as it is at a time [s]: schedules replaced by their values."""
        if not self.depends_on_time:
            return self
        clock = time if isinstance(time, Clock) else clock_at(time, self.dtype)
        return self._replaced(lambda tree: at_clock(tree, clock))

    @property
    def at_largest(self) -> Self:
        """The system with every schedule at the bound on its size."""
        return self._replaced(at_largest) if self.depends_on_time else self

    def _replaced(self, function: Callable[[Any], Any]) -> Self:
        """The system with a function applied to every member and to the couplings.

        It is applied to equal rods one by one.
        """
        members = {
            name: jax.vmap(function)(member) if is_group(member) else function(member)
            for name, member in self.members.items()
        }
        return replace(self, members=members, couplings=function(self.couplings))

    def recalling(self, state: SystemState) -> Assembly:
        """The system whose effects have the memories of a state."""
        if not self.remembers:
            return self
        members = {
            name: _recalling(member, state[name])
            for name, member in self.members.items()
        }
        return replace(self, members=members)

    def parts(self) -> dict[str, Parts]:
        """Constants of all members as couplings see them, without supports."""
        return {
            name: parts_of(m if isinstance(m, RigidBodies) else m.rod)
            for name, m in self.members.items()
        }

    def stepper(self, state: SystemState, dt: Array) -> SystemStepper:
        """The integrator, with constants computed for one call."""
        parts = held_parts(self, state)
        couplings = tuple(coupling.prepared(parts) for coupling in self.couplings)
        carried: dict[str, Carried] = {}
        for coupling in couplings:
            if isinstance(coupling, Attachment):
                name, own = coupling.bodies.member, coupling.carried(parts)
                carried[name] = (
                    jax.tree.map(jnp.add, carried[name], own)
                    if name in carried
                    else own
                )
        members = {
            name: _stepper(member, state[name], parts[name], carried.get(name), dt)
            for name, member in self.members.items()
        }
        return SystemStepper(members, couplings, dt)


def is_group(member: Member) -> bool:
    """Whether a member consists of equal rods with a leading axis."""
    return isinstance(member, Scene) and member.rod.rest_lengths.ndim > 1


def member_shapes(members: Mapping[str, Member]) -> tuple[tuple[int, ...], ...]:
    """Shapes of the members' elements, or of bodies, in the order of their names."""

    def shape(member: Member) -> tuple[int, ...]:
        if isinstance(member, RigidBodies):
            return jnp.shape(member.masses)
        return jnp.shape(member.rod.rest_lengths)

    # JAX sorts a dict by its keys, here the names: the given order is lost.
    return tuple(shape(members[name]) for name in sorted(members))


def _effects(system: Assembly) -> list[Any]:
    return [member.effects for member in system.members.values()]


def _recalling(member: Member, state: Any) -> Member:
    if isinstance(member, RigidBodies):
        return member
    if member.rod.rest_lengths.ndim == 1:
        return member.recalling(state)
    return jax.vmap(lambda scene, own: scene.recalling(own))(member, state)


def _stepper(
    member: Member, state: Any, parts: Parts, carried: Carried | None, dt: Array
) -> MemberStepper:
    if isinstance(member, RigidBodies):
        return BodiesStepper(RigidStepper.create(member, carried, dt))
    if parts.count == 1 and member.rod.rest_lengths.ndim == 1:
        return RodStepper(_verlet(member, state, dt), parts)
    verlet = jax.vmap(lambda s, x: _verlet(s, x, dt))(member, state)
    return RodsStepper(verlet, parts, parts.count)


def _verlet(
    scene: Scene, state: RodState, dt: Array
) -> ConsistentStepper | PyElasticaStepper:
    stepper = scene.method.stepper(scene, state, dt)
    assert isinstance(stepper, ConsistentStepper | PyElasticaStepper)
    return stepper


def held_parts(system: Assembly, state: SystemState) -> dict[str, Parts]:
    """Constants of all members, with the nodes that supports hold (at time zero)."""
    parts = system.parts()
    # The held nodes do not depend on where supports drive them.
    for name, member in system.at(0.0).members.items():
        if isinstance(member, RigidBodies) or not member.effects:
            continue
        one = lambda scene, own: free_rates(scene, motion_of(own))[0]
        if member.rod.rest_lengths.ndim == 1:
            free = one(member, state[name])
        else:
            free = in_one_row(jax.vmap(one)(member, state[name]))
        x, y, z = (1 - component for component in free)
        parts[name] = replace(parts[name], held=(x, y, z))
    return parts
