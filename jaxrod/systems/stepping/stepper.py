"""Steps of a system: its members drift and are kicked together.

One step is position Verlet, as for a single rod: half a drift of every member; exact
positions of attached and tied nodes; loads of all members and couplings at this
configuration; kicks; exchange of impulses between attached members; half a drift.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from jaxtyping import Array

from jaxrod.rods.motion import Loads, Motion, added
from jaxrod.structure import pytree
from jaxrod.systems.coupling import Coupling, Seen
from jaxrod.systems.members.steppers import MemberStepper

Motions = dict[str, Motion]
"""Motions of the members, by name."""


@pytree
class SystemStepper:
    """Position Verlet of all members and their couplings, with constants of a run."""

    steps_of_end: ClassVar[int] = 1
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
            for name, loads in coupling.loads(seen).items():
                total[name] = added(total.get(name, Loads()), loads)
        return total

    def begin(self, state: Mapping[str, Any]) -> Motions:
        """Loop carry in the middle of the first step, from the initial state."""
        return self.drift(self.enter(state), 0.5 * self.dt)

    def cycle(self, motions: Motions) -> Motions:
        """Loop carry in the middle of the next step: a kick, then a whole drift."""
        return self.drift(self.kick(motions), self.dt)

    def end(self, motions: Motions) -> dict[str, Any]:
        """State at the end of the last step, from the carry in the middle of it."""
        return self.leave(self.drift(self.kick(motions), 0.5 * self.dt))

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
