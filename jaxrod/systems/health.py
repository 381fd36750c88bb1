"""Numerical health of a system: flags of its members, joints, contacts and energy.

Members are examined as they are alone. Of couplings there are three questions: are tied
and attached nodes together and contacts shallow (`violation`), are the springs of ball
joints, hinges and glue short (`joints`), and have rods passed through each other or
through a body where contact keeps them apart (`passed`). The energy is that of all
members and couplings together, and may grow as that of one rod does
(`jaxrod.analysis.health.EnergyAccount`).

Passages are found between two states. Nodes are taken to move in straight lines from
one to the other, and each pair of elements is asked whether one went through the other
(`jaxrod.topology.crossings`), and each contact point whether it went through a body
(`jaxrod.contacts.passages`). A rod that went through and came back in between is not
seen.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxrod.analysis.health import EnergyAccount, HealthLimits, with_faults
from jaxrod.effects.base import Effect
from jaxrod.effects.own_classes import called_hook
from jaxrod.lanes.steps import by_kernel
from jaxrod.rods.repr import repr_or_class_name
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.neighbour_lists import (
    RECORD,
    NeighbourRecord,
    no_record,
    with_shortage,
)
from jaxrod.systems.coupling import AllParts, Coupling, Seen
from jaxrod.systems.stepping.assembly import Assembly, SystemState, seen_at_rest
from jaxrod.topology.passages import crossings

_PASSED = 0.1
"""Share of a passage above which it counts [1]. A passage between two elements counts
one. Where a node is passed it is shared by the elements on both sides, of both rods if
two nodes meet. Without a passage there is round-off alone."""


@pytree
class SystemHealth:
    """Flags of numerical faults in a system's state, and the values behind them.

    Example:
        >>> right = replace(state, positions=state.positions.at[0].add(1.0))
        >>> states = {"left": state, "right": right}  # end to end
        >>> ends = ("left", "tip"), ("right", "base")
        >>> joint = systems.ball_joint(*ends, states, stiffness=100.0)
        >>> members = {"left": scene, "right": jaxrod.make_scene(rod)}
        >>> system = jaxrod.make_system(members, joint)
        >>> aside = replace(right, positions=right.positions.at[1].add(0.03))
        >>> jaxrod.health(system, {**states, "right": aside}, dt=1e-4).faults
        ("Springs of 'left' and 'right': apart by 1.5 radii",)
    """

    members: dict[str, Any]
    """`Health` of each rod, with a leading axis for equal rods, or `BodyHealth` of
    rigid bodies, by name of the member."""
    violation: Bool[Array, ""]
    """Flag: tied or attached nodes have come apart, or a contact is too deep."""
    largest_violation: Float[Array, ""]
    """Largest violation of all couplings, such as the distance of tied nodes or the
    depth of a contact, divided by the radius [1]."""
    joints: Bool[Array, ""]
    """Flag: a ball joint, a hinge, a fixed joint or glue is pulled apart by more than
    `HealthLimits.largest_gap`."""
    largest_gap: Float[Array, ""]
    """Largest gap of such a joint, divided by the smaller radius, or the radius of
    gyration of a body [1]."""
    joint_angle: Bool[Array, ""]
    """Flag: the elastic joint of a weld, a fixed joint, glue or a ring is turned by
    more than `HealthLimits.largest_joint_angle`. At half a turn its moment changes its
    sign, and energy is not conserved."""
    largest_joint_angle: Float[Array, ""]
    """Largest rotation of such a joint from its rest orientation [rad]."""
    passed: Bool[Array, ""]
    """Flag: rods that contact keeps apart have passed through each other, a rod with
    self-contact through itself, or a rod through a body; not examined without the state
    `before`."""
    energy: Bool[Array, ""]
    """Flag: energy grew by more than work and round-off can explain."""
    energy_growth: Float[Array, ""]
    """Growth of the total energy; zero if it is not examined [J]."""
    energy_allowed: Float[Array, ""]
    """Growth that work, round-off and the limit allow [J]."""
    overflow: Bool[Array, ""]
    """Flag: neighbour lists have too few entries, now or earlier in the run."""
    stale: Bool[Array, ""]
    """Flag: a run used lists after a node had moved by more than half their skin, the
    gap up to which pairs of elements are listed."""
    neighbours: NeighbourRecord
    """Counts and displacements behind `overflow` and `stale`; all zero without lists.
    """
    passages: dict[str, Float[Array, ""]]
    """Number of passages of elements through others, and of contact points through
    bodies, by the names of their members; empty without the state `before`."""
    violations: tuple[Float[Array, ""] | None, ...]
    """Violation of each coupling [1]; `None` if it cannot be violated."""
    gaps: tuple[Float[Array, ""] | None, ...]
    """Gap of each coupling [1]; `None` if it is no joint."""
    turns: tuple[Float[Array, ""] | None, ...]
    """Rotation from rest of each coupling's joints [rad]; `None` without elastic
    joints."""
    limits: HealthLimits
    """The limits that were applied."""
    couplings: tuple[str, ...] = static(default=())
    """Description of each coupling: its class, and the members that it joins."""

    @property
    def finite(self) -> Bool[Array, ""]:
        """Whether every number of every rod and body is finite."""
        each = [jnp.all(getattr(m, "finite", True)) for m in self.members.values()]
        return functools.reduce(jnp.logical_and, each)

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether any flag is set, of a member or of the couplings."""
        each = [jnp.any(own.flagged) for own in self.members.values()]
        own = self.violation | self.joints | self.joint_angle
        own = own | self.passed | self.energy
        return functools.reduce(jnp.logical_or, each, own | self.overflow | self.stale)

    @property
    def faults(self) -> tuple[str, ...]:
        """Every flag that is set, with the member or the coupling that it is about.

        It needs a single system with known values.
        """
        found: list[str] = []
        for name, own in self.members.items():
            found += [f"{where}: {flag}" for where, flag in _flags(repr(name), own)]
        for words, depth in zip(self.couplings, self.violations, strict=True):
            if depth is not None and not depth <= self.limits.largest_violation:
                found.append(f"{words}: violation of {float(depth):.3g} radii")
        for words, gap in zip(self.couplings, self.gaps, strict=True):
            if gap is not None and not gap <= self.limits.largest_gap:
                found.append(f"{words}: apart by {float(gap):.3g} radii")
        for words, turn in zip(self.couplings, self.turns, strict=True):
            if turn is not None and not turn <= self.limits.largest_joint_angle:
                found.append(f"{words}: turned by {float(turn):.3g} rad")
        for names, count in self.passages.items():
            if count > 0:
                found.append(f"{names} passed through each other: {float(count):.3g}")
        if self.energy:
            found.append(
                f"energy grew by {float(self.energy_growth):.3g} J, allowed are "
                f"{float(self.energy_allowed):.3g} J"
            )
        lists = {"overflow": self.overflow, "stale": self.stale}
        found += [f"neighbour lists: {name}" for name, flag in lists.items() if flag]
        return tuple(found)

    def __repr__(self) -> str:
        """One line if no flag is set, else a line for each flag."""
        return repr_or_class_name(_in_lines, self)


