"""Rods as members of a system: a scene of one rod, and scenes of equal rods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxrod.analysis.dynamics import rates_of_change, reactions_of
from jaxrod.analysis.health import (
    EnergyAccount,
    HealthLimits,
    energy_account,
    rod_passages,
    scene_health,
)
from jaxrod.analysis.stability import scene_stable_step
from jaxrod.effects.base import Effect, Reaction, StabilityBound, memory_of
from jaxrod.effects.loads import GivenLoads
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import (
    LoadedRod,
    Method,
    check_masses,
    check_memory,
    free_velocity_mask,
    memory_in,
    remembering_rest,
)
from jaxrod.rods.motion import Loads, Motion, motion_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree
from jaxrod.systems.coupling import Carried, Parts
from jaxrod.systems.members.member import (
    Member,
    check_axes,
    check_fields,
    step_limit,
)
from jaxrod.systems.members.steppers import (
    MemberStepper,
    RodsStepper,
    RodStepper,
    flatten_rods,
    unflatten_rods,
)
from jaxrod.validation import check_kind


@dataclass(frozen=True)
class OneRod(Member):
    """A scene of one rod with its effects, as a member of a system."""

    model: Any
    """The scene, a `LoadedRod`."""

    @property
    def dtype(self) -> Any:
        """Floating-point dtype of all numbers."""
        return self.model.rod.rest_lengths.dtype

    @property
    def array_shape(self) -> tuple[int, ...]:
        """Shape of the rest lengths, `(elements,)`; `(rods, elements)` if stacked."""
        return jnp.shape(self.model.rod.rest_lengths)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects on the rod."""
        effects: tuple[Effect, ...] = self.model.effects
        return effects

    def check(self, name: str) -> None:
        """Raises a ValueError for wrong axes, or a method without steps in a system."""
        shape, axes = self.array_shape, (("elements",), ("rods", "elements"))
        check_axes(name, "rest lengths", shape, *axes)
        if not self.model.method.steps_in_systems:
            raise ValueError(
                f"member {name!r} steps with {type(self.model.method).__name__}, which "
                "has no steps in a system: give it a method of jaxrod, or "
                "`steps_in_systems`"
            )
        try:
            check_masses(self.model)
        except ValueError as error:
            raise ValueError(f"member {name!r}: {error}") from None

    @property
    def method(self) -> Method:
        """Method of the rods, which says what they leave out."""
        method: Method = self.model.method
        return method

    def check_for(self, method: Method, name: str, state: Any) -> None:
        """Raises a ValueError if a rod could not step with a method from a state."""
        for scene, own in self.one_by_one(state):
            now = scene.recalling(own)
            try:
                for known in (now.at(0.0), scene.stirred) if scene.evolves else (now,):
                    method.check_state(known, own)
            except ValueError as error:
                raise ValueError(f"member {name!r}: {error}") from None

    def one_by_one(self, state: Any) -> list[tuple[Any, Any]]:
        """Scene and state of each rod."""
        return [(self.model, state)]

    def check_statics(self, name: str) -> None:
        """Raises a ValueError if internal loads are not the gradient of an energy."""
        if not self.model.method.has_energy:
            raise ValueError(
                f"member {name!r}: statics need the consistent law, got "
                f"{self.model.method!r}"
            )

    def with_effect(self, effect: Effect) -> Any:
        """Copy of the scene with one more effect; equal rods all get the same one."""
        return self.each(lambda scene: scene.with_effect(effect))

    def in_own_type(self, name: str) -> Any:
        """The unchanged scene, whose effects `make_scene` has already converted."""
        return self.model

    def with_method(self, method: Callable[[Any], Any]) -> Any:
        """Copy of the scene with the method that `method` makes of the present one."""
        scene = replace(self.model, method=method(self.model.method))
        check_masses(scene)
        scene.method.check(scene.at(0.0))
        if scene.evolves:
            scene.method.check_evolving(scene)
            scene.method.check(scene.stirred)
        return scene

    def in_space(self) -> Any:
        """Copy of the scene with the method of its law in three dimensions."""
        return replace(self.model, method=self.model.method.in_space)

    def with_free_ends(self, free: Array) -> Any:
        """Copy of the scene whose effects know which ends of its rods are free."""
        if not self.effects or bool(jnp.all(free)):
            return self.model
        own = self.of_rods(free)
        effects = tuple(effect.with_free_ends(own) for effect in self.effects)
        return replace(self.model, effects=effects)

    def of_rods(self, numbers: Array) -> Array:
        """Drops the leading axis of rods, which has one entry: `numbers[0]`."""
        return numbers[0]

    @property
    def remembers(self) -> bool:
        """Whether any effect has memory, which changes from step to step."""
        return self.model.remembers

    @property
    def rod(self) -> Rod:
        """Parameters of the rod."""
        return self.model.rod

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Value of a function of the scene and `given`; `EqualRods` maps over rods."""
        return function(self.model, *given)

    def recalling(self, state: Any) -> Any:
        """Copy of the scene whose effects have the memory that a state holds."""
        return self.each(lambda scene, own: scene.recalling(own), state)

    @property
    def without_slip(self) -> Any:
        """Copy of the scene whose static friction holds; itself if it has none."""
        return self.model.without_slip

    def with_memory(self, state: Any) -> Any:
        """Copy of the state with initial memory of effects, if the state holds none."""
        if not self.remembers or state.memory is not None:
            return state

        def one(scene: LoadedRod, own: RodState) -> RodState:
            return replace(own, memory=memory_of(scene.effects))

        return self.each(one, state)

    def memory(self, state: Any) -> Any:
        """Memory of the effects in a state, or their initial memory."""
        return self.each(memory_in, state)

    def remembering_rest(self, state: Any) -> Any:
        """Copy of a state at rest, with the memory after a step of zero."""
        return self.each(remembering_rest, state)

    def check_state(self, name: str, state: Any, dtype: Any) -> None:
        """Raises a TypeError or a ValueError if a state is not of this rod."""
        check_kind(f"state of {name!r}", state, RodState)
        *batch, n = self.array_shape
        check_fields(name, state, (*batch, 3, n + 1), n, dtype, "angular_momenta")
        check_memory(self.model, state, f"state of {name!r}: state")

    def parts(self) -> Parts:
        """Constants of the rod, for couplings."""
        return parts_of(self.model.rod)

    def held(self, state: Any) -> Vec3 | None:
        """Flags per node and world axis: 1 where a support holds the node, else 0.

        `None` for a rod without effects.
        """
        if not self.model.effects:
            return None
        x, y, z = self.row(self.each(_free_rates, state))
        return 1 - x, 1 - y, 1 - z

    def motion(self, state: Any) -> Motion:
        """Positions and rates in a state, with all rods in one flat array."""
        motion: Motion = self.row(self.each(lambda _, own: motion_of(own), state))
        return motion

    def row(self, tree: Any) -> Any:
        """Returns `tree` unchanged; `EqualRods` concatenates the fields of its rods."""
        return tree

    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Integrator of the rods in a run; `carried` is for rigid bodies only."""
        del carried
        return RodStepper(
            self.model.method.stepper_in_system(self.model, state, dt), parts
        )

    def contact_forces(self, state: Any) -> list[Vec3]:
        """Contact forces of fixed bodies on the nodes [N], one entry per effect."""

        def one(scene: LoadedRod, own: RodState) -> list[Vec3]:
            touching = [effect for effect in scene.effects if effect.obstacle]
            found = [e.loads(scene.rod, motion_of(own)).forces for e in touching]
            return [forces for forces in found if forces is not None]

        forces: list[Vec3] = self.row(self.each(one, state))
        return forces

    def momenta(self, state: Any) -> tuple[Array, Array]:
        """Momenta of nodes [kg m/s], angular momenta of elements [kg m^2/s]."""
        masses = self.model.rod.node_masses
        return masses[..., None, :] * state.velocities, state.angular_momenta

    def kinetic_energy(self, state: Any) -> Array:
        """Kinetic energy of all rods [J]."""
        return self.total(lambda scene, own: scene.kinetic_energy(own), state)

    def potential_energy(self, state: Any) -> Array:
        """Elastic energy of all rods, plus potential energies of effects [J]."""
        return self.total(lambda scene, own: scene.potential_energy(own), state)

    def momentum(self, state: Any) -> Array:
        """Total linear momentum, world frame [kg m/s]."""
        return self.total(lambda scene, own: scene.momentum(own), state)

    def angular_momentum(self, state: Any) -> Array:
        """Total angular momentum about the origin, world frame [kg m^2/s]."""
        return self.total(lambda scene, own: scene.angular_momentum(own), state)

    def total(self, function: Callable[[Any, Any], Array], state: Any) -> Array:
        """Value of a function of scene and state; `EqualRods` adds up its rods."""
        return self.each(function, state)

    def health(self, state: Any, dt: ArrayLike, limits: HealthLimits) -> Any:
        """Flags of numerical faults and the values behind them, for each rod."""
        return self.each(lambda s, own: scene_health(s, own, dt, limits=limits), state)

    def passages(self, before: Any, after: Any) -> Array | None:
        """Number of points of the rods that went through fixed bodies."""
        found = self.each(rod_passages, before, after)
        return None if found is None else jnp.sum(found)

    def loaded(self, loads: Loads) -> Any:
        """Copy of the scene with loads of couplings as one more effect."""
        return self.each(_with_loads, self.rows(loads))

    def rates_of_change(self, state: Any, loads: Loads) -> Motion:
        """Rates of change under the loads of couplings and all others."""

        def one(scene: LoadedRod, own: RodState, more: Loads) -> Motion:
            return rates_of_change(_with_loads(scene, more), motion_of(own))

        rates: Motion = self.row(self.each(one, state, self.rows(loads)))
        return rates

    def reactions(self, state: Any, loads: Loads) -> tuple[Reaction | None, ...]:
        """Reaction of each effect; with a leading axis for equal rods."""

        def one(scene: LoadedRod, own: RodState, more: Loads) -> Any:
            return reactions_of(_with_loads(scene, more), own)[:-1]

        found: tuple[Reaction | None, ...] = self.each(one, state, self.rows(loads))
        return found

    def energy_account(self, state: Any, mean: Array, dt: Array) -> EnergyAccount:
        """Energy of all rods together, and what round-off may add to it."""

        def one(scene: LoadedRod, own: RodState) -> EnergyAccount:
            relative = replace(own, velocities=own.velocities - mean[:, None])
            return energy_account(scene, own, relative, dt)

        account: EnergyAccount = jax.tree.map(jnp.sum, self.each(one, state))
        return account

    def stable_step(self, bound: StabilityBound, safety: ArrayLike) -> tuple[Any, Any]:
        """Largest step that is stable for every rod, times the factor `safety` [s].

        It is limited by the rods and their effects, and by couplings (`bound`). The
        second result is the `StableStep` of each rod. Implicit rods are limited by
        couplings alone; the second result is `None`.
        """
        if not self.method.explicit:
            parts = self.parts()
            even = jnp.ones((), self.dtype)
            nodes, elements = bound.drags(even, even)
            least = jnp.min(parts.inertias, axis=0)
            moving = step_limit(parts.node_masses, bound.nodes, nodes)
            turning = step_limit(least, bound.elements, elements)
            limit = jnp.minimum(jnp.min(moving), jnp.min(turning))
            return jnp.asarray(safety) * limit, None

        def one(scene: LoadedRod, own: StabilityBound) -> Any:
            effects = (*scene.effects, CouplingBounds(own))
            return scene_stable_step(replace(scene, effects=effects), safety)

        step = self.each(one, self.rows(bound))
        return jnp.min(step.dt), step

    def rows(self, tree: Any) -> Any:
        """Returns `tree` unchanged; `EqualRods` splits its fields by rod."""
        return tree


