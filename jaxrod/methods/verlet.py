"""Position Verlet: drift, kick, drift, with neighbouring half drifts merged.

A kick changes rates by loads and damping over one step.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int

from jaxrod.loaded_rod import (
    LoadedRod,
    Now,
    constrain_rates,
    memory_in,
    remembering,
    scene_at,
)
from jaxrod.methods.strides import Strides, drift_time
from jaxrod.rods.drag import mean_decay
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import RodState
from jaxrod.structure import pytree


@pytree
class Kick:
    """Solution after a time h of r' = load / inertia - damping r, per component."""

    gain: Array
    """Change of the rate per unit of load: (1 - exp(-g h)) / (g inertia), with the
    damping g."""
    loss: Array | None
    """Fraction of the initial rate that is lost, 1 - exp(-g h) [1]; `None` without
    damping. The fraction left is not stored: it is close to one, and its round-off
    would bias the damping."""

    @staticmethod
    def create(inverse_inertia: Array | None, damping: Array | None, dt: Array) -> Kick:
        """Computes `gain` and `loss` for a step of size `dt` [s].

        Without an inverse inertia it is 1; without damping `loss` is `None`.
        """
        duration = dt
        loss = None
        if damping is not None:
            exponent = damping * dt
            share = mean_decay(exponent)
            duration = dt * share
            loss = exponent * share
        gain = duration if inverse_inertia is None else inverse_inertia * duration
        return Kick(gain, loss)

    def __call__(self, rate: Array, load: Array) -> Array:
        """Rate after the kick, rate + gain load - loss rate, of one component."""
        return rate + self.change(rate, load)

    def change(self, rate: Array, load: Array) -> Array:
        """Change of the rate by the kick, gain load - loss rate, of one component."""
        change = self.gain * load
        return change if self.loss is None else change - self.loss * rate


@pytree
class Verlet(Strides):
    """Position Verlet, with the drift and kick that a subclass defines.

    A cycle goes from the middle of one step, where its kick acts, to the middle of
    the next.
    """

    scene: LoadedRod
    """Scene that is stepped."""
    dt: Array
    """Step size [s]."""

    @abstractmethod
    def enter(self, state: RodState) -> Any:
        """Unpacks a state into the motion that `drift` and `kick` use."""

    @abstractmethod
    def leave(self, motion: Any) -> RodState:
        """Packs a motion into a state."""

    @abstractmethod
    def drift(self, motion: Any, dt: Array) -> Any:
        """Moves nodes and rotates elements, with unchanged rates, for `dt` [s]."""

    @abstractmethod
    def kick(self, motion: Any, others: Loads | None = None) -> Any:
        """Changes velocities and spins by all loads over one step, without moving.

        `others` are loads from outside the scene, as `view` shows it: those of the
        couplings of a system.
        """

    def view(self, motion: Any) -> Motion:
        """Motion in the form that effects and couplings take.

        The compiler drops fields that none of them reads.
        """
        return motion

    def moved_as(self, motion: Any, seen: Motion) -> Any:
        """Motion whose nodes have the positions and velocities of `seen`.

        `seen` is the view of `motion`, in which couplings have changed nodes.
        """
        return replace(
            motion,
            position=seen.position,
            velocity=seen.velocity,
            remainder=seen.remainder,
        )

    def constrain_rates(self, motion: Any) -> Any:
        """Applies the constraints of all effects on velocities and spins."""
        return constrain_rates(self.scene, motion)

    def begin(self, state: RodState) -> Any:
        """Motion after half a drift, in the middle of the first step."""
        return self.drift(self.enter(state), 0.5 * self.dt)

    def stride(self, motion: Any, last: bool | Bool[Array, ""]) -> Any:
        """Motion after a kick and a drift, which is half as long in the last step."""
        return self.drift(self.kick(motion), drift_time(self.dt, last))

    def finished(self, motion: Any) -> RodState:
        """Final state, from the motion at the end of the last step."""
        return self.leave(motion)

    def evolving(self, scene: LoadedRod, first: Array) -> EvolvingVerlet:
        """Stepper for a scene with schedules or memory, from step number `first` on."""
        return EvolvingVerlet(self, scene, first)


@pytree
class EvolvingVerlet(Strides):
    """Position Verlet of a scene that depends on time or has memory.

    Loads and prescribed rates are evaluated in the middle of a step, where the kick
    acts. Positions of driven supports are evaluated at the end of a drift.
    """

    verlet: Verlet
    """Stepper of the scene in its initial form, whose `scene` is replaced in each
    step."""
    scene: LoadedRod
    """The scene with its schedules."""
    first: Int[Array, ""]
    """Number of the first step, counted from time zero."""

    def begin(self, state: RodState) -> tuple[Any, Now]:
        """Motion in the middle of the first step, with step number and memory."""
        now = Now(self.first, memory_in(self.scene, state))
        return self._at(now, 0.5).begin(state), now

    def stride(
        self, carry: tuple[Any, Now], last: bool | Bool[Array, ""]
    ) -> tuple[Any, Now]:
        """Motion, step number and memory in the middle of the next step.

        After the last step they are those of its end.
        """
        kicked, now = self._kick(carry)
        there = self._at(now, jnp.where(last, 0.0, 0.5))
        return there.drift(kicked, drift_time(self.verlet.dt, last)), now

    def finished(self, carry: tuple[Any, Now]) -> RodState:
        """Final state, with the memory."""
        moved, now = carry
        last = self._at(now, 0.0)
        if self.scene.depends_on_time:
            # Driven supports get their current rates, not those of half a step ago.
            moved = last.constrain_rates(moved)
        state = last.leave(moved)
        return replace(state, memory=now.memory) if any(now.memory) else state

    def _kick(self, carry: tuple[Any, Now]) -> tuple[Any, Now]:
        """Motion after the kick, with the step number and memory after this step."""
        motion, now = carry
        present = self._at(now, 0.5)
        kicked = present.kick(motion)
        seen = present.view(kicked)
        return kicked, remembering(present.scene, seen, self.verlet.dt, now)

    def _at(self, now: Now, fraction: ArrayLike) -> Verlet:
        """Stepper whose scene is at the time `(now.step + fraction) * dt`."""
        scene = scene_at(self.scene, now, fraction, self.verlet.dt)
        return replace(self.verlet, scene=scene)