def _in_lines(found: SystemHealth) -> str:
    """Text for `print`: one line without faults, else a line for each of them."""
    values = (
        f"members {len(found.members)}, violation {found.largest_violation:.3g} radii"
    )
    return with_faults("SystemHealth", found.faults, values)


def _flags(where: str, own: Any) -> list[tuple[str, str]]:
    """Flags that are set in the health of a member, with the rod that each is about."""
    found = []
    for field in dataclasses.fields(own):
        values, words = np.asarray(getattr(own, field.name)), field.name
        if values.dtype != bool:
            continue
        if words == "finite":
            values, words = ~values, "not finite"
        if values.ndim == 0:
            found += [(where, words)] if values else []
        else:
            rods = np.flatnonzero(values)
            found += [(f"rod {rod} of {where}", words) for rod in rods]
    return found


@pytree
class _CouplingHealth:
    """Violations, gaps and turns of all couplings, as a method for `by_kernel`."""

    system: Assembly
    """The system whose couplings are examined."""

    def examined(self, state: SystemState) -> Any:
        """Violations, gaps [1] and turns [rad] of couplings, and the lists' record."""
        seen, couplings = seen_at_rest(self.system, state)
        record = state.get(RECORD, no_record(self.system.dtype))
        return (
            tuple(coupling.violation(seen) for coupling in couplings),
            tuple(coupling.gap(seen) for coupling in couplings),
            tuple(coupling.joint_angle(seen) for coupling in couplings),
            with_shortage(record, couplings),
        )


