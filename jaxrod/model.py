"""Models, which can be stepped and have energies, and their common interface.

A `Scene` is a model of one rod, a `System` one of several members. `advance`,
`rollout`, `stable_dt`, `health` and `settled` call methods of a model and never test
its class.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.geometry.vectors import Vec3

GUESSES = {
    **dict.fromkeys(
        ("integrate", "run", "simulate"),
        "jaxrod.advance computes a later state, jaxrod.rollout also those on the way",
    ),
    **dict.fromkeys(
        ("add", "append", "finalize"),
        "jaxrod.make_scene joins a rod and effects, jaxrod.make_system several rods",
    ),
    "advance": "it is jaxrod.advance(scene, state, dt, n_steps)",
    "dt": "it is jaxrod.stable_dt(scene).dt",
    "rollout": "it is jaxrod.rollout(scene, state, dt, n_steps, every)",
    "state": "it is the state that jaxrod.straight_rod returns with the rod",
    "step": "it is jaxrod.step(scene, state, dt)",
}
"""Hints at functions of a model, by the method that users of other tools guess."""


class HasStep(Protocol):
    """Has a time step `dt`, as the result of `jaxrod.stable_dt` has."""

    @property
    def dt(self) -> Any:
        """Time step [s]."""


TimeStep = ArrayLike | HasStep
"""A time step [s], or an object that has one."""


class Stepper(Protocol):
    """An integrator with its constants computed, as `advance` runs it.

    `begin` unpacks a state into the carry of the integrator, `cycle` is the body of the
    loop, `end` finishes and packs the state. Position Verlet's cycle ends half a step
    later, where the kick of the next step acts, so that neighbouring half drifts are
    merged: `end(cycle(cycle(begin(state))))` is three steps, the last one finished by
    `end`.

    Example:
        >>> stepper = scene.method.stepper(scene, state, jnp.float32(1e-4))
        >>> after = stepper.end(stepper.cycle(stepper.begin(state)))
        >>> after.positions.shape, stepper.steps_of_end
        ((3, 11), 1)
    """

    steps_of_end: ClassVar[int]
    """Number of steps that `end` completes: 1 for position Verlet, else 0."""

    def begin(self, state: Any) -> Any:
        """Carry before the first step, from the initial state."""

    def cycle(self, carry: Any) -> Any:
        """Carry one step later: the body of the loop."""

    def end(self, carry: Any) -> Any:
        """Final state, from the carry after the last cycle."""


class Model(ABC):
    """Base class of all models: a scene of one rod, or a system of several members.

    The state of a scene is a `RodState`; the state of a system is a dict of states by
    member.
    """

    @property
    @abstractmethod
    def depends_on_time(self) -> bool:
        """Whether a parameter of the model is a schedule."""

    @property
    @abstractmethod
    def remembers(self) -> bool:
        """Whether an effect has memory from step to step."""

    @property
    @abstractmethod
    def evolves(self) -> bool:
        """Whether the model depends on time or has memory."""

    @abstractmethod
    def at(self, time: Any) -> Self:
        """The model at a time [s], in which schedules are replaced by their values."""

    @abstractmethod
    def check_moment(self) -> None:
        """Raises a `ValueError` if the model depends on time: `at` is needed first."""

    @abstractmethod
    def recalling(self, state: Any) -> Self:
        """Copy of the model whose effects have the memory that a state stores."""

    @abstractmethod
    def with_memory(self, state: Any) -> Any:
        """State, with the initial memory of all effects if it has none."""

    @abstractmethod
    def interfaces(self) -> dict[str, Any]:
        """The model's members by name; a scene has one member, whose name is ""."""

    @abstractmethod
    def states_by_name(self, state: Any) -> Mapping[str, Any]:
        """States of the members by name, taken from a state of the model."""

    @abstractmethod
    def with_states(self, state: Any, changed: Mapping[str, Any]) -> Any:
        """Copy of a state of the model, with the states of named members replaced."""

    @abstractmethod
    def with_members(self, changed: Mapping[str, Any]) -> Self:
        """The model with other entries for named members; a scene's name is ""."""

    @abstractmethod
    def softened(self, share: ArrayLike) -> Self:
        """The model whose contacts have a share of their stiffness."""

    @abstractmethod
    def thinned(self, share: float) -> Self:
        """The model whose contacts have a share of their points, at least one each."""

    @abstractmethod
    def check_state(self, state: Any) -> None:
        """Raises unless this is one model, no batch, and a state fits it."""

    def regridded(self, old: Self, state: Any) -> Self:
        """Copy whose couplings fit members with other numbers of elements.

        Args:
            old: The model before its members changed.
            state: State of the new members.
        """
        return self

    def joined_nodes(self) -> dict[str, set[int]]:
        """Nodes of rods that couplings are fixed to, by member, counted in each rod."""
        return {}

    def missed_contact(self, state: Any) -> Any:
        """Flag of a state: neighbour lists had too few entries since the run began."""
        return False

    @abstractmethod
    def contact_forces(self, state: Any) -> list[tuple[str, Vec3]]:
        """Contact forces on the nodes of members, world frame [N], for replays.

        Each entry is due to one effect or coupling: the name of a member, and the
        forces on its nodes. Arrays are flat: the nodes of equal rods follow one
        another.
        """

    @abstractmethod
    def with_effect(self, effect: Any) -> Self:
        """The model with one more effect on each of its members."""

    @abstractmethod
    def check_run(self, state: Any, dt: TimeStep, first: Array | None) -> Array:
        """Validates the arguments of a run; returns the step in the model's dtype [s].

        Args:
            state: Initial state.
            dt: Step size [s].
            first: Number of the first step, counted from time zero; `None` for a model
                without schedules and memory.
        """

    @abstractmethod
    def run_stepper(self, state: Any, dt: Array, first: Array | None) -> Stepper:
        """Integrator of a run; the number `first` of its first step sets the time."""

    @abstractmethod
    def step_warning(self, dt: Array, state: Any) -> tuple[str | None, bool]:
        """Tests whether a concrete step is stable.

        Args:
            dt: Step size [s].
            state: State of the rod, if the bound is to account for compression. In
                consistent mode its values are read, which waits for JAX, only if `dt`
                is near the bound.

        Returns:
            The text of a warning, `None` if the step is stable; and whether the step
            may become unstable if a rod is compressed further.
        """

    @abstractmethod
    def stable_step(self, safety: ArrayLike, *, state: Any = None) -> Any:
        """Result of `jaxrod.stable_dt`: `safety` times the largest stable step."""

    @abstractmethod
    def health(
        self,
        state: Any,
        dt: TimeStep,
        *,
        limits: Any = None,
        energy_before: ArrayLike | None = None,
        work_input: ArrayLike = 0.0,
        n_steps: ArrayLike = 1000,
        before: Any = None,
    ) -> Any:
        """Result of `jaxrod.health`: flags of a state, and the values behind them."""

    @abstractmethod
    def reactions(self, state: Any) -> Any:
        """Result of `jaxrod.reactions`: loads of supports, and of couplings."""

    @abstractmethod
    def equilibrium(
        self,
        state: Any,
        *,
        tolerance: ArrayLike | None = None,
        max_iterations: int = 400,
    ) -> Any:
        """Result of `jaxrod.equilibrium`: a configuration whose loads balance."""

    @abstractmethod
    def squared_frequencies(self, state: Any) -> np.ndarray:
        """Squares of all angular frequencies about a state at rest [rad^2/s^2]."""

    @abstractmethod
    def kinetic_energy(self, state: Any) -> Float[Array, ""]:
        """Kinetic energy of translation and rotation [J]."""

    @abstractmethod
    def potential_energy(self, state: Any) -> Float[Array, ""]:
        """Stored elastic energy, and potentials of effects and couplings [J].

        Raises:
            ValueError: If the model depends on time: call this on `model.at(time)`.
        """

    def total_energy(self, state: Any) -> Float[Array, ""]:
        """Kinetic plus potential energy [J].

        Raises:
            ValueError: If the model depends on time: call this on `model.at(time)`.

        Example:
            >>> total = scene.total_energy(state)
            >>> parts = scene.kinetic_energy(state) + scene.potential_energy(state)
            >>> bool(total == parts)
            True
        """
        return self.kinetic_energy(state) + self.potential_energy(state)

    @abstractmethod
    def momentum(self, state: Any) -> Float[Array, "3"]:
        """Linear momentum, world frame [kg m/s]."""

    @abstractmethod
    def angular_momentum(self, state: Any) -> Float[Array, "3"]:
        """Angular momentum about the origin, world frame [kg m^2/s]."""


def check_model(scene: Any) -> None:
    """Raises a `TypeError` if an argument `scene` is not a model."""
    if isinstance(scene, Model):
        return
    hint = " (factories return the pair rod, state)" if isinstance(scene, tuple) else ""
    raise TypeError(
        f"scene must be a jaxrod.Scene or a jaxrod.System, got {type(scene).__name__}"
        f"{hint}"
    )
