"""Steps of a system that depends on time or has memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrod.effects.time import Clock, at_clock
from jaxrod.structure import pytree
from jaxrod.systems.members.parts import Seen
from jaxrod.systems.sites.coupling import Coupling
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
