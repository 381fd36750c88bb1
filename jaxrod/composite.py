"""Composite models: what is more than one scene, and is stepped and asked like one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Protocol

from jaxtyping import Array, ArrayLike, Float


class Stepper(Protocol):
    """An integrator with its constants worked out, as `advance` runs it.

    `begin` takes a state apart into the carry of the integrator, `cycle` is what
    the loop repeats, `end` finishes and puts the state together. Position Verlet's
    cycle ends where the kick of the next step acts, half a step on, so that
    neighbouring half drifts are one: `end(cycle(cycle(begin(state))))` is three
    steps, the last one finished by `end`.
    """

    steps_of_end: ClassVar[int]
    """Number of steps that `end` finishes, 1 or 0."""

    def begin(self, state: Any) -> Any:
        """Carry before the first step, from the initial state."""

    def cycle(self, carry: Any) -> Any:
        """A step that `end` does not finish."""

    def end(self, carry: Any) -> Any:
        """The state, from the carry after the last cycle."""


class Composite(ABC):
    """Base of what is more than one scene, and is stepped and asked like one.

    The functions that take a scene take it too, with its own kind of state.
    """

    @property
    @abstractmethod
    def depends_on_time(self) -> bool:
        """Whether a number is a schedule."""

    @property
    @abstractmethod
    def remembers(self) -> bool:
        """Whether an effect has something that it remembers."""

    @property
    @abstractmethod
    def evolves(self) -> bool:
        """Whether it depends on time or remembers."""

    @abstractmethod
    def recalling(self, state: Any) -> Any:
        """Itself with what its effects remember as it is in a state."""

    @abstractmethod
    def check_run(self, state: Any, dt: ArrayLike) -> Array:
        """Checks the arguments of a run; gives the step its type."""

    @abstractmethod
    def run_stepper(self, state: Any, dt: Array, first: Array | None) -> Stepper:
        """The integrator of a run; `first` counts where it evolves."""

    @abstractmethod
    def with_memory(self, state: Any) -> Any:
        """The state with the memory that its effects begin with, if it has none."""

    @abstractmethod
    def step_warning(self, dt: Array) -> str | None:
        """Words about a concrete step that is not stable; `None` for one that is."""

    @abstractmethod
    def stable_step(self, safety: ArrayLike) -> Any:
        """The largest stable step times a safety factor, in its field `dt`."""

    @abstractmethod
    def health(self, state: Any, dt: ArrayLike, limits: Any) -> Any:
        """Flags and what is behind them."""

    @abstractmethod
    def kinetic_energy(self, state: Any) -> Float[Array, ""]:
        """Kinetic energy [J]."""

    @abstractmethod
    def potential_energy(self, state: Any) -> Float[Array, ""]:
        """Stored energy and potentials [J]."""

    @abstractmethod
    def momentum(self, state: Any) -> Float[Array, "3"]:
        """Linear momentum [kg m/s]."""

    @abstractmethod
    def angular_momentum(self, state: Any) -> Float[Array, "3"]:
        """Angular momentum about the origin [kg m^2/s]."""
