"""Energies and momenta of a system."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import split_quaternion
from jaxrod.rods.motion import Motion, motion_of
from jaxrod.scene import (
    Scene,
    angular_momentum,
    kinetic_energy,
    momentum,
    potential_energy,
)
from jaxrod.systems.members.parts import Seen, in_one_row
from jaxrod.systems.members.rigid_bodies import (
    BodyState,
    RigidBodies,
    body_angular_momenta,
    body_kinetic_energy,
)
from jaxrod.systems.stepping.assembly import Assembly, Member, SystemState, held_parts
from jaxrod.systems.stepping.listing import searched, with_found


@jax.jit
def system_kinetic_energy(system: Assembly, state: SystemState) -> Float[Array, ""]:
    """Kinetic energy of all members [J]."""
    return _total(_kinetic(member, state[k]) for k, member in system.members.items())


@jax.jit
def system_potential_energy(system: Assembly, state: SystemState) -> Float[Array, ""]:
    """Elastic energy, and potential energy of effects and couplings [J]."""
    total = _total(_potential(m, state[k]) for k, m in system.members.items())
    seen, prepared = seen_at_rest(system, state)
    for coupling in prepared:
        total = total + coupling.energy(seen)
    return total


@jax.jit
def system_momentum(system: Assembly, state: SystemState) -> Float[Array, "3"]:
    """Linear momentum, world frame [kg m/s]."""
    return _total(_momentum(member, state[k]) for k, member in system.members.items())


@jax.jit
def system_angular_momentum(system: Assembly, state: SystemState) -> Float[Array, "3"]:
    """Angular momentum about the origin, world frame [kg m^2/s]."""
    return _total(_angular(member, state[k]) for k, member in system.members.items())


def seen_at_rest(
    system: Assembly, state: SystemState
) -> tuple[dict[str, Seen], tuple[Any, ...]]:
    """Members as couplings see them in a state, and the prepared couplings.

    Rates are those of the state. Spins are angular momenta, whatever the method. Lists
    of neighbours are searched.
    """
    parts = held_parts(system, state)
    prepared = tuple(coupling.prepared(parts) for coupling in system.couplings)
    seen = {}
    for name, member in system.members.items():
        own = state[name]
        if isinstance(member, RigidBodies):
            motion = Motion(
                vectors.split(own.positions),
                split_quaternion(own.orientations),
                vectors.split(own.velocities),
                vectors.split(body_angular_momenta(member, own)),
            )
        elif member.rod.rest_lengths.ndim == 1:
            motion = motion_of(own)
        else:
            motion = in_one_row(jax.vmap(motion_of)(own))
        seen[name] = Seen(parts[name], motion)
    return seen, with_found(prepared, searched(prepared, seen))


def _total(values: Any) -> Any:
    total = None
    for value in values:
        total = value if total is None else total + value
    return total


def _is_group(member: Scene) -> bool:
    return member.rod.rest_lengths.ndim > 1


def _kinetic(member: Member, state: Any) -> Array:
    if isinstance(member, RigidBodies):
        return body_kinetic_energy(member, state)
    if _is_group(member):
        return jnp.sum(jax.vmap(kinetic_energy)(member.rod, state))
    return kinetic_energy(member.rod, state)


def _potential(member: Member, state: Any) -> Array:
    if isinstance(member, RigidBodies):
        total = jnp.zeros((), state.positions.dtype)
        for effect in member.effects:
            body: Any = member
            total = total + effect.energy(body, state)
        return total
    if _is_group(member):
        return jnp.sum(jax.vmap(potential_energy)(member, state))
    return potential_energy(member, state)


def _momentum(member: Member, state: Any) -> Array:
    if isinstance(member, RigidBodies):
        return jnp.sum(member.masses[None] * state.velocities, axis=1)
    if _is_group(member):
        return jnp.sum(jax.vmap(momentum)(member.rod, state), axis=0)
    return momentum(member.rod, state)


def _angular(member: Member, state: Any) -> Array:
    if isinstance(member, RigidBodies):
        return _of_bodies(member, state)
    if _is_group(member):
        return jnp.sum(jax.vmap(angular_momentum)(member.rod, state), axis=0)
    return angular_momentum(member.rod, state)


def _of_bodies(bodies: RigidBodies, state: BodyState) -> Array:
    orbital = vectors.cross(
        vectors.split(state.positions),
        vectors.scale(bodies.masses, vectors.split(state.velocities)),
    )
    return jnp.sum(vectors.join(orbital) + body_angular_momenta(bodies, state), axis=1)
