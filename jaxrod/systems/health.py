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
from jaxrod.systems.stepping.changing import with_shortage


@pytree
class SystemHealth:
    """Flags of numerical faults in a system's state, and the values behind them."""

    members: dict[str, Any]
    """`Health` of each rod, with a leading axis for equal rods, or `BodyHealth` of
    rigid bodies, by name of the member."""
    violation: Bool[Array, ""]
    """Flag: tied or attached nodes have come apart, or a contact is too deep."""
    largest_violation: Float[Array, ""]
    """Largest violation of all couplings [1], such as the distance of tied nodes or the
    depth of a contact, over the radius."""
    overflow: Bool[Array, ""]
    """Flag: lists of neighbours had too few entries, now or in a run that led here."""
    stale: Bool[Array, ""]
    """Flag: a run used lists after a node had moved by more than half their skin, the
    gap up to which pairs of elements are listed."""
    neighbours: NeighbourRecord
    """Counts and displacements behind `overflow` and `stale`; all zero without lists.
    """

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether any flag is set, of a member or of the couplings."""
        each = [jnp.any(own.flagged) for own in self.members.values()]
        own = self.violation | self.overflow | self.stale
        return functools.reduce(jnp.logical_or, each, own)


@pytree
class _CouplingHealth:
    """Violations of all couplings of a system, as a method for `by_kernel`."""

    system: Assembly
    """The system whose couplings are examined."""

    def examined(self, state: SystemState) -> tuple[Array, NeighbourRecord]:
        """Largest violation of all couplings [1], and the record of neighbour lists."""
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
    """Flags of numerical faults in a system's state. Works inside jit and vmap.

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
