"""Rods as members of a system: a scene of one rod, and scenes of equal rods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxrod.analysis.health import HealthLimits, scene_health
from jaxrod.analysis.stability import scene_stable_step
from jaxrod.effects.base import Effect, StabilityBound
from jaxrod.effects.memory import memory_of
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod, check_memory
from jaxrod.methods.now import memory_in
from jaxrod.rods.motion import Motion, motion_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.statics.degrees_of_freedom import free_velocity_mask
from jaxrod.structure import pytree
from jaxrod.systems.members.member import Member, check_axes, check_fields
from jaxrod.systems.members.parts import Parts, flatten_rods, parts_of, unflatten_rods
from jaxrod.systems.members.rigid_stepper import Carried
from jaxrod.systems.members.steppers import MemberStepper, RodsStepper, RodStepper
from jaxrod.validation import check_kind


@dataclass(frozen=True)
class OneRod(Member):
    """One rod with its effects, as a member."""

    model: Any
    """Its scene, a `LoadedRod`."""

    @property
    def dtype(self) -> Any:
        """Type of all numbers."""
        return self.model.rod.rest_lengths.dtype

    @property
    def array_shape(self) -> tuple[int, ...]:
        """Number of elements."""
        return jnp.shape(self.model.rod.rest_lengths)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects on the rod."""
        effects: tuple[Effect, ...] = self.model.effects
        return effects

    def check(self, name: str) -> None:
        """Raises a ValueError for a batch, or a method without steps in a system."""
        shape, axes = self.array_shape, (("elements",), ("rods", "elements"))
        check_axes(name, "rest lengths", shape, *axes)
        if not self.model.method.steps_in_systems:
            raise ValueError(
                f"member {name!r} steps with {type(self.model.method).__name__}, which "
                "has no steps in a system: use consistent() or pyelastica()"
            )

    def check_statics(self, name: str) -> None:
        """Raises a ValueError for a law whose loads have no energy."""
        if not self.model.method.has_energy:
            raise ValueError(
                f"member {name!r}: statics need the consistent law, got "
                f"{self.model.method!r}"
            )

    def with_effect(self, effect: Effect) -> Any:
        """The scene with one more effect, the same for equal rods."""
        return self.each(lambda scene: scene.with_effect(effect))

    def in_own_type(self, name: str) -> Any:
        """The scene: `make_scene` has converted its effects."""
        return self.model

    def with_free_ends(self, free: Array) -> Any:
        """The scene, whose effects have flags of the free ends of its rods."""
        if not self.effects or bool(jnp.all(free)):
            return self.model
        own = self.of_rods(free)
        effects = tuple(effect.with_free_ends(own) for effect in self.effects)
        return replace(self.model, effects=effects)

    def of_rods(self, numbers: Array) -> Array:
        """Numbers of every rod in the shape of the scene: without the axis of rods."""
        return numbers[0]

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

    def recalling(self, state: Any) -> Any:
        """The scene with the memory of its effects in a state."""
        return self.each(lambda scene, own: scene.recalling(own), state)

    def with_memory(self, state: Any) -> Any:
        """The state with the initial memory of its effects, if it has none."""
        if not self.remembers or state.memory is not None:
            return state

        def one(scene: LoadedRod, own: RodState) -> RodState:
            return replace(own, memory=memory_of(scene.effects))

        return self.each(one, state)

    def memory(self, state: Any) -> Any:
        """Memory of its effects in a state."""
        return self.each(memory_in, state)

    def check_state(self, name: str, state: Any, dtype: Any) -> None:
        """Raises a TypeError or a ValueError if a state is not of this rod."""
        check_kind(f"state of {name!r}", state, RodState)
        *batch, n = self.array_shape
        check_fields(name, state, (*batch, 3, n + 1), dtype, "angular_momenta")
        check_memory(self.model, state, f"state of {name!r}: state")

    def parts(self) -> Parts:
        """Constants, as couplings see them."""
        return parts_of(self.model.rod)

    def held(self, state: Any) -> Vec3 | None:
        """Flags per node and axis: 1 where a support holds the node, else 0."""
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
        return RodStepper(self.model.method.stepper(self.model, state, dt), parts)

    def contact_forces(self, state: Any) -> list[Vec3]:
        """Forces of fixed bodies on the nodes [N], for each effect."""

        def one(scene: LoadedRod, own: RodState) -> list[Vec3]:
            touching = [effect for effect in scene.effects if effect.obstacle]
            found = [e.loads(scene.rod, motion_of(own)).forces for e in touching]
            return [forces for forces in found if forces is not None]

        forces: list[Vec3] = self.row(self.each(one, state))
        return forces

    def momenta(self, state: Any) -> tuple[Array, Array]:
        """Momenta of nodes, and angular momenta of elements, `(..., 3, n)`."""
        masses = self.model.rod.node_masses
        return masses[..., None, :] * state.velocities, state.angular_momenta

    def kinetic_energy(self, state: Any) -> Array:
        """Kinetic energy [J]."""
        return self.total(lambda scene, own: scene.kinetic_energy(own), state)

    def potential_energy(self, state: Any) -> Array:
        """Elastic energy, and potentials of its effects [J]."""
        return self.total(lambda scene, own: scene.potential_energy(own), state)

    def momentum(self, state: Any) -> Array:
        """Linear momentum, world frame [kg m/s]."""
        return self.total(lambda scene, own: scene.momentum(own), state)

    def angular_momentum(self, state: Any) -> Array:
        """Angular momentum about the origin, world frame [kg m^2/s]."""
        return self.total(lambda scene, own: scene.angular_momentum(own), state)

    def total(self, function: Callable[[Any, Any], Array], state: Any) -> Array:
        """Sum of a function of every scene and its state."""
        return self.each(function, state)

    def health(self, state: Any, dt: ArrayLike, limits: HealthLimits) -> Any:
        """Flags and the measured values behind them, for every rod."""
        return self.each(lambda s, own: scene_health(s, own, dt, limits=limits), state)

    def stable_step(self, bound: StabilityBound, safety: ArrayLike) -> tuple[Any, Any]:
        """The largest safe step [s], and what limits it."""

        def one(scene: LoadedRod, own: StabilityBound) -> Any:
            effects = (*scene.effects, CouplingBounds(own))
            return scene_stable_step(replace(scene, effects=effects), safety)

        step = self.each(one, self.rows(bound))
        return jnp.min(step.dt), step

    def rows(self, tree: Any) -> Any:
        """Fields given in one row, split by rod."""
        return tree