class EqualRods(OneRod):
    """Scenes of equal rods, with a leading axis on every number, as one member."""

    @property
    def count(self) -> int:
        """Number of rods."""
        return int(self.array_shape[0])

    def one_by_one(self, state: Any) -> list[tuple[Any, Any]]:
        """Scene and state of each rod."""
        return [
            jax.tree.map(lambda leaf, k=k: leaf[k], (self.model, state))
            for k in range(self.count)
        ]

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Applies a function to the scene and arguments of each rod, by `jax.vmap`."""
        return jax.vmap(function)(self.model, *given)

    def parts(self) -> Parts:
        """Constants of all rods, concatenated, for couplings."""
        count, n = self.array_shape
        rows = flatten_rods(jax.vmap(parts_of)(self.model.rod))
        parts: Parts = replace(rows, count=count, n_elements=n)
        return parts

    def of_rods(self, numbers: Array) -> Array:
        """Returns `numbers` unchanged: the scenes have the same axis of rods."""
        return numbers

    def row(self, tree: Any) -> Any:
        """Concatenates all rods: fields `(rods, ..., n)` become `(..., rods n)`."""
        return flatten_rods(tree)

    def rows(self, tree: Any) -> Any:
        """Splits fields `(..., rods n)` by rod, into `(rods, ..., n)`."""
        return unflatten_rods(tree, self.count)

    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Integrator of all rods in a run; `carried` is for rigid bodies only."""
        del carried
        verlet = self.each(lambda s, own: s.method.stepper_in_system(s, own, dt), state)
        return RodsStepper(verlet, parts, parts.count)

    def total(self, function: Callable[[Any, Any], Array], state: Any) -> Array:
        """Sum over all rods of a function of the scene and the state of a rod."""
        return jnp.sum(self.each(function, state), axis=0)


