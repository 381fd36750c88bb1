"""Rods as members of a system: a scene of one rod, and scenes of equal rods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxrod.analysis.health import HealthLimits, health
from jaxrod.analysis.stability import stable_dt
from jaxrod.effects.base import Effect, StabilityBound
from jaxrod.effects.memory import memory_of
from jaxrod.geometry.vectors import Vec3
from jaxrod.methods.consistent import ConsistentStepper
from jaxrod.methods.now import memory_in
from jaxrod.methods.pyelastica import PyElasticaStepper
from jaxrod.rods.motion import Motion, motion_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import (
    Scene,
    angular_momentum,
    check_memory,
    kinetic_energy,
    momentum,
    potential_energy,
)
from jaxrod.statics.freedoms import free_rates
from jaxrod.structure import pytree
from jaxrod.systems.members.member import Member
from jaxrod.systems.members.parts import Parts, flatten_rods, parts_of, unflatten_rods
from jaxrod.systems.members.rigid_stepper import Carried
from jaxrod.systems.members.steppers import MemberStepper, RodsStepper, RodStepper


@dataclass(frozen=True)
class OneRod(Member):
    """One rod with its effects, as a member."""

    model: Scene

    @property
    def dtype(self) -> Any:
        """Type of all numbers."""
        return self.model.rod.rest_lengths.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of elements."""
        return jnp.shape(self.model.rod.rest_lengths)

    @property
    def remembers(self) -> bool:
        """Whether an effect has memory."""
        return self.model.remembers

    @property
    def rod(self) -> Rod:
        """Parameters of the rod."""
        return self.model.rod

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Calls a function with each rod's scene and its part of other arguments."""
        return function(self.model, *given)

    def mapped(self, function: Callable[[Any], Any]) -> Any:
        """The scene with a function applied to it."""
        return self.each(function)

    def recalling(self, state: Any) -> Any:
        """The scene with the memory of its effects in a state."""
        return self.each(Scene.recalling, state)

    def with_memory(self, state: Any) -> Any:
        """The state with the initial memory of its effects, if it has none."""
        if not self.remembers or state.memory is not None:
            return state

        def one(scene: Scene, own: RodState) -> RodState:
            return replace(own, memory=memory_of(scene.effects))

        return self.each(one, state)

    def memory(self, state: Any) -> Any:
        """Memory of its effects in a state."""
        return self.each(memory_in, state)

    def check_state(self, name: str, state: Any, dtype: Any) -> None:
        """Raises a TypeError or a ValueError if a state is not of this rod."""
        if not isinstance(state, RodState):
            raise TypeError(
                f"state of {name!r} must be a RodState, got {type(state).__name__}"
            )
        *batch, n = self.shape
        check_fields(name, state, (*batch, 3, n + 1), dtype, "angular_momenta")
        check_memory(self.model, state, f"state of {name!r}: state")

    def parts(self) -> Parts:
        """Constants, as couplings see them."""
        return parts_of(self.model.rod)

    def held(self, state: Any) -> Vec3 | None:
        """One for each node along each axis where a support holds it, else zero."""
        if not self.model.effects:
            return None
        x, y, z = self.row(self.each(_free_rates, state))
        return 1 - x, 1 - y, 1 - z

    def motion(self, state: Any) -> Motion:
        """Positions and rates in a state."""
        motion: Motion = self.row(self.each(lambda _, own: motion_of(own), state))
        return motion

    def row(self, tree: Any) -> Any:
        """Fields of every rod, with all nodes and elements in one row."""
        return tree

    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Its part of a step."""
        del carried
        return RodStepper(_verlet(self.model, state, dt), parts)

    def momenta(self, state: Any) -> tuple[Array, Array]:
        """Momenta of nodes and angular momenta of elements, components next to last."""
        masses = self.model.rod.node_masses
        return masses[..., None, :] * state.velocities, state.angular_momenta

    def kinetic_energy(self, state: Any) -> Array:
        """Kinetic energy [J]."""
        return self.total(lambda scene, own: kinetic_energy(scene.rod, own), state)

    def potential_energy(self, state: Any) -> Array:
        """Elastic energy, and potentials of its effects [J]."""
        return self.total(potential_energy, state)

    def momentum(self, state: Any) -> Array:
        """Linear momentum, world frame [kg m/s]."""
        return self.total(lambda scene, own: momentum(scene.rod, own), state)

    def angular_momentum(self, state: Any) -> Array:
        """Angular momentum about the origin, world frame [kg m^2/s]."""
        return self.total(lambda scene, own: angular_momentum(scene.rod, own), state)

    def total(self, function: Callable[[Scene, RodState], Array], state: Any) -> Array:
        """Sum of a function of every scene and its state."""
        return self.each(function, state)

    def health(self, state: Any, dt: ArrayLike, limits: HealthLimits) -> Any:
        """Flags and the measured values behind them, for every rod."""
        return self.each(lambda s, own: health(s, own, dt, limits=limits), state)

    def stable_step(self, bound: StabilityBound, safety: ArrayLike) -> tuple[Any, Any]:
        """The largest safe step [s], and what limits it."""

        def one(scene: Scene, own: StabilityBound) -> Any:
            effects = (*scene.effects, CouplingBounds(own))
            return stable_dt(replace(scene, effects=effects), safety)

        step = self.each(one, self.rows(bound))
        return jnp.min(step.dt), step

    def rows(self, tree: Any) -> Any:
        """Fields in one row, divided among the rods."""
        return tree


class EqualRods(OneRod):
    """Scenes of equal rods, with a leading axis on every number."""

    @property
    def count(self) -> int:
        """Number of rods."""
        return int(self.shape[0])

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Result of a function of a scene and of other things, for every rod."""
        return jax.vmap(function)(self.model, *given)

    def parts(self) -> Parts:
        """Constants, as couplings see them."""
        count, n = self.shape
        rows = flatten_rods(jax.vmap(parts_of)(self.model.rod))
        parts: Parts = replace(rows, count=count, n_elements=n)
        return parts

    def row(self, tree: Any) -> Any:
        """Fields of every rod, with all nodes and elements in one row."""
        return flatten_rods(tree)

    def rows(self, tree: Any) -> Any:
        """Fields in one row, divided among the rods."""
        return unflatten_rods(tree, self.count)

    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Its part of a step."""
        del carried
        verlet = self.each(lambda s, own: _verlet(s, own, dt), state)
        return RodsStepper(verlet, parts, parts.count)

    def total(self, function: Callable[[Scene, RodState], Array], state: Any) -> Array:
        """Sum of a function of every scene and its state."""
        return jnp.sum(self.each(function, state), axis=0)


@pytree
class CouplingBounds(Effect):
    """Stiffness and drag that couplings add to a rod: a bound without loads."""

    bound: StabilityBound
    """The bound."""

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """The given bound."""
        return self.bound


def check_fields(
    name: str, state: Any, shape: tuple[int, ...], dtype: Any, spins: str
) -> None:
    """Raises a ValueError if fields of a state have the wrong shape or type.

    Args:
        name: Name of the member.
        state: Its state.
        shape: Shape that positions must have.
        dtype: Type of the system.
        spins: Name of the field of spins.
    """
    if state.positions.shape != shape:
        raise ValueError(
            f"positions of {name!r} must have shape {shape}, got "
            f"{state.positions.shape}"
        )
    if state.positions.dtype != dtype:
        raise ValueError(
            f"state of {name!r} must be {dtype}, as the system is, got "
            f"{state.positions.dtype}"
        )
    for field in ("orientations", "velocities", spins):
        own = getattr(state, field).dtype
        if own != dtype:
            raise ValueError(
                f"{field} of {name!r} must be {dtype}, as the system is, got {own}"
            )


def _free_rates(scene: Scene, state: RodState) -> Vec3:
    return free_rates(scene, motion_of(state))[0]


def _verlet(
    scene: Scene, state: RodState, dt: Array
) -> ConsistentStepper | PyElasticaStepper:
    stepper = scene.method.stepper(scene, state, dt)
    assert isinstance(stepper, ConsistentStepper | PyElasticaStepper)
    return stepper