class EqualRods(OneRod):
    """Scenes of equal rods, with a leading axis on every number."""

    @property
    def count(self) -> int:
        """Number of rods."""
        return int(self.array_shape[0])

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Result of a function of a scene and of other arguments, for every rod."""
        return jax.vmap(function)(self.model, *given)

    def parts(self) -> Parts:
        """Constants, as couplings see them."""
        count, n = self.array_shape
        rows = flatten_rods(jax.vmap(parts_of)(self.model.rod))
        parts: Parts = replace(rows, count=count, n_elements=n)
        return parts

    def of_rods(self, numbers: Array) -> Array:
        """Numbers of every rod in the shape of the scenes: with an axis of rods."""
        return numbers

    def row(self, tree: Any) -> Any:
        """Fields of every rod, with all nodes and elements in one row."""
        return flatten_rods(tree)

    def rows(self, tree: Any) -> Any:
        """Fields given in one row, split by rod."""
        return unflatten_rods(tree, self.count)

    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Its part of a step."""
        del carried
        verlet = self.each(lambda s, own: s.method.stepper(s, own, dt), state)
        return RodsStepper(verlet, parts, parts.count)

    def total(self, function: Callable[[Any, Any], Array], state: Any) -> Array:
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


def _free_rates(scene: LoadedRod, state: RodState) -> Vec3:
    return free_velocity_mask(scene, motion_of(state))[0]


def member_of_rod(scene: LoadedRod) -> OneRod:
    """The member for a scene, or for equal rods if the scene is stacked."""
    return EqualRods(scene) if scene.rod.batch_shape else OneRod(scene)
