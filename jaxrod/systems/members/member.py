"""The interface of a member: everything that a system asks of a rod or of bodies.

A system holds scenes, each of one rod or of equal rods with a leading axis, and rigid
bodies. A `Member` answers for one of them, so that nothing else has to know which one
it is. A new kind of member needs a model, its state, a `Member` and a stepper, and
entries in `member_of`, `make_system` and `jaxrod.systems.sites.places`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, ArrayLike

from jaxrod.analysis.health import HealthLimits
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.systems.members.parts import Parts
from jaxrod.systems.members.rigid_stepper import Carried
from jaxrod.systems.members.steppers import MemberStepper


class Member(ABC):
    """Part of a system: one rod, equal rods, or rigid bodies."""

    model: Any
    """Scene or rigid bodies for which it answers."""

    @property
    @abstractmethod
    def dtype(self) -> Any:
        """Type of all numbers."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of its elements, or of its bodies."""

    @property
    def remembers(self) -> bool:
        """Whether an effect has memory."""
        return False

    @property
    def rod(self) -> Rod | None:
        """Parameters of the rod or of equal rods; `None` for bodies."""
        return None

    @abstractmethod
    def mapped(self, function: Callable[[Any], Any]) -> Any:
        """The model after a function was applied to each scene, or to the bodies."""

    @abstractmethod
    def recalling(self, state: Any) -> Any:
        """The model with the memory of its effects in a state."""

    @abstractmethod
    def with_memory(self, state: Any) -> Any:
        """The state with the initial memory of its effects, if it has none."""

    @abstractmethod
    def memory(self, state: Any) -> Any:
        """Memory of its effects in a state; empty if there is none."""

    @abstractmethod
    def check_state(self, name: str, state: Any, dtype: Any) -> None:
        """Raises a TypeError or a ValueError if a state is not of this member."""

    @abstractmethod
    def parts(self) -> Parts:
        """Constants, as couplings see them, without what holds the member."""

    @abstractmethod
    def held(self, state: Any) -> Vec3 | None:
        """One per node and axis that a support holds, else zero; `None` for none."""

    @abstractmethod
    def motion(self, state: Any) -> Motion:
        """Positions and rates in a state, as couplings see them, spins as momenta."""

    @abstractmethod
    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Its part of a step, with constants computed once.

        Args:
            state: State of the member.
            parts: Its constants.
            carried: Masses that are attached to its bodies, if there are any.
            dt: Step size [s].
        """

    @abstractmethod
    def momenta(self, state: Any) -> tuple[Array, Array]:
        """Momenta of nodes or bodies [kg m/s], angular ones of elements [kg m^2/s]."""

    @abstractmethod
    def kinetic_energy(self, state: Any) -> Array:
        """Kinetic energy [J]."""

    @abstractmethod
    def potential_energy(self, state: Any) -> Array:
        """Elastic energy, and potentials of its effects [J]."""

    @abstractmethod
    def momentum(self, state: Any) -> Array:
        """Linear momentum, world frame [kg m/s]."""

    @abstractmethod
    def angular_momentum(self, state: Any) -> Array:
        """Angular momentum about the origin, world frame [kg m^2/s]."""

    @abstractmethod
    def health(self, state: Any, dt: ArrayLike, limits: HealthLimits) -> Any:
        """Flags and the measured values behind them."""

    @abstractmethod
    def stable_step(self, bound: StabilityBound, safety: ArrayLike) -> tuple[Any, Any]:
        """The largest safe step [s], and what limits it; `None` for bodies.

        Args:
            bound: Bounds that couplings add.
            safety: Fraction of the limit to use.
        """
