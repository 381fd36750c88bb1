"""Preparation of a run of a system: checks, memory and the stepper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.effects.time import Clock
from jaxrod.model import Stepper
from jaxrod.systems.contact.neighbour_lists import RECORD, NeighbourRecord, no_record
from jaxrod.systems.stability import stable_system_dt
from jaxrod.systems.stepping.assembly import (
    Assembly,
    SystemState,
    held_parts,
    member_shapes,
)
from jaxrod.systems.stepping.changing import (
    EvolvingSystem,
    ListingSystem,
    lists_neighbours,
    refresh_every,
)
from jaxrod.systems.stepping.stepper import SystemStepper


def check_system_state(system: Assembly, state: Any) -> None:
    """Checks that a state has a fitting state for every member of a system.

    Raises:
        TypeError: If it is not a mapping, or a member's state is of another kind.
        ValueError: If members are missing, unknown, or of another size or type.
    """
    if not isinstance(state, Mapping):
        raise TypeError(
            "state must be a dict of the states of all members by name, got "
            f"{type(state).__name__}"
        )
    also = {RECORD} if lists_neighbours(system) else set()
    if set(state) - also != set(system.members):
        raise ValueError(
            f"state must have the members {sorted(system.members)}, got {sorted(state)}"
        )
    if RECORD in state:
        _check_record(state[RECORD])
    check_single(system)
    for name, member in system.interfaces().items():
        member.check_state(name, state[name], system.dtype)


def check_single(system: Assembly) -> None:
    """Raises a ValueError if a system is a batch of systems."""
    if system.shapes and member_shapes(system.members) != system.shapes:
        raise ValueError(
            "system must be one system, got a batch: use jax.vmap, as in "
            "jax.vmap(jaxrod.advance, in_axes=(0, 0, None, None))(systems, ...)"
        )


def _check_record(record: Any) -> None:
    if not isinstance(record, NeighbourRecord):
        raise TypeError(
            f"state[{RECORD!r}] must be the record that a run left there, got "
            f"{type(record).__name__}: leave it out to start again"
        )


def system_stepper(
    system: Assembly, state: SystemState, dt: Array, first: Array | None
) -> Stepper:
    """Integrator of a system in a run, for `advance`.

    `first` is the number of the first step since time zero. It is `None` for a system
    that neither depends on time nor has memory.
    """
    own = _own_stepper(system, state, dt, first)
    every = refresh_every(own.couplings)
    return own if every is None else ListingSystem(own, every)


def _own_stepper(
    system: Assembly, state: SystemState, dt: Array, first: Array | None
) -> SystemStepper | EvolvingSystem:
    if first is None:
        return system.stepper(state, dt)
    start = system.at(Clock(first, jnp.zeros_like(dt), dt))
    stepper = start.stepper(state, dt)
    parts = held_parts(system, state)
    prepared = tuple(coupling.prepared(parts) for coupling in system.couplings)
    return EvolvingSystem(stepper, system, prepared, first)


def system_with_memory(system: Assembly, state: SystemState) -> dict[str, Any]:
    """Copy of the state with the initial memories of effects, where it has none.

    A system with lists of neighbours also gets a record of the contacts that they miss.
    """
    own = {
        name: member.with_memory(state[name])
        for name, member in system.interfaces().items()
    }
    if lists_neighbours(system):
        record = state.get(RECORD)
        own[RECORD] = no_record(system.dtype) if record is None else record
    return own


def unstable_step(system: Assembly, dt: Array) -> str | None:
    """Warning about a concrete step above the stability bound; `None` below it."""
    bound = stable_system_dt(system, safety=1.0)
    if not float(dt) > float(bound.dt):
        return None
    return (
        f"dt = {float(dt):.3g} s is above the stability bound {float(bound.dt):.3g} s "
        f"set by {bound.limiting_mode}"
    )
