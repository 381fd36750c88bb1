"""Numerical health of a system's state: its members and its couplings."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxrod.analysis.health import HealthLimits
from jaxrod.lanes.steps import by_kernel
from jaxrod.structure import pytree
from jaxrod.systems.contact.neighbour_lists import RECORD, NeighbourRecord, no_record
from jaxrod.systems.energies import seen_at_rest
from jaxrod.systems.stepping.assembly import Assembly, SystemState
from jaxrod.systems.stepping.listing import with_shortage


@pytree
class SystemHealth:
    """Health of a system's state."""

    members: dict[str, Any]
    """`Health` of each rod, with a leading axis for equal rods; `BodyHealth` of rigid
    bodies."""
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
    """Record behind `overflow` and `stale`; zero without lists."""

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether anything is wrong anywhere."""
        each = [jnp.any(own.flagged) for own in self.members.values()]
        own = self.violation | self.overflow | self.stale
        return functools.reduce(jnp.logical_or, each, own)


@pytree
class _CouplingHealth:
    """The health of couplings, as `by_kernel` takes it."""

    system: Assembly
    """The system of the couplings."""

    def examined(self, state: SystemState) -> tuple[Array, NeighbourRecord]:
        """The largest violation of a coupling [1], and the record of the lists."""
        seen, couplings = seen_at_rest(self.system, state)
        found = [coupling.violation(seen) for coupling in couplings]
        zero = jnp.zeros((), self.system.dtype)
        worst = functools.reduce(
            jnp.maximum, [value for value in found if value is not None], zero
        )
        record = state.get(RECORD, no_record(self.system.dtype))
        return worst, with_shortage(record, couplings)


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
    members = {
        name: member.health(state[name], dt, limits)
        for name, member in system.interfaces().items()
    }
    # A kernel, because XLA takes many seconds to compile contact with lists.
    worst, record = by_kernel(_CouplingHealth(system), "examined", state)
    # Written so that NaN counts as wrong.
    return SystemHealth(
        members,
        ~(worst <= limits.largest_violation),
        worst,
        record.overflow,
        record.stale,
        record,
    )
