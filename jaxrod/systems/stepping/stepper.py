"""Steps of a system: its members drift and are kicked together.

One step is position Verlet, as for a single rod: half a drift of every member; exact
positions of attached and tied nodes; loads of all members and couplings at this
configuration; kicks; exchange of impulses between attached members; half a drift.

A system may change during a run: through schedules, memory of effects, or neighbour
lists. Lists are made before each block of steps, in which they are constants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int

from jaxrod.effects.own_classes import called_hook
from jaxrod.effects.time import Clock, at_clock
from jaxrod.lanes.steps import by_kernel
from jaxrod.methods.strides import Strides, drift_time
from jaxrod.model import Stepper
from jaxrod.rods.motion import Loads, Motion, added
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.neighbour_lists import (
    RECORD,
    NeighbourRecord,
    with_shortage,
)
from jaxrod.systems.coupling import (
    AllParts,
    Carried,
    Coupling,
    Seen,
    refresh_every,
    searched,
    with_found,
)
from jaxrod.systems.members.steppers import MemberStepper
from jaxrod.systems.stepping.assembly import Assembly, SystemState, held_parts

Motions = dict[str, Motion]
"""Motions of the members, by name."""


@pytree
class SystemStepper(Strides):
    """Position Verlet of all members and their couplings, with constants of a run."""

    members: Mapping[str, MemberStepper]
    """Steppers of the members, by name."""
    couplings: tuple[Coupling, ...]
    """Couplings with the constants that `prepared` computes."""
    dt: Array
    """Step size [s]."""

    def seen(self, motions: Motions) -> dict[str, Seen]:
        """Constants and motion of all members, as couplings read them."""
        return {k: m.seen(motions[k]) for k, m in self.members.items()}

    def enter(self, state: Mapping[str, Any]) -> Motions:
        """Motions of a state, with all ties and attachments enforced."""
        motions = {k: m.enter(state[k]) for k, m in self.members.items()}
        return self._rates_tied(self._placed(motions))

    def leave(self, motions: Motions) -> dict[str, Any]:
        """Converts the motions of all members to a state."""
        return {k: m.leave(motions[k]) for k, m in self.members.items()}

    def drift(self, motions: Motions, dt: Array) -> Motions:
        """Motions after a time `dt` [s] at unchanged velocities and spins.

        Tied and attached nodes get their exact positions.
        """
        moved = {k: m.drift(motions[k], dt) for k, m in self.members.items()}
        return self._placed(moved)

    def kick(self, motions: Motions) -> Motions:
        """Motions after all loads have acted for one step, at unchanged positions."""
        before = self.seen(motions)
        loads = self.loads(before)
        kicked = {
            k: m.kick(motions[k], loads.get(k, Loads()))
            for k, m in self.members.items()
        }
        return self._rates_tied(self._exchanged(before, kicked))

    def loads(self, seen: Mapping[str, Seen]) -> dict[str, Loads]:
        """Sum of the loads of all couplings, by name of the member."""
        total: dict[str, Loads] = {}
        for coupling in self.couplings:
            with called_hook(coupling, "loads"):
                found = coupling.loads(seen)
            for name, loads in found.items():
                total[name] = added(total.get(name, Loads()), loads)
        return total

    def begin(self, state: Mapping[str, Any]) -> Motions:
        """Loop carry in the middle of the first step, from the initial state."""
        return self.drift(self.enter(state), 0.5 * self.dt)

    def stride(self, motions: Motions, last: bool | Bool[Array, ""]) -> Motions:
        """Motions after a kick and a drift, which is half as long in the last step."""
        return self.drift(self.kick(motions), drift_time(self.dt, last))

    def finished(self, motions: Motions) -> dict[str, Any]:
        """State at the end of the last step."""
        return self.leave(motions)

    def supported(self, motions: Motions) -> Motions:
        """Motions with the velocities that supports, ties and attachments impose.

        Tied and attached nodes also get their exact positions.
        """
        held = {k: m.supported(motions[k]) for k, m in self.members.items()}
        return self._rates_tied(self._placed(held))

    def _exchanged(self, before: Mapping[str, Seen], kicked: Motions) -> Motions:
        """Motions after the impulses that a kick causes between members.

        Nodes attached to a body pass their impulses on to it. `before` describes the
        members before the kick, and `kicked` are their motions after it.
        """
        impulses: dict[str, Loads] = {}
        after: dict[str, Seen] | None = None
        for coupling in self.couplings:
            if type(coupling).exchange is Coupling.exchange:
                continue
            after = self.seen(kicked) if after is None else after
            for name, impulse in coupling.exchange(before, after).items():
                impulses[name] = added(impulses.get(name, Loads()), impulse)
        pushed = {k: self.members[k].pushed(kicked[k], v) for k, v in impulses.items()}
        return {**kicked, **pushed}

    def _placed(self, motions: Motions) -> Motions:
        """Motions with tied and attached nodes at their exact positions."""
        for coupling in self.couplings:
            if type(coupling).constrain is not Coupling.constrain:
                motions = self._with(motions, coupling.constrain(self.seen(motions)))
        return motions

    def _rates_tied(self, motions: Motions) -> Motions:
        """Motions with exact velocities of tied and attached nodes."""
        for coupling in self.couplings:
            if type(coupling).constrain_rates is not Coupling.constrain_rates:
                changed = coupling.constrain_rates(self.seen(motions))
                motions = self._with(motions, changed)
        return motions

    def _with(self, motions: Motions, changed: Motions) -> Motions:
        return {
            **motions,
            **{k: self.members[k].moved_as(motions[k], v) for k, v in changed.items()},
        }


Memories = dict[str, Any]
"""Memories of the effects of rods, by the name of the member."""


@pytree
class SystemNow:
    """Step number and memories of a system during a run."""

    step: Int[Array, ""]
    """Whole steps since time zero."""
    memories: Memories
    """Memories of the effects of its rods, by the name of the member."""


@pytree
class EvolvingSystem(Strides):
    """Position Verlet of a system that depends on time or has memory.

    As for a scene, loads and rates are those of the middle of a step. Driven supports
    have their positions at the end of a drift.
    """

    stepper: SystemStepper
    """The stepper of the system at the beginning of the run."""
    system: Assembly
    """The system with its schedules."""
    couplings: tuple[Coupling, ...]
    """Couplings with the constants that `prepared` computes, and their schedules."""
    first: Int[Array, ""]
    """Number of steps from time zero to the beginning of the run."""

    def seen(self, carry: tuple[Motions, SystemNow]) -> dict[str, Seen]:
        """Constants and motion of all members, as couplings read them."""
        return self.stepper.seen(carry[0])

    def begin(self, state: Mapping[str, Any]) -> tuple[Motions, SystemNow]:
        """Loop carry in the middle of the first step, from the initial state."""
        memories = {
            name: member.memory(state[name])
            for name, member in self.system.interfaces().items()
        }
        now = SystemNow(self.first, memories)
        return self._at(now, 0.5).begin(state), now

    def stride(
        self, carry: tuple[Motions, SystemNow], last: bool | Bool[Array, ""]
    ) -> tuple[Motions, SystemNow]:
        """Motions, step number and memories in the middle of the next step.

        After the last step they are those of its end.
        """
        kicked, now = self._kick(carry)
        there = self._at(now, jnp.where(last, 0.0, 0.5))
        return there.drift(kicked, drift_time(self.stepper.dt, last)), now

    def finished(self, carry: tuple[Motions, SystemNow]) -> dict[str, Any]:
        """State at the end of the last step."""
        moved, now = carry
        last = self._at(now, 0.0)
        if self.system.depends_on_time:
            moved = last.supported(moved)
        state = last.leave(moved)
        for name, memory in now.memories.items():
            if any(memory):
                state[name] = replace(state[name], memory=memory)
        return state

    def _kick(self, carry: tuple[Motions, SystemNow]) -> tuple[Motions, SystemNow]:
        motions, now = carry
        present = self._at(now, 0.5)
        kicked = present.kick(motions)
        dt = self.stepper.dt
        after = {
            name: present.members[name].remembered(kicked[name], memory, dt)
            for name, memory in now.memories.items()
        }
        return kicked, SystemNow(now.step + 1, after)

    def _at(self, now: SystemNow, fraction: ArrayLike) -> SystemStepper:
        """Stepper with schedules at `fraction` of a step after step `now.step`."""
        dt = self.stepper.dt
        clock = Clock(now.step, jnp.asarray(fraction, dt.dtype), dt)
        members = {
            name: stepper.at(self.system.members[name], now.memories[name], clock)
            for name, stepper in self.stepper.members.items()
        }
        couplings = at_clock(self.couplings, clock)
        return replace(self.stepper, members=members, couplings=couplings)


@pytree
class ListedSystem(Strides):
    """Steps of a system between two searches, whose lists are constants."""

    stepper: SystemStepper | EvolvingSystem
    """The stepper of the system, without lists."""
    found: tuple[Any, ...]
    """Results of the last search of each coupling that searches."""

    def stride(
        self, carry: tuple[Any, NeighbourRecord], last: bool | Bool[Array, ""]
    ) -> tuple[Any, NeighbourRecord]:
        """Motions after a kick and a drift, and the record of the lists."""
        motions, record = carry
        moved = self._with_lists().stride(motions, last)
        return moved, self._recorded(motions, record)

    def finished(self, carry: tuple[Any, NeighbourRecord]) -> dict[str, Any]:
        """State at the end of the last step, with the record of the lists."""
        motions, record = carry
        return {**self.stepper.finished(motions), RECORD: record}

    def _recorded(self, motions: Any, record: NeighbourRecord) -> NeighbourRecord:
        """Updates the record with the lists and the motions; no derivatives."""
        own, motions, record = jax.lax.stop_gradient((self, motions, record))
        couplings = own._with_lists().couplings
        seen = own.stepper.seen(motions)
        moved = record.moved
        for coupling in couplings:
            if coupling.refresh_every is not None:
                moved = jnp.maximum(moved, coupling.moved(seen))
        return with_shortage(replace(record, moved=moved), couplings)

    def _with_lists(self) -> SystemStepper | EvolvingSystem:
        """The stepper, with the lists in its couplings."""
        couplings = with_found(self.stepper.couplings, self.found)
        return replace(self.stepper, couplings=couplings)


@pytree
class ListingSystem(Strides):
    """Position Verlet of a system with neighbour lists."""

    one_by_one: ClassVar[bool] = True
    """Whether the systems of a batch are stepped one after another, so that branches
    on the contents of lists stay branches."""
    stepper: SystemStepper | EvolvingSystem
    """The stepper of the system, whose couplings have no lists yet."""
    every: int = static()
    """Steps between searches."""

    def begin(self, state: Mapping[str, Any]) -> tuple[Any, NeighbourRecord]:
        """Motions in the middle of the first step, and the record of the lists."""
        return by_kernel(self.stepper, "begin", state), state[RECORD]

    def search(self, motions: Any) -> tuple[Any, ...]:
        """Results of the searches of all couplings, without derivatives."""
        motions = jax.lax.stop_gradient(motions)
        return searched(self.stepper.couplings, self.stepper.seen(motions))

    def stride(
        self, carry: tuple[Any, NeighbourRecord], last: bool | Bool[Array, ""]
    ) -> Any:
        """Motions after a kick and a drift, and the record, with new lists."""
        return self.searched(carry).stride(carry, last)

    def finished(self, carry: tuple[Any, NeighbourRecord]) -> dict[str, Any]:
        """State at the end of the last step, with the record of the lists."""
        motions, record = carry
        return {**self.stepper.finished(motions), RECORD: record}

    def searched(self, carry: tuple[Any, NeighbourRecord]) -> ListedSystem:
        """Integrator of the steps until the next search, with new lists."""
        return ListedSystem(self.stepper, by_kernel(self, "search", carry[0]))


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
    """Integrator of a system in a run, without its neighbour lists."""
    if first is None:
        return stepper_at(system, state, dt)
    start = system.at(Clock(first, jnp.zeros_like(dt), dt))
    parts = held_parts(start, state)
    stepper = _with_parts(start, state, dt, parts)
    prepared = tuple(coupling.prepared(parts) for coupling in system.couplings)
    return EvolvingSystem(stepper, system, prepared, first)


def stepper_at(system: Assembly, state: SystemState, dt: Array) -> SystemStepper:
    """Integrator of a system at one moment, with constants computed once for a run."""
    return _with_parts(system, state, dt, held_parts(system, state))


def _with_parts(
    system: Assembly, state: SystemState, dt: Array, parts: AllParts
) -> SystemStepper:
    """Integrator of a system, whose members have the constants `parts`."""
    couplings = tuple(coupling.prepared(parts) for coupling in system.couplings)
    carried: dict[str, Carried] = {}
    for coupling in couplings:
        for name, own in coupling.carried(parts).items():
            carried[name] = (
                jax.tree.map(jnp.add, carried[name], own) if name in carried else own
            )
    members = {
        name: member.stepper(state[name], parts[name], carried.get(name), dt)
        for name, member in system.interfaces().items()
    }
    return SystemStepper(members, couplings, dt)
