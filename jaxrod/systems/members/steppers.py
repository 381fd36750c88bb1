"""Steppers of a system's members: one rod, equal rods with a leading axis, bodies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.effects.time import Clock, at_clock
from jaxrod.loaded_rod import Now, remembering, scene_at, without_dissipation
from jaxrod.rods.motion import Loads, Motion
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import Parts, Seen
from jaxrod.systems.members.rigid_stepper import RigidStepper


class MemberStepper(ABC):
    """Integrator of one member within a step of a system, a pytree.

    Motions have a form that only the stepper knows: a leading axis for equal rods, the
    common centre of mass with attached nodes for bodies. The defaults are for members
    without supports, ties and effects.

    Example:
        >>> arm = scene.as_member()
        >>> stepper = arm.stepper(state, arm.parts(), None, jnp.float32(1e-4))
        >>> isinstance(stepper, extend.MemberStepper)
        True
        >>> stepper.leave(stepper.enter(state)).positions.shape
        (3, 11)
    """

    @abstractmethod
    def enter(self, state: Any) -> Any:
        """Converts a state to the stepper's form of motion."""

    @abstractmethod
    def leave(self, motion: Any) -> Any:
        """Converts the stepper's form of motion to a state."""

    @abstractmethod
    def drift(self, motion: Any, dt: Array) -> Any:
        """Motion after a time `dt` [s] at unchanged velocities and spins."""

    @abstractmethod
    def kick(self, motion: Any, loads: Loads) -> Any:
        """Motion after loads have acted for one step, at unchanged positions.

        `loads` are those of couplings. Loads of the member's effects are added to them,
        and internal loads of rods.
        """

    @abstractmethod
    def seen(self, motion: Any) -> Seen:
        """Constants and motion of the member, in the form that couplings read."""

    def supported(self, motion: Any) -> Any:
        """Motion in which supported nodes have the velocities that supports impose."""
        return motion

    def moved_as(self, motion: Any, seen: Motion) -> Any:
        """Converts `seen`, a motion that couplings changed, to the stepper's form."""
        raise NotImplementedError(f"{type(self).__name__}: nodes cannot follow others")

    def pushed(self, motion: Any, impulses: Loads) -> Any:
        """Motion after impulses have changed velocities and spins.

        The impulses are forces times time on nodes [N s] and couples times time on
        elements [N m s], both in the world frame.
        """
        raise NotImplementedError(f"{type(self).__name__}: nothing can be attached")

    def at_rest(self) -> MemberStepper:
        """Copy for statics, without effects that only dissipate."""
        return self

    def at(self, model: Any, memory: Any, clock: Clock) -> MemberStepper:
        """Copy with the member's schedules evaluated at the given time.

        Effects in the copy have the given memory.

        Args:
            model: Entry of the member in the system, with its schedules.
            memory: Memory of its effects.
            clock: The time, as a count of steps.
        """
        return self

    def remembered(self, motion: Any, memory: Any, dt: Array) -> Any:
        """Memory of the effects after a step, updated from its motion after the kick.

        The default is for effects without memory.
        """
        return memory


@pytree
class RodStepper(MemberStepper):
    """Integrator of a scene, one rod and its effects, within a system."""

    verlet: Any
    """The stepper of the scene, with a leading axis for equal rods. It has the methods
    of `Verlet`, on motions that couplings can read."""
    parts: Parts
    """Constants of the rod; of equal rods, concatenated."""

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Value of a function of the stepper and `given`; `RodsStepper` maps it."""
        return function(self.verlet, *given)

    def enter(self, state: Any) -> Motion:
        """Converts a state to a motion, with a leading axis for equal rods."""
        motion: Motion = self.each(lambda one, own: one.enter(own), state)
        return motion

    def leave(self, motion: Motion) -> Any:
        """Converts a motion to a state."""
        return self.each(lambda one, own: one.leave(own), motion)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Motion after a time `dt` [s] at unchanged velocities and spins."""
        moved: Motion = self.each(lambda one, own: one.drift(own, dt), motion)
        return moved

    def kick(self, motion: Motion, loads: Loads) -> Motion:
        """Motion after internal loads, effects and couplings have acted for a step."""
        kicked: Motion = self.each(
            lambda one, own, more: one.kick(own, more), motion, self.rows(loads)
        )
        return kicked

    def supported(self, motion: Motion) -> Motion:
        """Motion in which supported nodes have the velocities that supports impose."""
        held: Motion = self.each(lambda one, own: one.constrain_rates(own), motion)
        return held

    def seen(self, motion: Motion) -> Seen:
        """Constants and motion of all rods, concatenated, as couplings read them."""
        return Seen(
            self.parts, self.row(self.each(lambda one, own: one.view(own), motion))
        )

    def moved_as(self, motion: Any, seen: Motion) -> Any:
        """Splits `seen`, a motion of all rods that couplings have changed, by rod."""
        return self.each(
            lambda one, own, to: one.moved_as(own, to), motion, self.rows(seen)
        )

    def at_rest(self) -> RodStepper:
        """Copy for statics, without effects that only dissipate."""
        scene = without_dissipation(self.verlet.scene)
        return replace(self, verlet=replace(self.verlet, scene=scene))

    def at(self, model: Any, memory: Any, clock: Clock) -> RodStepper:
        """Copy with the scene's schedules evaluated at the given time.

        `model` is the scene with its schedules, and `clock` is the time. The effects in
        the copy have the given `memory`.
        """
        if not model.evolves:
            return self

        def one(_: Any, scene: Any, had: Any) -> Any:
            return scene_at(scene, Now(clock.step, had), clock.fraction, clock.dt)

        scene = self.each(one, model, memory)
        return replace(self, verlet=replace(self.verlet, scene=scene))

    def remembered(self, motion: Motion, memory: Any, dt: Array) -> Any:
        """Memory of the effects after a step, from the motion after its kick."""
        if not any(memory):
            return memory
        none = jnp.zeros((), jnp.int32)

        def one(stepper: Any, own: Any, had: Any) -> Any:
            seen = stepper.view(own)
            return remembering(stepper.scene, seen, dt, Now(none, had)).memory

        return self.each(one, motion, memory)

    def row(self, tree: Any) -> Any:
        """Returns `tree` unchanged; `RodsStepper` concatenates fields of its rods."""
        return tree

    def rows(self, tree: Any) -> Any:
        """Returns `tree` unchanged; `RodsStepper` splits its fields by rod."""
        return tree


