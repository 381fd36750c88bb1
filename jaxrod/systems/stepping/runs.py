"""Preparation of a run of a system: checks, memory and the stable step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxrod.analysis.stability import StableStep
from jaxrod.effects.base import StabilityBound, added_bounds
from jaxrod.rods.repr import repr_or_class_name, step_repr
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.neighbour_lists import RECORD, NeighbourRecord, no_record
from jaxrod.systems.coupling import refresh_every
from jaxrod.systems.stepping.assembly import (
    Assembly,
    SystemState,
    member_shapes,
)
from jaxrod.validation import as_array


def check_system_state(system: Assembly, state: Any) -> None:
    """Validates that a state contains a matching state for every member of a system.

    Raises:
        TypeError: If it is not a mapping, or a member's state is of another kind.
        ValueError: If members are missing, unknown, or of another size or type.
    """
    if not isinstance(state, Mapping):
        raise TypeError(
            "state must be a dict of the states of all members by name, got "
            f"{type(state).__name__}"
        )
    also = {RECORD} if lists_neighbours(system) else set()
    if set(state) - also != set(system.members):
        missing = sorted(set(system.members) - set(state))
        extra = sorted(set(state) - also - set(system.members), key=str)
        raise ValueError(
            f"state must have the members {sorted(system.members)}, "
            f"got {sorted(state, key=str)}: "
            + " and ".join(
                f"{what} {', '.join(map(repr, names))}"
                for what, names in (("add", missing), ("leave out", extra))
                if names
            )
        )
    if RECORD in state:
        _check_record(state[RECORD])
    check_single(system)
    for name, member in system.interfaces().items():
        member.check_state(name, state[name], system.dtype)


def lists_neighbours(system: Assembly) -> bool:
    """Whether a system has couplings that search for neighbours."""
    return refresh_every(system.couplings) is not None


def check_single(system: Assembly) -> None:
    """Raises a ValueError if a system is a batch of systems."""
    if system.shapes and member_shapes(system.members) != system.shapes:
        raise ValueError(
            "system must be one system, got a batch: use jax.vmap, as in "
            "jax.vmap(jaxrod.advance, in_axes=(0, 0, None, None))(systems, ...)"
        )


def _check_record(record: Any) -> None:
    if not isinstance(record, NeighbourRecord):
        raise TypeError(
            f"state[{RECORD!r}] must be the record that a run left there, got "
            f"{type(record).__name__}: leave it out to start again"
        )


def system_with_memory(system: Assembly, state: SystemState) -> dict[str, Any]:
    """Copy of the state with the initial memories of effects, where it has none.

    For a system with neighbour lists, the copy also gets a record of missed contacts.
    """
    own = {
        name: member.with_memory(state[name])
        for name, member in system.interfaces().items()
    }
    if lists_neighbours(system):
        record = state.get(RECORD)
        own[RECORD] = no_record(system.dtype) if record is None else record
    return own


def unstable_step(system: Assembly, dt: Array) -> str | None:
    """Warning about a concrete step above the stability bound; `None` below it."""
    # The argument is that of `stable_dt`, so that both are one program.
    bound = stable_system_dt(system, as_array("safety", 1.0, ""))
    if not float(dt) > float(bound.dt):
        return None
    return (
        f"dt = {float(dt):.3g} s is above the stability bound {float(bound.dt):.3g} s "
        f"set by {bound.limiting_mode}"
    )


@pytree
class StableSystemStep:
    """Largest stable step of a system, and what limits it."""

    dt: Float[Array, ""]
    """Largest stable step times the safety factor: the smallest of `members` [s]."""
    members: tuple[Float[Array, ""], ...]
    """Largest stable step of each member times the safety factor [s], in the order of
    `names`; infinite where nothing limits it. At a state it is infinite for all members
    but the one that moves most in the motion that limits the step."""
    steps: tuple[StableStep | None, ...]
    """`StableStep` of each member made of rods, with a leading axis for equal rods;
    `None` for rigid bodies. The order is that of `names`."""
    names: tuple[str, ...] = static()
    """Names of the members."""

    def __repr__(self) -> str:
        """One line: the step and what limits it."""
        return repr_or_class_name(step_repr, self)

    @property
    def limiting_mode(self) -> str:
        """Description of the motion that limits the step; needs concrete values."""
        which = min(range(len(self.names)), key=lambda k: float(self.members[k]))
        name, step = self.names[which], self.steps[which]
        if step is None:
            return f"what acts on {name!r}"
        if step.dt.ndim == 0:
            return f"{step.limiting_mode} of {name!r}"
        rod = int(jnp.argmin(step.dt))
        one = jax.tree.map(lambda leaf: leaf[rod], step)
        return f"{one.limiting_mode} of rod {rod} of {name!r}"


@jax.jit
def stable_system_dt(system: Assembly, safety: ArrayLike = 0.8) -> StableSystemStep:
    """The largest step at which a system is stable, times a safety factor.

    Args:
        system: The system; schedules are replaced by the bounds on their size.
        safety: Fraction of the limit to use, in (0, 1].
    """
    system = system.at_largest
    parts = system.parts()
    bounds: dict[str, StabilityBound] = {}
    for coupling in system.couplings:
        prepared = coupling.prepared(parts)
        for name, bound in prepared.stability_bounds(parts).items():
            bounds[name] = added_bounds(bounds.get(name), bound)
    limits: list[Array] = []
    steps: list[StableStep | None] = []
    joined = {name for own in system.couplings for name, _ in own.joined_nodes()}
    for name, member in system.interfaces().items():
        bound = bounds.get(name, StabilityBound())
        if name in joined and not member.method.explicit:
            # The force of an exact joint acts after the step of an implicit rod, whose
            # end is free until then.
            member = member.in_space().as_member()
        limit, step = member.stable_step(bound, safety)
        limits.append(limit)
        steps.append(step)
    return StableSystemStep(
        jnp.min(jnp.stack(limits)), tuple(limits), tuple(steps), tuple(system.members)
    )
