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
from jaxrod.loaded_rod import without_dissipation
from jaxrod.methods.now import Now, remembering, scene_at
from jaxrod.rods.motion import Loads, Motion
from jaxrod.structure import pytree, static
from jaxrod.systems.members.parts import Parts, Seen, flatten_rods, unflatten_rods
from jaxrod.systems.members.rigid_stepper import RigidStepper


class MemberStepper(ABC):
    """One member's part of a step, a pytree.

    Motions have the stepper's own form: a leading axis for equal rods, the common
    centre of mass for bodies. The defaults are for members without supports, ties and
    effects.

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
        """Motion of a state."""

    @abstractmethod
    def leave(self, motion: Any) -> Any:
        """State of a motion."""

    @abstractmethod
    def drift(self, motion: Any, dt: Array) -> Any:
        """Moves at unchanged rates for a time `dt` [s]."""

    @abstractmethod
    def kick(self, motion: Any, loads: Loads) -> Any:
        """Changes the rates by the member's own loads and by others, over one step."""

    @abstractmethod
    def seen(self, motion: Any) -> Seen:
        """The member as couplings see it."""

    def supported(self, motion: Any) -> Any:
        """The motion with the rates that supports impose now."""
        return motion

    def moved_as(self, motion: Any, seen: Motion) -> Any:
        """The member's motion with the changes that couplings made to `seen`."""
        raise NotImplementedError(f"{type(self).__name__}: nodes cannot follow others")

    def pushed(self, motion: Any, impulses: Loads) -> Any:
        """Changes rates by impulses, with forces and couples in the world frame."""
        raise NotImplementedError(f"{type(self).__name__}: nothing can be attached")

    def at_rest(self) -> MemberStepper:
        """The stepper for loads at rest, without effects that only dissipate."""
        return self

    def at(self, model: Any, memory: Any, clock: Clock) -> MemberStepper:
        """The stepper with the member's numbers at a time.

        Args:
            model: Entry of the member in the system, with its schedules.
            memory: Memory of its effects.
            clock: The time.
        """
        return self

    def remembered(self, motion: Any, memory: Any, dt: Array) -> Any:
        """Memory of the effects one step later."""
        return memory


@pytree
class RodStepper(MemberStepper):
    """Stepper of a scene: one rod and its effects."""

    verlet: Any
    """The stepper of the scene, with a leading axis for equal rods. It has the methods
    of `Verlet`, on motions that couplings can read."""
    parts: Parts
    """Constants of the rod, or of all rods in one row."""

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Calls a function with each rod's stepper and its part of other arguments."""
        return function(self.verlet, *given)

    def enter(self, state: Any) -> Motion:
        """Motion of a state."""
        motion: Motion = self.each(lambda one, own: one.enter(own), state)
        return motion

    def leave(self, motion: Motion) -> Any:
        """State of a motion."""
        return self.each(lambda one, own: one.leave(own), motion)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Moves at unchanged rates."""
        moved: Motion = self.each(lambda one, own: one.drift(own, dt), motion)
        return moved

    def kick(self, motion: Motion, loads: Loads) -> Motion:
        """Changes the rates by internal loads, effects and other loads."""
        kicked: Motion = self.each(
            lambda one, own, more: one.kick(own, more), motion, self.rows(loads)
        )
        return kicked

    def supported(self, motion: Motion) -> Motion:
        """The motion with the rates that supports impose now."""
        held: Motion = self.each(lambda one, own: one.constrain_rates(own), motion)
        return held

    def seen(self, motion: Motion) -> Seen:
        """The rod, or all rods in one row."""
        return Seen(self.parts, self.row(motion))

    def moved_as(self, motion: Motion, seen: Motion) -> Motion:
        """The motion `seen`, which couplings have changed, divided among the rods."""
        changed: Motion = self.rows(seen)
        return changed

    def at_rest(self) -> RodStepper:
        """The stepper for loads at rest, without effects that only dissipate."""
        scene = without_dissipation(self.verlet.scene)
        return replace(self, verlet=replace(self.verlet, scene=scene))

    def at(self, model: Any, memory: Any, clock: Clock) -> RodStepper:
        """The stepper with the scene's numbers at a time."""
        if not model.evolves:
            return self

        def one(_: Any, scene: Any, had: Any) -> Any:
            return scene_at(scene, Now(clock.step, had), clock.fraction, clock.dt)

        scene = self.each(one, model, memory)
        return replace(self, verlet=replace(self.verlet, scene=scene))

    def remembered(self, motion: Motion, memory: Any, dt: Array) -> Any:
        """Memory of the effects one step later."""
        if not any(memory):
            return memory
        none = jnp.zeros((), jnp.int32)

        def one(stepper: Any, own: Any, had: Any) -> Any:
            return remembering(stepper.scene, own, dt, Now(none, had)).memory

        return self.each(one, motion, memory)

    def row(self, tree: Any) -> Any:
        """Fields of every rod, with all nodes and elements in one row."""
        return tree

    def rows(self, tree: Any) -> Any:
        """Fields given in one row, split by rod."""
        return tree


@pytree
class RodsStepper(RodStepper):
    """Stepper of equal rods with their effects, with a leading axis on every number."""

    count: int = static()
    """Number of rods."""

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Result of a function of a stepper and of other arguments, for every rod."""
        return jax.vmap(function)(self.verlet, *given)

    def row(self, tree: Any) -> Any:
        """Fields of every rod, with all nodes and elements in one row."""
        return flatten_rods(tree)

    def rows(self, tree: Any) -> Any:
        """Fields given in one row, split by rod."""
        return unflatten_rods(tree, self.count)


@pytree
class BodiesStepper(MemberStepper):
    """Stepper of rigid bodies."""

    rigid: RigidStepper
    """Their stepper."""

    def enter(self, state: Any) -> Motion:
        """Motion of a state."""
        return self.rigid.enter(state)

    def leave(self, motion: Motion) -> Any:
        """State of a motion."""
        return self.rigid.leave(motion)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Moves and turns freely."""
        return self.rigid.drift(motion, dt)

    def kick(self, motion: Motion, loads: Loads) -> Motion:
        """Changes the rates by effects and other loads."""
        return self.rigid.kick(motion, loads)

    def seen(self, motion: Motion) -> Seen:
        """The bodies as couplings see them, at their origins."""
        return self.rigid.seen(motion)

    def pushed(self, motion: Motion, impulses: Loads) -> Motion:
        """Changes rates by impulses on the origins."""
        return self.rigid.pushed(motion, impulses)

    def at(self, model: Any, memory: Any, clock: Clock) -> BodiesStepper:
        """The stepper with schedules of the bodies' effects evaluated at a time."""
        bodies = replace(self.rigid.bodies, effects=at_clock(model.effects, clock))
        return replace(self, rigid=replace(self.rigid, bodies=bodies))
