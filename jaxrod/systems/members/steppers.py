"""Steppers of a system's members: one rod, equal rods with a leading axis, bodies."""

from __future__ import annotations

from typing import Any, Protocol

import jax
from jaxtyping import Array

from jaxrod.methods.consistent import ConsistentStepper
from jaxrod.methods.pyelastica import PyElasticaStepper
from jaxrod.rods.motion import Loads, Motion
from jaxrod.structure import pytree, static
from jaxrod.systems.members.parts import Parts, Seen, in_one_row, in_rows
from jaxrod.systems.members.rigid_stepper import RigidStepper


class MemberStepper(Protocol):
    """One member's part of a step; a `Motion` is as the member's own stepper has it."""

    def enter(self, state: Any) -> Motion:
        """Motion of a state."""

    def leave(self, motion: Motion) -> Any:
        """State of a motion."""

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Moves at unchanged rates for a time `dt` [s]."""

    def kick(self, motion: Motion, loads: Loads) -> Motion:
        """Changes the rates by the member's own loads and by others, over one step."""

    def supported(self, motion: Motion) -> Motion:
        """The motion with the rates that supports impose now."""

    def seen(self, motion: Motion) -> Seen:
        """The member as couplings see it."""

    def moved_as(self, motion: Motion, seen: Motion) -> Motion:
        """The member's motion with the changes made in a couplings' view of it."""

    def pushed(self, motion: Motion, impulses: Loads) -> Motion:
        """Changes rates by impulses, with forces and couples in the world frame."""


@pytree
class RodStepper:
    """Stepper of a scene: one rod and its effects."""

    verlet: ConsistentStepper | PyElasticaStepper
    """The stepper of the scene."""
    parts: Parts
    """Constants of the rod."""

    def enter(self, state: Any) -> Motion:
        """Motion of a state."""
        return self.verlet.enter(state)

    def leave(self, motion: Motion) -> Any:
        """State of a motion."""
        return self.verlet.leave(motion)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Moves at unchanged rates."""
        return self.verlet.drift(motion, dt)

    def kick(self, motion: Motion, loads: Loads) -> Motion:
        """Changes the rates by internal loads, effects and other loads."""
        return self.verlet.kick(motion, loads)

    def supported(self, motion: Motion) -> Motion:
        """The motion with the rates that supports impose now."""
        return self.verlet.constrain_rates(motion)

    def seen(self, motion: Motion) -> Seen:
        """The rod with its unchanged motion."""
        return Seen(self.parts, motion)

    def moved_as(self, motion: Motion, seen: Motion) -> Motion:
        """The changed motion."""
        return seen

    def pushed(self, motion: Motion, impulses: Loads) -> Motion:
        """Not possible: nodes of rods pass impulses on and take none."""
        # Only attachments push, and they check that no rod is the body.
        raise NotImplementedError("impulses act on rigid bodies")


@pytree
class RodsStepper:
    """Stepper of equal rods: a scene whose leaves have a leading axis."""

    verlet: ConsistentStepper | PyElasticaStepper
    """The steppers of the scenes, with a leading axis."""
    parts: Parts
    """Constants of the rods, in one row."""
    count: int = static()
    """Number of rods."""

    def enter(self, state: Any) -> Motion:
        """Motions of the states."""
        return jax.vmap(lambda one, s: one.enter(s))(self.verlet, state)

    def leave(self, motion: Motion) -> Any:
        """States of the motions."""
        return jax.vmap(lambda one, m: one.leave(m))(self.verlet, motion)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Moves all rods at unchanged rates."""
        return jax.vmap(lambda one, m: one.drift(m, dt))(self.verlet, motion)

    def kick(self, motion: Motion, loads: Loads) -> Motion:
        """Changes the rates of all rods by internal loads, effects and other loads."""
        each = in_rows(loads, self.count)
        return jax.vmap(lambda one, m, more: one.kick(m, more))(
            self.verlet, motion, each
        )

    def supported(self, motion: Motion) -> Motion:
        """The motions with the rates that supports impose now."""
        return jax.vmap(lambda one, m: one.constrain_rates(m))(self.verlet, motion)

    def seen(self, motion: Motion) -> Seen:
        """All rods in one row."""
        return Seen(self.parts, in_one_row(motion))

    def moved_as(self, motion: Motion, seen: Motion) -> Motion:
        """The changed motions, split by rod."""
        return in_rows(seen, self.count)

    def pushed(self, motion: Motion, impulses: Loads) -> Motion:
        """Not possible: nodes of rods pass impulses on and take none."""
        # Only attachments push, and they check that no rod is the body.
        raise NotImplementedError("impulses act on rigid bodies")


@pytree
class BodiesStepper:
    """Stepper of rigid bodies."""

    rigid: RigidStepper
    """Stepper that does the work."""

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

    def supported(self, motion: Motion) -> Motion:
        """The unchanged motion: supports hold only rods."""
        return motion

    def seen(self, motion: Motion) -> Seen:
        """The bodies at their origins."""
        return self.rigid.seen(motion)

    def moved_as(self, motion: Motion, seen: Motion) -> Motion:
        """Not possible: bodies follow nothing."""
        # Ties and attachments check that only nodes of rods follow.
        raise NotImplementedError("nothing ties a rigid body to follow another member")

    def pushed(self, motion: Motion, impulses: Loads) -> Motion:
        """Changes rates by impulses at the bodies' origins."""
        return self.rigid.pushed(motion, impulses)
