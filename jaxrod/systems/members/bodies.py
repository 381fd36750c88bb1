"""Rigid bodies as members of a system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxrod.analysis.health import HealthLimits
from jaxrod.effects.base import StabilityBound, added_bounds
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import split_quaternion
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.structure import pytree
from jaxrod.systems.members.member import Member
from jaxrod.systems.members.parts import Parts
from jaxrod.systems.members.rigid_bodies import (
    BodyState,
    RigidBodies,
    body_angular_momenta,
    body_kinetic_energy,
)
from jaxrod.systems.members.rigid_stepper import Carried, RigidStepper, body_parts
from jaxrod.systems.members.rods import check_fields
from jaxrod.systems.members.steppers import BodiesStepper, MemberStepper


@pytree
class BodyHealth:
    """Flags and the measured values behind them, for rigid bodies of one member."""

    finite: Bool[Array, ""]
    """Whether every number of the state is finite, and so are their squares."""
    spin: Bool[Array, ""]
    """Flag: a body turns more than a radian per step."""
    norm: Bool[Array, ""]
    """Flag: an orientation is not a unit quaternion."""
    largest_spin: Float[Array, ""]
    """Largest angular velocity [rad/s]."""
    largest_norm_error: Float[Array, ""]
    """Largest error of the square of a quaternion's norm [1]."""

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether anything is wrong."""
        return ~self.finite | self.spin | self.norm


@dataclass(frozen=True)
class Bodies(Member):
    """Rigid bodies of one shape."""

    model: RigidBodies

    @property
    def dtype(self) -> Any:
        """Type of all numbers."""
        return self.model.masses.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of bodies."""
        return jnp.shape(self.model.masses)

    def mapped(self, function: Callable[[Any], Any]) -> Any:
        """The bodies with a function applied to them."""
        return function(self.model)

    def recalling(self, state: Any) -> Any:
        """The bodies: effects on bodies have no memory."""
        return self.model

    def with_memory(self, state: Any) -> Any:
        """The state: effects on bodies have no memory."""
        return state

    def memory(self, state: Any) -> Any:
        """No memory."""
        return ()

    def check_state(self, name: str, state: Any, dtype: Any) -> None:
        """Raises a TypeError or a ValueError if a state is not of these bodies."""
        if not isinstance(state, BodyState):
            raise TypeError(
                f"state of {name!r} must be a BodyState, got {type(state).__name__}"
            )
        check_fields(name, state, (3, *self.shape), dtype, "angular_velocities")

    def parts(self) -> Parts:
        """Constants, as couplings see them."""
        return body_parts(self.model)

    def held(self, state: Any) -> Vec3 | None:
        """Nothing: supports hold rods."""
        return None

    def motion(self, state: Any) -> Motion:
        """Positions and rates in a state, spins as angular momenta."""
        return Motion(
            vectors.split(state.positions),
            split_quaternion(state.orientations),
            vectors.split(state.velocities),
            vectors.split(body_angular_momenta(self.model, state)),
        )

    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Their part of a step."""
        return BodiesStepper(RigidStepper.create(self.model, carried, dt))

    def momenta(self, state: Any) -> tuple[Array, Array]:
        """Momenta and angular momenta of the bodies, world frame."""
        masses = self.model.masses[None]
        return masses * state.velocities, body_angular_momenta(self.model, state)

    def kinetic_energy(self, state: Any) -> Array:
        """Kinetic energy [J]."""
        return body_kinetic_energy(self.model, state)

    def potential_energy(self, state: Any) -> Array:
        """Potentials of their effects [J]."""
        total = jnp.zeros((), state.positions.dtype)
        bodies: Any = self.model
        for effect in self.model.effects:
            total = total + effect.energy(bodies, state)
        return total

    def momentum(self, state: Any) -> Array:
        """Linear momentum, world frame [kg m/s]."""
        return jnp.sum(self.model.masses[None] * state.velocities, axis=1)

    def angular_momentum(self, state: Any) -> Array:
        """Angular momentum about the origin, world frame [kg m^2/s]."""
        orbital = vectors.cross(
            vectors.split(state.positions),
            vectors.scale(self.model.masses, vectors.split(state.velocities)),
        )
        own = body_angular_momenta(self.model, state)
        return jnp.sum(vectors.join(orbital) + own, axis=1)

    def health(self, state: Any, dt: ArrayLike, limits: HealthLimits) -> BodyHealth:
        """Flags and the measured values behind them."""
        spins = vectors.safe_norm(vectors.split(state.angular_velocities))
        norms = jnp.abs(jnp.sum(state.orientations**2, axis=0) - 1)
        spin, norm = jnp.max(spins), jnp.max(norms)
        squares = jnp.sum(state.positions**2) + jnp.sum(state.velocities**2)
        return BodyHealth(
            finite=jnp.isfinite(squares + spin + norm),
            spin=~((spin * dt <= limits.largest_turn) & (jnp.asarray(dt) > 0)),
            norm=~(norm <= limits.largest_norm_error),
            largest_spin=spin,
            largest_norm_error=norm,
        )

    def stable_step(self, bound: StabilityBound, safety: ArrayLike) -> tuple[Any, Any]:
        """The step at which explicit springs and dashpots on bodies are stable [s]."""
        bodies: Any = self.model
        for effect in self.model.effects:
            own = effect.stability_bound(bodies)
            bound = bound if own is None else added_bounds(bound, own)
        least = jnp.min(self.model.principal_inertias, axis=0)
        one = jnp.ones((), self.dtype)
        nodes, elements = bound.drags(one, one)
        moving = _limit(self.model.masses, bound.nodes, nodes)
        turning = _limit(least, bound.elements, elements)
        limit = jnp.min(jnp.minimum(moving, turning))
        return jnp.asarray(safety) * limit, None


def _limit(inertia: Array, stiffness: Array | None, drag: Array | None) -> Array:
    """Positive root h of `k h^2 + 2 c h = 4 m`."""
    zero = jnp.zeros_like(inertia)
    k = zero if stiffness is None else stiffness
    c = zero if drag is None else drag
    square = c * c + 4 * k * inertia
    free = square <= 0
    # Two wheres: at zero the root has no derivative.
    below = c + jnp.sqrt(jnp.where(free, 1, square))
    return jnp.where(free, jnp.inf, 4 * inertia / below)
