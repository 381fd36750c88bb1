"""Energies and momenta of a system."""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Float

from jaxrod.lanes.steps import by_kernel
from jaxrod.structure import pytree
from jaxrod.systems.coupling import Seen
from jaxrod.systems.stepping.assembly import Assembly, SystemState, held_parts
from jaxrod.systems.stepping.changing import searched, with_found


@jax.jit
def system_kinetic_energy(system: Assembly, state: SystemState) -> Float[Array, ""]:
    """Kinetic energy of all members [J]."""
    members = system.interfaces()
    return _total(member.kinetic_energy(state[k]) for k, member in members.items())


@jax.jit
def system_potential_energy(system: Assembly, state: SystemState) -> Float[Array, ""]:
    """Elastic energy plus potential energies of effects and couplings [J]."""
    members = system.interfaces()
    total = _total(member.potential_energy(state[k]) for k, member in members.items())
    if not system.couplings:
        return total
    # A kernel, because XLA takes many seconds to compile contact with lists.
    return total + by_kernel(_CouplingEnergy(system), "energy", state)


@pytree
class _CouplingEnergy:
    """Potential energy of all couplings, as a pytree with a method for `by_kernel`."""

    system: Assembly
    """The system whose couplings are summed."""

    def energy(self, state: SystemState) -> Float[Array, ""]:
        """Sum of the potential energies of all couplings in a state [J]."""
        seen, prepared = seen_at_rest(self.system, state)
        return _total(coupling.energy(seen) for coupling in prepared)


@jax.jit
def system_momentum(system: Assembly, state: SystemState) -> Float[Array, "3"]:
    """Total linear momentum of all members, world frame [kg m/s]."""
    members = system.interfaces()
    return _total(member.momentum(state[k]) for k, member in members.items())


@jax.jit
def system_angular_momentum(system: Assembly, state: SystemState) -> Float[Array, "3"]:
    """Total angular momentum about the origin, world frame [kg m^2/s]."""
    members = system.interfaces()
    return _total(member.angular_momentum(state[k]) for k, member in members.items())


def seen_at_rest(
    system: Assembly, state: SystemState
) -> tuple[dict[str, Seen], tuple[Any, ...]]:
    """Constants and motion of each member in a state, and the prepared couplings.

    Couplings have the results of a search for neighbours in this state. `Motion.spin`
    is the angular momentum of elements for every method of stepping.
    """
    parts = held_parts(system, state)
    prepared = tuple(coupling.prepared(parts) for coupling in system.couplings)
    seen = {
        name: Seen(parts[name], member.motion(state[name]))
        for name, member in system.interfaces().items()
    }
    return seen, with_found(prepared, searched(prepared, seen))


def _total(values: Any) -> Any:
    total = None
    for value in values:
        total = value if total is None else total + value
    return total
