"""Composite models: models of more than one scene, used like a single scene."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Protocol

from jaxtyping import Array, ArrayLike, Float


class Stepper(Protocol):
    """An integrator with its constants computed, as `advance` runs it.

    `begin` unpacks a state into the carry of the integrator, `cycle` is the body of the
    loop, `end` finishes and packs the state. Position Verlet's cycle ends where the
    kick of the next step acts, half a step on, so that neighbouring half drifts are
    merged: `end(cycle(cycle(begin(state))))` is three steps, the last one finished by
    `end`.
    """

    steps_of_end: ClassVar[int]
    """Number of steps that `end` finishes, 1 or 0."""

    def begin(self, state: Any) -> Any:
        """Carry before the first step, from the initial state."""

    def cycle(self, carry: Any) -> Any:
        """Takes a step that `end` does not finish."""

    def end(self, carry: Any) -> Any:
        """Final state, from the carry after the last cycle."""


class Composite(ABC):
    """Base of models of more than one scene, which are used like a single scene.

    The functions that take a scene also take such a model, with its own kind of state.
    """

    @property
    @abstractmethod
    def depends_on_time(self) -> bool:
        """Whether a number is a schedule."""

    @property
    @abstractmethod
    def remembers(self) -> bool:
        """Whether an effect has memory."""

    @property
    @abstractmethod
    def evolves(self) -> bool:
        """Whether it depends on time or has memory."""

    @abstractmethod
    def check_moment(self) -> None:
        """Raises a `ValueError` if it depends on time."""

    @abstractmethod
    def recalling(self, state: Any) -> Any:
        """The model with the memory of its effects as in a state."""

    @abstractmethod
    def check_run(self, state: Any, dt: ArrayLike) -> Array:
        """Checks the arguments of a run; returns the step in the model's dtype."""

    @abstractmethod
    def run_stepper(self, state: Any, dt: Array, first: Array | None) -> Stepper:
        """Integrator of a run; `first` is used if the model evolves."""

    @abstractmethod
    def with_memory(self, state: Any) -> Any:
        """State with the initial memory of its effects, if it has none yet."""

    @abstractmethod
    def step_warning(self, dt: Array) -> str | None:
        """Warning about a concrete step that is not stable; `None` if it is stable."""

    @abstractmethod
    def stable_step(self, safety: ArrayLike) -> Any:
        """Largest stable step times a safety factor, in the field `dt`."""

    @abstractmethod
    def health(self, state: Any, dt: ArrayLike, limits: Any) -> Any:
        """Flags of a state and the values behind them."""

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