@pytree
class CouplingEnergy:
    """Potential energy of all couplings, as a pytree with a method for `by_kernel`."""

    system: Assembly
    """The system whose couplings are summed."""

    def energy(self, state: SystemState) -> Float[Array, ""]:
        """Sum of the potential energies of all couplings in a state [J]."""
        seen, prepared = seen_at_rest(self.system, state)
        total = jnp.zeros((), self.system.dtype)
        for coupling in prepared:
            with called_hook(coupling, "energy"):
                total = total + coupling.energy(seen)
        return total


@jax.jit
def system_health(
    system: Assembly,
    state: SystemState,
    dt: Array,
    limits: HealthLimits | None,
    energy_before: ArrayLike | None,
    work_input: ArrayLike,
    n_steps: ArrayLike,
    before: SystemState | None,
) -> SystemHealth:
    """Flags of numerical faults in a system's state. Works inside jit and vmap.

    Args:
        system: The system, without schedules (`system.at(time)`).
        state: The state to examine.
        dt: The step size in use [s].
        limits: Limits beyond which a state is flagged.
        energy_before: Total energy at an earlier time [J]; without it energy is not
            examined.
        work_input: Work done since then by loads without a potential [J].
        n_steps: Number of steps since then.
        before: An earlier state; without it passages are not examined.
    """
    limits = HealthLimits() if limits is None else limits
    system = system.recalling(state)
    parts = system.parts()
    prepared = tuple(coupling.prepared(parts) for coupling in system.couplings)
    members = {
        name: member.health(state[name], dt, limits)
        for name, member in system.interfaces().items()
    }
    # A kernel, because XLA takes many seconds to compile contact with lists.
    examined = by_kernel(_CouplingHealth(system), "examined", state)
    violations, gaps, turns, record = examined
    zero = jnp.zeros((), system.dtype)
    deepest, widest = _largest(violations, zero), _largest(gaps, zero)
    steepest = _largest(turns, zero)
    growth, allowed = zero, zero
    if energy_before is not None:
        account = _account(system, prepared, parts, state, jnp.asarray(dt, zero.dtype))
        growth, allowed = account.growth_since(
            jnp.asarray(energy_before, zero.dtype),
            jnp.asarray(work_input, zero.dtype),
            jnp.asarray(n_steps, zero.dtype),
            limits.largest_energy_growth,
        )
    passages = {}
    if before is not None:
        passages = {
            **passages_between(prepared, before, state),
            **_passages_of_bodies(system, prepared, parts, before, state),
        }
    # Written so that NaN counts as wrong.
    return SystemHealth(
        members=members,
        violation=~(deepest <= limits.largest_violation),
        largest_violation=deepest,
        joints=~(widest <= limits.largest_gap),
        largest_gap=widest,
        joint_angle=~(steepest <= limits.largest_joint_angle),
        largest_joint_angle=steepest,
        passed=~(sum(passages.values(), zero) <= 0),
        energy=~(growth <= allowed),
        energy_growth=growth,
        energy_allowed=allowed,
        overflow=record.overflow,
        stale=record.stale,
        neighbours=record,
        passages=passages,
        violations=violations,
        gaps=gaps,
        turns=turns,
        limits=limits,
        couplings=tuple(_in_words(coupling, parts) for coupling in prepared),
    )


def _largest(values: Sequence[Array | None], zero: Array) -> Array:
    """Largest of several values; zero if there are none."""
    return functools.reduce(jnp.maximum, [v for v in values if v is not None], zero)


def _in_words(coupling: Coupling, parts: AllParts) -> str:
    """Class of a coupling, and the members that it loads or joins."""
    listed = _named(coupling, parts)
    if not listed:
        return type(coupling).__name__
    *most, last = listed
    both = f"{', '.join(most)} and {last}" if most else last
    return f"{type(coupling).__name__} of {both}"


def _named(coupling: Coupling, parts: AllParts) -> list[str]:
    """Members that a coupling loads or joins, in quotes."""
    names = {name for name, _ in coupling.joined_nodes()}
    names |= set(coupling.stability_bounds(parts))
    return [repr(name) for name in sorted(names)]


