"""Rods and rigid bodies by name with their couplings, and what couplings see."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Self

from jaxtyping import ArrayLike

from jaxrod.effects.base import Effect
from jaxrod.effects.time import (
    Clock,
    at_clock,
    at_largest,
    clock_at,
    depends_on_time,
)
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import Coupling, Parts, Seen, searched, with_found
from jaxrod.systems.members.member import Member

SystemState = Mapping[str, Any]
"""States of the members, by name: `RodState`, `BodyState` or a state of your own."""


@pytree
class Assembly:
    """Rods and rigid bodies by name, and the couplings between them."""

    members: dict[str, Any]
    """Scenes, equal scenes with a leading axis, rigid bodies and members of your own:
    anything with a method `as_member`, by name."""
    couplings: tuple[Coupling, ...] = ()
    """Couplings between them."""
    shapes: tuple[tuple[int, ...], ...] = static(default=())
    """`array_shape` of each member when the system was made, by which a batch of
    systems is detected."""

    def interfaces(self) -> dict[str, Member]:
        """The members by name, each through the interface `Member`."""
        return {name: held.as_member() for name, held in self.members.items()}

    @property
    def dtype(self) -> Any:
        """Floating-point dtype of all numbers."""
        return next(iter(self.members.values())).as_member().dtype

    @property
    def depends_on_time(self) -> bool:
        """Whether a number of an effect or a coupling is a schedule."""
        effects = [member.effects for member in self.interfaces().values()]
        return depends_on_time((self.couplings, effects))

    @property
    def remembers(self) -> bool:
        """Whether an effect on a rod has memory."""
        return any(member.remembers for member in self.interfaces().values())

    @property
    def evolves(self) -> bool:
        """Whether the system depends on time or has memory."""
        return self.depends_on_time or self.remembers

    def at(self, time: ArrayLike | Clock) -> Self:
        """Copy of the system at a time [s], with schedules replaced by their values."""
        if not self.depends_on_time:
            return self
        clock = clock_at(time, self.dtype)
        return self._replaced(lambda tree: at_clock(tree, clock))

    @property
    def at_largest(self) -> Self:
        """Copy with every schedule replaced by the bound on its size."""
        return self._replaced(at_largest) if self.depends_on_time else self

    def _replaced(self, function: Callable[[Any], Any]) -> Self:
        """Copy with a function applied to every member and to the couplings."""
        members = {
            name: member.each(function) for name, member in self.interfaces().items()
        }
        return replace(self, members=members, couplings=function(self.couplings))

    def with_effect(self, effect: Effect) -> Self:
        """Copy of the system with one more effect on each member."""
        members = {
            name: member.with_effect(effect)
            for name, member in self.interfaces().items()
        }
        return replace(self, members=members)

    def recalling(self, state: SystemState) -> Self:
        """Copy of the system whose effects have the memory that a state holds."""
        if not self.remembers:
            return self
        members = {
            name: member.recalling(state[name])
            if member.remembers
            else self.members[name]
            for name, member in self.interfaces().items()
        }
        return replace(self, members=members)

    @property
    def without_slip(self) -> Self:
        """Copy whose static friction holds; the system itself if it has none."""
        if not self.remembers:
            return self
        members = {
            name: member.without_slip if member.remembers else self.members[name]
            for name, member in self.interfaces().items()
        }
        if all(members[name] is self.members[name] for name in members):
            return self
        return replace(self, members=members)

    def parts(self) -> dict[str, Parts]:
        """Constants of all members, for couplings, without flags of supports."""
        return {name: member.parts() for name, member in self.interfaces().items()}

    def in_space(self) -> Self:
        """Copy whose members leave nothing out, for statics."""
        spatial = {name: own.in_space() for name, own in self.interfaces().items()}
        return replace(self, members=spatial)


def member_shapes(members: Mapping[str, Any]) -> tuple[tuple[int, ...], ...]:
    """`array_shape` of each member, in the order of their sorted names."""
    # JAX sorts a dict by its keys, so the order given by the user is lost.
    return tuple(members[name].as_member().array_shape for name in sorted(members))


def held_parts(system: Assembly, state: SystemState) -> dict[str, Parts]:
    """Constants of all members, with flags of the nodes that supports hold."""
    parts = system.parts()
    # The flags are the same at all times, wherever a support moves its node.
    for name, member in system.at(0.0).interfaces().items():
        held = member.held(state[name])
        if held is not None:
            parts[name] = replace(parts[name], held=held)
    return parts


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
