"""Steps of a system that changes in a run: by time, memory, or lists of neighbours.

Lists are carried from step to step together with the motions and the age of the lists
in steps. This age does not depend on the numbers of a system. So under `jax.vmap` it is
the same for all systems, and the search stays a branch that is taken only when it is
due.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrod.effects.time import Clock, at_clock
from jaxrod.lanes.steps import by_kernel
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.neighbour_lists import RECORD, NeighbourRecord
from jaxrod.systems.coupling import Coupling, Seen
from jaxrod.systems.stepping.assembly import Assembly
from jaxrod.systems.stepping.stepper import Motions, SystemStepper

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
class EvolvingSystem:
    """Position Verlet of a system that depends on time or has memory.

    As for a scene, loads and rates are those of the middle of a step. Driven supports
    have their positions at the end of a drift.
    """

    steps_of_end: ClassVar[int] = 1
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

    def cycle(self, carry: tuple[Motions, SystemNow]) -> tuple[Motions, SystemNow]:
        """Loop carry in the middle of the next step: a kick, then a whole drift."""
        kicked, now = self._kick(carry)
        return self._at(now, 0.5).drift(kicked, self.stepper.dt), now

    def end(self, carry: tuple[Motions, SystemNow]) -> dict[str, Any]:
        """State at the end of the last step, from the carry in the middle of it."""
        kicked, now = self._kick(carry)
        last = self._at(now, 0.0)
        moved = last.drift(kicked, 0.5 * self.stepper.dt)
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

    def _at(self, now: SystemNow, fraction: float) -> SystemStepper:
        """Stepper with schedules at `fraction` of a step after step `now.step`."""
        dt = self.stepper.dt
        clock = Clock(now.step, jnp.asarray(fraction, dt.dtype), dt)
        members = {
            name: stepper.at(self.system.members[name], now.memories[name], clock)
            for name, stepper in self.stepper.members.items()
        }
        couplings = at_clock(self.couplings, clock)
        return replace(self.stepper, members=members, couplings=couplings)


def refresh_every(couplings: Sequence[Coupling]) -> int | None:
    """Steps between searches: the least of all couplings; `None` if none searches."""
    asked = [c.refresh_every for c in couplings if c.refresh_every is not None]
    return min(asked) if asked else None


def lists_neighbours(system: Assembly) -> bool:
    """Whether a system has couplings that search for neighbours."""
    return refresh_every(system.couplings) is not None


def with_found(
    couplings: Sequence[Coupling], found: Sequence[Any]
) -> tuple[Coupling, ...]:
    """Couplings with the results `found` of their searches in the field `found`."""
    left = iter(found)
    # A coupling that searches is a dataclass, by its decorator, with a field `found`.
    return tuple(
        c if c.refresh_every is None else replace(c, found=next(left))  # type: ignore[type-var]
        for c in couplings
    )


def searched(couplings: Sequence[Coupling], seen: Any) -> tuple[Any, ...]:
    """Results of the search of every coupling that searches for neighbours."""
    return tuple(c.search(seen) for c in couplings if c.refresh_every is not None)


def with_shortage(
    record: NeighbourRecord, couplings: Sequence[Coupling]
) -> NeighbourRecord:
    """Updates the record with the shortage of entries in the last searches."""
    missed, used = record.missed, record.used
    for coupling in couplings:
        if coupling.refresh_every is not None:
            own: Any = coupling
            missed = jnp.maximum(missed, own.found.missed)
            used = jnp.maximum(used, jnp.max(own.found.used))
    return replace(record, missed=missed, used=used)


@pytree
class Listing:
    """Loop carry: motions of a system, its lists of neighbours and their age."""

    motions: Any
    """Motions of the members: the loop carry of the stepper that this one wraps."""
    found: tuple[Any, ...]
    """Results of the last search of each coupling that searches."""
    age: Int[Array, ""]
    """Number of steps since the last search."""
    record: NeighbourRecord
    """Worst shortage and age of the lists since the run began."""


@pytree
class ListingSystem:
    """Position Verlet of a system with lists of neighbours."""

    steps_of_end: ClassVar[int] = 1
    one_by_one: ClassVar[bool] = True
    """Whether the systems of a batch are stepped one after another, so that branches
    on the contents of lists stay branches."""
    stepper: SystemStepper | EvolvingSystem
    """The stepper of the system, whose couplings have no lists yet."""
    every: int = static()
    """Steps between searches."""

    def begin(self, state: Mapping[str, Any]) -> Listing:
        """Loop carry in the middle of the first step; a search is due at once."""
        motions = by_kernel(self.stepper, "begin", state)
        like = jax.eval_shape(self.search, motions)
        found = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)
        return Listing(motions, found, jnp.int32(self.every), state[RECORD])

    def search(self, motions: Any) -> tuple[Any, ...]:
        """Results of the searches of all couplings, without derivatives."""
        motions = jax.lax.stop_gradient(motions)
        return searched(self.stepper.couplings, self._seen(motions))

    def renewed(self, carry: Listing) -> Listing:
        """The carry with new lists if they are `every` steps old; else unchanged."""
        found = jax.lax.cond(
            carry.age >= self.every,
            lambda _: by_kernel(self, "search", carry.motions),
            lambda found: found,
            carry.found,
        )
        age = jnp.where(carry.age >= self.every, 0, carry.age)
        return replace(carry, found=found, age=age)

    def cycle(self, carry: Listing) -> Listing:
        """Loop carry in the middle of the next step, with the same lists."""
        carry = replace(carry, record=self._recorded(carry))
        moved = self._listed(carry).cycle(carry.motions)
        return replace(carry, motions=moved, age=carry.age + 1)

    def end(self, carry: Listing) -> dict[str, Any]:
        """State at the end of the last step, with the record of the lists."""
        return by_kernel(self, "ended", carry)

    def ended(self, carry: Listing) -> dict[str, Any]:
        """State at the end of the last step; `end` calls it in a kernel."""
        state = self._listed(carry).end(carry.motions)
        return {**state, RECORD: self._recorded(carry)}

    def _recorded(self, carry: Listing) -> NeighbourRecord:
        """Updates the record with the current lists and motions; no derivatives."""
        carry = jax.lax.stop_gradient(carry)
        couplings = self._listed(carry).couplings
        seen = self._seen(carry.motions)
        moved = carry.record.moved
        for coupling in couplings:
            if coupling.refresh_every is not None:
                moved = jnp.maximum(moved, coupling.moved(seen))
        return with_shortage(replace(carry.record, moved=moved), couplings)

    def _listed(self, carry: Listing) -> SystemStepper | EvolvingSystem:
        """The stepper, with the lists of the carry in its couplings."""
        couplings = with_found(self.stepper.couplings, carry.found)
        return replace(self.stepper, couplings=couplings)

    def _seen(self, motions: Any) -> Any:
        """Constants and motion of all members, as couplings read them."""
        return self.stepper.seen(motions)
