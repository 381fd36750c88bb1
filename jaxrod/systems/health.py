"""Numerical health of a system's state: of its members and of its couplings."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxrod.analysis.health import Health, HealthLimits, health
from jaxrod.geometry import vectors
from jaxrod.structure import pytree
from jaxrod.systems.contact.neighbour_lists import RECORD, NeighbourRecord, no_record
from jaxrod.systems.energies import seen_at_rest
from jaxrod.systems.members.rigid_bodies import BodyState, RigidBodies
from jaxrod.systems.stepping.assembly import Assembly, SystemState


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


@pytree
class SystemHealth:
    """Health of a system's state."""

    members: dict[str, Health | BodyHealth]
    """Health of each member, with a leading axis for equal rods."""
    violation: Bool[Array, ""]
    """Flag: tied or attached nodes have come apart, or a contact is too deep."""
    largest_violation: Float[Array, ""]
    """Largest violation of a coupling [1]."""
    overflow: Bool[Array, ""]
    """Flag: lists of neighbours had too few entries, now or in a run that led here."""
    stale: Bool[Array, ""]
    """Flag: lists were used in a run after a node had moved by more than half their
    skin."""
    neighbours: NeighbourRecord
    """Record behind both flags; zero without lists."""

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether anything is wrong anywhere."""
        each = [jnp.any(own.flagged) for own in self.members.values()]
        own = self.violation | self.overflow | self.stale
        return functools.reduce(jnp.logical_or, each, own)


@jax.jit
def system_health(
    system: Assembly,
    state: SystemState,
    dt: ArrayLike,
    *,
    limits: HealthLimits | None = None,
) -> SystemHealth:
    """Examines a state of a system. Works inside jit and vmap.

    Args:
        system: The system, without schedules (`system.at(time)`).
        state: The state to examine.
        dt: The step size in use [s].
        limits: Limits beyond which a state is flagged.
    """
    limits = HealthLimits() if limits is None else limits
    system = system.recalling(state)
    members: dict[str, Health | BodyHealth] = {}
    for name, member in system.members.items():
        own = state[name]
        if isinstance(member, RigidBodies):
            members[name] = _of_bodies(own, dt, limits)
        elif member.rod.rest_lengths.ndim == 1:
            members[name] = health(member, own, dt, limits=limits)
        else:
            each: Any = jax.vmap(lambda s, x: health(s, x, dt, limits=limits))
            members[name] = each(member, own)
    seen, couplings = seen_at_rest(system, state)
    found = [coupling.violation(seen) for coupling in couplings]
    zero = jnp.zeros((), system.dtype)
    worst = functools.reduce(
        jnp.maximum, [value for value in found if value is not None], zero
    )
    record = state.get(RECORD, no_record(system.dtype))
    for coupling in couplings:
        if coupling.refresh_every is not None:
            record = replace(
                record,
                missed=jnp.maximum(record.missed, coupling.found.missed),
                used=jnp.maximum(record.used, jnp.max(coupling.found.used)),
            )
    # Written so that NaN counts as wrong.
    return SystemHealth(
        members,
        ~(worst <= limits.largest_violation),
        worst,
        record.overflow,
        record.stale,
        record,
    )


def _of_bodies(state: BodyState, dt: ArrayLike, limits: HealthLimits) -> BodyHealth:
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
