"""Steps of a system that depends on time or has memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrod.effects.time import Clock, at_clock
from jaxrod.methods.now import Now, memory_in, remembering, scene_at
from jaxrod.scene import Scene
from jaxrod.structure import pytree
from jaxrod.systems.members.rigid_bodies import RigidBodies
from jaxrod.systems.members.steppers import (
    BodiesStepper,
    MemberStepper,
    RodsStepper,
    RodStepper,
)
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
    """Memories of the effects of its rods."""


@pytree
class EvolvingSystem:
    """Position Verlet of a system that depends on time or has memory.

    As for a scene, loads and rates are those of the middle of a step, and supports are
    where they are at the end of a drift.
    """

    steps_of_end: ClassVar[int] = 1
    stepper: SystemStepper
    """The stepper of the system at the beginning of the run."""
    system: Assembly
    """The system with its schedules."""
    couplings: tuple[Coupling, ...]
    """Couplings, prepared, with their schedules."""
    first: Int[Array, ""]
    """Steps since time zero at the beginning of the run."""

    def begin(self, state: Mapping[str, Any]) -> tuple[Motions, SystemNow]:
        """Carry in the middle of the first step."""
        memories = {
            name: _memory(member, state[name])
            for name, member in self.system.members.items()
            if isinstance(member, Scene)
        }
        now = SystemNow(self.first, memories)
        return self._at(now, 0.5).begin(state), now

    def cycle(self, carry: tuple[Motions, SystemNow]) -> tuple[Motions, SystemNow]:
        """Moves from the middle of a step to the middle of the next."""
        kicked, now = self._kick(carry)
        return self._at(now, 0.5).drift(kicked, self.stepper.dt), now

    def end(self, carry: tuple[Motions, SystemNow]) -> dict[str, Any]:
        """Moves from the middle of the last step to its end."""
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
        after = {
            name: self._remembered(present.members[name], kicked[name], memory)
            for name, memory in now.memories.items()
        }
        return kicked, SystemNow(now.step + 1, after)

    def _remembered(self, member: MemberStepper, motion: Any, memory: Any) -> Any:
        """Memory of a rod's effects one step later."""
        if not any(memory):
            return memory
        dt, none = self.stepper.dt, jnp.zeros((), jnp.int32)

        def one(scene: Scene, own: Any, had: Any) -> Any:
            return remembering(scene, own, dt, Now(none, had)).memory

        if isinstance(member, RodsStepper):
            return jax.vmap(one)(member.verlet.scene, motion, memory)
        assert isinstance(member, RodStepper)
        return one(member.verlet.scene, motion, memory)

    def _at(self, now: SystemNow, fraction: float) -> SystemStepper:
        """The stepper with the system as it is a fraction of a step later."""
        dt = self.stepper.dt
        clock = Clock(now.step, jnp.asarray(fraction, dt.dtype), dt)
        members: dict[str, MemberStepper] = {}
        for name, stepper in self.stepper.members.items():
            member = self.system.members[name]
            if isinstance(member, RigidBodies):
                assert isinstance(stepper, BodiesStepper)
                effects = at_clock(member.effects, clock)
                bodies = replace(stepper.rigid.bodies, effects=effects)
                rigid = replace(stepper.rigid, bodies=bodies)
                members[name] = replace(stepper, rigid=rigid)
            elif member.evolves:
                assert isinstance(stepper, RodStepper | RodsStepper)
                scene = _scene_at(member, now.step, now.memories[name], fraction, dt)
                verlet = replace(stepper.verlet, scene=scene)
                members[name] = replace(stepper, verlet=verlet)
            else:
                members[name] = stepper
        couplings = at_clock(self.couplings, clock)
        return replace(self.stepper, members=members, couplings=couplings)


def _memory(member: Scene, state: Any) -> Any:
    if member.rod.rest_lengths.ndim == 1:
        return memory_in(member, state)
    return jax.vmap(memory_in)(member, state)


def _scene_at(
    member: Scene, step: Array, memory: Any, fraction: float, dt: Array
) -> Scene:
    def one(scene: Scene, had: Any) -> Scene:
        return scene_at(scene, Now(step, had), fraction, dt)

    if member.rod.rest_lengths.ndim == 1:
        return one(member, memory)
    return jax.vmap(one)(member, memory)
