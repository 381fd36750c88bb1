"""Position Verlet: drift, kick, drift, with the half drifts of neighbours merged."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, ClassVar

from jaxtyping import Array, Int

from jaxrod.methods.now import Now, memory_in, remembering, scene_at
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene, constrain_rates
from jaxrod.structure import pytree


@pytree
class Verlet(ABC):
    """Position Verlet, of the drift and kick that a subclass defines.

    A cycle goes from the middle of one step, where its kick acts, to the middle of
    the next.
    """

    steps_of_end: ClassVar[int] = 1
    scene: Scene
    """The scene."""
    dt: Array
    """Step size [s]."""

    @abstractmethod
    def enter(self, state: RodState) -> Any:
        """Takes a state apart into what drift and kick work on."""

    @abstractmethod
    def leave(self, motion: Any) -> RodState:
        """Puts the state together again."""

    @abstractmethod
    def drift(self, motion: Any, dt: Array) -> Any:
        """Moves at unchanged rates for a time `dt` [s]."""

    @abstractmethod
    def kick(self, motion: Any) -> Any:
        """Changes the rates by all loads over one step, at rest."""

    def view(self, motion: Any) -> Motion:
        """The motion as effects see it. What they do not look at costs nothing."""
        return motion

    def constrain_rates(self, motion: Any) -> Any:
        """Applies all constraints on rates."""
        return constrain_rates(self.scene, motion)

    def begin(self, state: RodState) -> Any:
        """Carry in the middle of the first step, from the initial state."""
        return self.drift(self.enter(state), 0.5 * self.dt)

    def cycle(self, motion: Any) -> Any:
        """Advances from the middle of a step to the middle of the next."""
        return self.drift(self.kick(motion), self.dt)

    def end(self, motion: Any) -> RodState:
        """Final state, from the carry in the middle of the last step."""
        return self.leave(self.drift(self.kick(motion), 0.5 * self.dt))

    def evolving(self, scene: Scene, first: Array) -> EvolvingVerlet:
        """The same for a scene that depends on time or remembers."""
        return EvolvingVerlet(self, scene, first)


@pytree
class EvolvingVerlet:
    """Position Verlet of a scene that depends on time or remembers.

    Loads and rates are those of the middle of a step, where the kick acts; what is held
    is where it is at the end of a drift.
    """

    steps_of_end: ClassVar[int] = 1
    verlet: Verlet
    """The stepper of the scene as it is when it begins."""
    scene: Scene
    """The scene with its schedules."""
    first: Int[Array, ""]
    """Steps since time zero when it begins."""

    def begin(self, state: RodState) -> tuple[Any, Now]:
        """To the middle of the first step."""
        now = Now(self.first, memory_in(self.scene, state))
        return self._at(now, 0.5).begin(state), now

    def cycle(self, carry: tuple[Any, Now]) -> tuple[Any, Now]:
        """From the middle of a step to the middle of the next."""
        kicked, now = self._kick(carry)
        return self._at(now, 0.5).drift(kicked, self.verlet.dt), now

    def end(self, carry: tuple[Any, Now]) -> RodState:
        """From the middle of the last step to its end."""
        kicked, now = self._kick(carry)
        last = self._at(now, 0.0)
        moved = last.drift(kicked, 0.5 * self.verlet.dt)
        if self.scene.depends_on_time:
            # What is driven has the rates of now, not those of half a step ago.
            moved = last.constrain_rates(moved)
        state = last.leave(moved)
        return replace(state, memory=now.memory) if any(now.memory) else state

    def _kick(self, carry: tuple[Any, Now]) -> tuple[Any, Now]:
        """The kick, and what effects remember of it; the clock shows the next step."""
        motion, now = carry
        present = self._at(now, 0.5)
        kicked = present.kick(motion)
        seen = present.view(kicked)
        return kicked, remembering(present.scene, seen, self.verlet.dt, now)

    def _at(self, now: Now, fraction: float) -> Verlet:
        """The stepper with the scene as it is a part of a step later."""
        scene = scene_at(self.scene, now, fraction, self.verlet.dt)
        return replace(self.verlet, scene=scene)
