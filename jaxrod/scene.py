"""A scene: one rod, the effects that act on it, and the method that steps it."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.elasticity import stored_energy
from jaxrod.rods.motion import Loads, Motion, accumulate
from jaxrod.rods.rod import Rod, RodState, angular_velocities, check_state
from jaxrod.structure import pytree
from jaxrod.validation import check_kind

Law = Literal["consistent", "pyelastica"]
"""Elastic laws: loads from a stored energy, and PyElastica 1.0's."""


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

    def begin(self, state: RodState) -> Any:
        """Carry before the first step, from the initial state."""

    def cycle(self, carry: Any) -> Any:
        """A step that `end` does not finish."""

    def end(self, carry: Any) -> RodState:
        """The state, from the carry after the last cycle."""


@pytree
class Method:
    """Method of stepping a scene: an elastic law, its reduction and an integrator.

    One of those in `jaxrod.methods`, or a user's subclass that is a pytree.
    """

    twist: ClassVar[bool] = True
    """Whether elements turn about their axes."""
    explicit: ClassVar[bool] = True
    """Whether `stable_dt` bounds the step."""

    @property
    def law(self) -> Law:
        """The elastic law, which stability and statics ask for."""
        return "consistent"

    def stepper(self, scene: Scene, state: RodState, dt: Array) -> Stepper:
        """The integrator, its constants worked out for one call."""
        raise NotImplementedError

    def check(self, scene: Scene) -> None:
        """Raises ValueError if the scene is not one for this method in any state.

        Values that are traced are not looked at.
        """

    def check_state(self, scene: Scene, state: RodState) -> None:
        """Raises ValueError if this concrete state is not one for this method."""


@pytree
class Scene:
    """One rod, its effects and a method. Structure is static, numbers are traced.

    Only what is in `effects` is in the compiled program. Build one with
    `make_scene`; change numbers with `dataclasses.replace`.
    """

    rod: Rod
    """The rod's parameters."""
    effects: tuple[Effect, ...]
    """Effects on the rod, in the order in which they are applied."""
    method: Method
    """Method that steps it."""


def check_scene(scene: Scene) -> None:
    """Raises a `TypeError` unless a scene is one."""
    check_kind("scene", scene, Scene)


def check_scene_and_state(scene: Scene, state: RodState) -> None:
    """Checks that they are a scene and a state of its rod.

    Raises:
        TypeError: If they are something else.
        ValueError: If the state has other numbers of elements and nodes.
    """
    check_scene(scene)
    check_state(scene.rod, state)


def external_loads(scene: Scene, motion: Motion, forces: Vec3, couples: Vec3) -> Loads:
    """Adds the loads of all effects to given forces and couples."""
    for effect in scene.effects:
        loads = effect.loads_after(scene.rod, motion, Loads(forces, couples))
        forces = accumulate(forces, loads.forces)
        couples = accumulate(couples, loads.couples)
    return Loads(forces, couples)


def constrain(scene: Scene, motion: Motion) -> Motion:
    """Applies all constraints on configuration."""
    for effect in scene.effects:
        motion = effect.constrain(scene.rod, motion)
    return motion


def constrain_rates(scene: Scene, motion: Motion) -> Motion:
    """Applies all constraints on rates."""
    for effect in scene.effects:
        motion = effect.constrain_rates(scene.rod, motion)
    return motion


def damping_rates(scene: Scene) -> tuple[Array, Array] | None:
    """Total decay rates [1/s] of velocities and of spins; `None` without damping."""
    total: tuple[Array, Array] | None = None
    for effect in scene.effects:
        rates = effect.damping_rates(scene.rod)
        if rates is not None:
            if total is not None:
                rates = (total[0] + rates[0], total[1] + rates[1])
            total = rates
    return total


def kinetic_energy(rod: Rod, state: RodState) -> Float[Array, ""]:
    """Kinetic energy of translation and rotation [J]."""
    check_state(rod, state)
    translation = 0.5 * jnp.sum(rod.node_masses[None, :] * state.velocities**2)
    spin = angular_velocities(rod, state)
    transverse, polar = rod.inertias
    inertia = jnp.stack([transverse, transverse, polar])
    return translation + 0.5 * jnp.sum(inertia * spin**2)


def potential_energy(scene: Scene, state: RodState) -> Float[Array, ""]:
    """Stored elastic energy plus the potential of all effects [J]."""
    check_scene_and_state(scene, state)
    total = stored_energy(scene.rod, state)
    for effect in scene.effects:
        total = total + effect.energy(scene.rod, state)
    return total


def total_energy(scene: Scene, state: RodState) -> Float[Array, ""]:
    """Kinetic plus potential energy [J]."""
    check_scene_and_state(scene, state)
    return kinetic_energy(scene.rod, state) + potential_energy(scene, state)


def momentum(rod: Rod, state: RodState) -> Float[Array, "3"]:
    """Linear momentum, world frame [kg m/s]."""
    check_state(rod, state)
    return jnp.sum(rod.node_masses[None, :] * state.velocities, axis=1)


def angular_momentum(rod: Rod, state: RodState) -> Float[Array, "3"]:
    """Angular momentum about the origin, world frame [kg m^2/s]."""
    check_state(rod, state)
    position = vectors.split(state.positions)
    velocity = vectors.split(state.velocities)
    orbital = vectors.join(vectors.cross(position, velocity))
    return jnp.sum(rod.node_masses[None, :] * orbital, axis=1) + jnp.sum(
        state.angular_momenta, axis=1
    )