def _with_loads(scene: LoadedRod, loads: Loads) -> LoadedRod:
    """Scene with loads on its nodes and elements as one more effect."""
    assert loads.forces is not None and loads.couples is not None
    given = GivenLoads(vectors.join(loads.forces), vectors.join(loads.couples))
    return replace(scene, effects=(*scene.effects, given))


@pytree
class CouplingBounds(Effect):
    """Effect without loads that adds the stability bounds of couplings to a rod."""

    bound: StabilityBound
    """Stiffness and drag of the couplings on nodes and elements of the rod."""

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Returns the stored bound, for any rod."""
        return self.bound


def _free_rates(scene: LoadedRod, state: RodState) -> Vec3:
    return free_velocity_mask(scene, motion_of(state))[0]


def member_of_rod(scene: LoadedRod) -> OneRod:
    """Wraps a scene as a member: `EqualRods` if its rods are stacked, else `OneRod`."""
    return EqualRods(scene) if scene.rod.batch_shape else OneRod(scene)


def parts_of(rod: Rod) -> Parts:
    """Constants of one rod, for couplings."""
    return Parts(
        node_masses=rod.node_masses,
        inertias=rod.inertias if rod.is_round else rod.principal_inertias,
        rest_lengths=rod.rest_lengths,
        radii=rod.radii,
        bend_twist_stiffness=rod.bend_twist_stiffness,
        linear_density=rod.linear_density,
        n_elements=rod.n_elements,
        mass_matrix=rod.mass_matrix,
    )
