"""Position Verlet: drift, kick, drift, with the half drifts of neighbours merged."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from jaxtyping import Array

from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
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

    def begin(self, state: RodState) -> Any:
        """Carry in the middle of the first step, from the initial state."""
        return self.drift(self.enter(state), 0.5 * self.dt)

    def cycle(self, motion: Any) -> Any:
        """Advances from the middle of a step to the middle of the next."""
        return self.drift(self.kick(motion), self.dt)

    def end(self, motion: Any) -> RodState:
        """Final state, from the carry in the middle of the last step."""
        return self.leave(self.drift(self.kick(motion), 0.5 * self.dt))