@pytree
class RodsStepper(RodStepper):
    """Integrator of equal rods within a system, with a leading axis on every number."""

    count: int = static()
    """Number of rods."""

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Applies a function to the stepper and arguments of each rod, with `vmap`."""
        return jax.vmap(function)(self.verlet, *given)

    def row(self, tree: Any) -> Any:
        """Concatenates all rods: fields `(rods, ..., n)` become `(..., rods n)`."""
        return flatten_rods(tree)

    def rows(self, tree: Any) -> Any:
        """Splits fields `(..., rods n)` by rod, into `(rods, ..., n)`."""
        return unflatten_rods(tree, self.count)


@pytree
class BodiesStepper(MemberStepper):
    """Integrator of rigid bodies within a system."""

    rigid: RigidStepper
    """The stepper of the bodies, to which all methods delegate."""

    def enter(self, state: Any) -> Motion:
        """Motion of the centres of mass, from a state that refers to the origins."""
        return self.rigid.enter(state)

    def leave(self, motion: Motion) -> Any:
        """State of the bodies' origins, from the motion of the centres of mass."""
        return self.rigid.leave(motion)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Motion after a time `dt` [s] of free flight and free rotation."""
        return self.rigid.drift(motion, dt)

    def kick(self, motion: Motion, loads: Loads) -> Motion:
        """Motion after effects and couplings have acted for one step."""
        return self.rigid.kick(motion, loads)

    def seen(self, motion: Motion) -> Seen:
        """Constants and motion of the bodies' origins, as couplings read them."""
        return self.rigid.seen(motion)

    def pushed(self, motion: Motion, impulses: Loads) -> Motion:
        """Motion after impulses at the bodies' origins have changed its rates."""
        return self.rigid.pushed(motion, impulses)

    def rates_of_change(self, motion: Motion, push: Loads) -> Motion:
        """Accelerations of the bodies' origins, and angular accelerations."""
        return self.rigid.rates_of_change(motion, push)

    def at(self, model: Any, memory: Any, clock: Clock) -> BodiesStepper:
        """Copy with the effects' schedules evaluated at the given time.

        `model` is the bodies with the schedules, and `clock` is the time. Bodies have
        no memory.
        """
        bodies = replace(self.rigid.bodies, effects=at_clock(model.effects, clock))
        return replace(self, rigid=replace(self.rigid, bodies=bodies))


def flatten_rods(tree: Any) -> Any:
    """Concatenates k rods along the last axis: `(k, ..., n)` becomes `(..., k n)`."""

    def one(leaf: Array) -> Array:
        moved = jnp.moveaxis(leaf, 0, -2)
        return moved.reshape(*moved.shape[:-2], -1)

    return jax.tree.map(one, tree)


def unflatten_rods(tree: Any, count: int) -> Any:
    """Splits the last axis into k rods: leaves `(..., k n)` become `(k, ..., n)`.

    Single numbers are repeated for each rod, `(k,)`.
    """

    def one(leaf: Array) -> Array:
        if jnp.ndim(leaf) == 0:
            return jnp.broadcast_to(leaf, (count,))
        return jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], count, -1), -2, 0)

    return jax.tree.map(one, tree)