def _account(
    system: Assembly,
    prepared: Sequence[Coupling],
    parts: AllParts,
    state: SystemState,
    dt: Array,
) -> EnergyAccount:
    """Account of the energy of all members and couplings."""
    members = system.interfaces()
    mean = jnp.zeros(3, dt.dtype)
    if not _is_held(system, state):
        mass = sum((jnp.sum(p.node_masses) for p in parts.values()), 0 * mean[0])
        mean = sum((members[k].momentum(state[k]) for k in members), mean) / mass
    each = [members[k].energy_account(state[k], mean, dt) for k in members]
    total = functools.reduce(EnergyAccount.__add__, each)
    if not prepared:
        return total
    stored = by_kernel(CouplingEnergy(system), "energy", state)
    shaken = jnp.zeros((), dt.dtype)
    for coupling in prepared:
        for name, bound in coupling.stability_bounds(parts).items():
            if bound.nodes is not None:
                places = state[name].layout.row(state[name].positions)
                spacings = jnp.sum(jnp.spacing(places) ** 2, axis=0)
                shaken = shaken + jnp.sum(bound.nodes * spacings) / 12
    none = jnp.zeros_like(shaken)
    return total + EnergyAccount(stored, jnp.abs(stored), shaken, none, none)


def _is_held(system: Assembly, state: SystemState) -> bool:
    """Whether anything ties the system to a place, so that its rest is a state apart.

    That is an effect that can be violated, such as a clamp or contact with a fixed
    body, or a coupling that acts from outside.
    """
    effects = [e for member in system.interfaces().values() for e in member.effects]
    holds = any(type(e).violation is not Effect.violation for e in effects)
    return holds or any(c.acts_from_outside for c in system.couplings)


def passages_between(
    prepared: Sequence[Coupling], before: SystemState, after: SystemState
) -> dict[str, Array]:
    """Number of passages of elements through each other, by the names of members."""
    found: dict[str, Array] = {}
    for coupling in prepared:
        for a, b, itself in coupling.kept_apart:
            words = f"{a!r} and {b!r}" if a != b else repr(a)
            count = _passages_of(a, b, itself, before, after)
            found[words] = jnp.maximum(found.get(words, jnp.zeros_like(count)), count)
    return found


def _passages_of_bodies(
    system: Assembly,
    prepared: Sequence[Coupling],
    parts: AllParts,
    before: SystemState,
    after: SystemState,
) -> dict[str, Array]:
    """Number of points of rods that went through bodies, by the names of members."""
    members, found = system.interfaces(), {}
    for name, member in members.items():
        count = member.passages(before[name], after[name])
        if count is not None:
            found[f"{name!r} and fixed bodies"] = count
    seen = [
        {name: Seen(parts[name], m.motion(state[name])) for name, m in members.items()}
        for state in (before, after)
    ]
    for coupling in prepared:
        count = coupling.passages(*seen)
        if count is not None:
            words = " and ".join(_named(coupling, parts))
            found[words] = found.get(words, jnp.zeros_like(count)) + count
    return found


def _passages_of(
    a: str, b: str, itself: bool, before: SystemState, after: SystemState
) -> Array:
    """Number of passages of elements of two members through each other.

    Args:
        a: Name of the first member.
        b: Name of the second; the same for rods of one member.
        itself: Whether passages of a rod through itself count.
        before: The earlier state.
        after: The later state.
    """

    def nodes(state: Mapping[str, Any], name: str) -> Array:
        row: Array = state[name].layout.row(state[name].positions)
        return row

    def rods(name: str) -> np.ndarray:
        """Rod of each element of the flat row; -1 between one rod and the next."""
        layout = after[name].layout
        numbers = np.repeat(np.arange(layout.count), layout.n_elements + 1)
        numbers[layout.n_elements :: layout.n_elements + 1] = -1
        return numbers[:-1]

    own, other = rods(a)[:, None], rods(b)[None, :]
    counted = (own >= 0) & (other >= 0)
    if a == b:
        counted = np.triu(counted & ((own != other) | itself))
    pair = (nodes(before, b), nodes(after, b)) if a != b else ()
    counts = crossings(nodes(before, a), nodes(after, a), *pair)
    each = jnp.where(counted, jnp.abs(counts), 0)
    return jnp.sum(jnp.where(each <= _PASSED, 0, each))
