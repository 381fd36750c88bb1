"""A system: rods and rigid bodies that act on each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxrod.analysis.health import HealthLimits
from jaxrod.composite import Composite, Stepper
from jaxrod.effects.own_classes import check_own_class
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.pyelastica import PyElastica
from jaxrod.scene import Scene
from jaxrod.structure import pytree
from jaxrod.systems.contact.continued import free_ends
from jaxrod.systems.contact.neighbour_lists import RECORD
from jaxrod.systems.energies import (
    seen_at_rest,
    system_angular_momentum,
    system_kinetic_energy,
    system_momentum,
    system_potential_energy,
)
from jaxrod.systems.health import SystemHealth, system_health
from jaxrod.systems.joints.attachments import Attachment
from jaxrod.systems.joints.ties import Tie, merged
from jaxrod.systems.members.body_effects import check_body_effects
from jaxrod.systems.members.rigid_bodies import RigidBodies
from jaxrod.systems.sites.coupling import AllParts, Coupling
from jaxrod.systems.stability import StableSystemStep, stable_system_dt
from jaxrod.systems.stepping.assembly import (
    Assembly,
    Model,
    SystemState,
    held_parts,
    member_shapes,
)
from jaxrod.systems.stepping.runs import (
    check_single,
    check_system_run,
    check_system_state,
    system_stepper,
    system_with_memory,
    unstable_step,
)
from jaxrod.validation import in_type, knows_constants


@pytree
class System(Assembly, Composite):
    """Rods and rigid bodies by name, and the couplings between them.

    Structure is static, numbers are traced. Only what is listed is in the compiled
    program. Build a system with `make_system`. The functions for scenes take it too:
    `advance`, `rollout`, `stable_dt`, `health`, `total_energy`, `momentum`, with a dict
    of states by member.
    """

    def check_run(self, state: Any, dt: ArrayLike) -> Array:
        """Checks the arguments of a run, and returns the step in the system's type."""
        return check_system_run(self, state, dt)

    def run_stepper(self, state: Any, dt: Array, first: Array | None) -> Stepper:
        """The integrator of a run."""
        return system_stepper(self, state, dt, first)

    def with_memory(self, state: Any) -> dict[str, Any]:
        """The state with the initial memories of effects."""
        return system_with_memory(self, state)

    def step_warning(self, dt: Array) -> str | None:
        """Warning about a concrete step above the stability bound; `None` below it."""
        return unstable_step(self, dt)

    def stable_step(self, safety: ArrayLike) -> StableSystemStep:
        """The largest step at which the system is stable, times a safety factor."""
        check_single(self)
        return stable_system_dt(self, safety)

    def health(
        self, state: Any, dt: ArrayLike, limits: HealthLimits | None
    ) -> SystemHealth:
        """Flags and the measured values behind them."""
        check_system_state(self, state)
        self.check_moment()
        return system_health(self, state, dt, limits=limits)

    def check_moment(self) -> None:
        """Raises a `ValueError` if the system depends on time."""
        if self.depends_on_time:
            raise ValueError(
                "this asks about one moment, but a number of an effect or a coupling "
                "is a schedule: give system.at(time)"
            )

    def kinetic_energy(self, state: Any) -> Float[Array, ""]:
        """Kinetic energy of all members [J]."""
        check_system_state(self, state)
        return system_kinetic_energy(self, state)

    def potential_energy(self, state: Any) -> Float[Array, ""]:
        """Potential energy of all members and couplings [J]."""
        check_system_state(self, state)
        self.check_moment()
        return system_potential_energy(self, state)

    def momentum(self, state: Any) -> Float[Array, "3"]:
        """Linear momentum [kg m/s]."""
        check_system_state(self, state)
        return system_momentum(self, state)

    def angular_momentum(self, state: Any) -> Float[Array, "3"]:
        """Angular momentum about the origin [kg m^2/s]."""
        check_system_state(self, state)
        return system_angular_momentum(self, state)


@knows_constants
def make_system(
    members: Mapping[str, Model],
    *couplings: Coupling | Sequence[Coupling],
    state: SystemState | None = None,
) -> System:
    """A system of rods and rigid bodies.

    Args:
        members: Members by name: scenes and `RigidBodies`. A scene is a rod and its
            effects, or equal rods if every number has a leading axis, as from
            `jax.vmap`.
        *couplings: Couplings, as `tie`, `weld`, `attach`, `hinge_joint` and others
            return them.
        state: A state of the system. If it is given, couplings are checked against the
            nodes that supports hold in it, and lists of neighbours are sized for it.

    Raises:
        ValueError: If a coupling does not fit the members, types differ, a member's
            method has no steps in a system, or an effect does not act on rigid bodies.
        TypeError: If a member or a coupling is something else.
    """
    if not isinstance(members, Mapping) or not members:
        raise TypeError("members must be a dict of at least one scene or rigid body")
    for name, member in members.items():
        _check_member(name, member)
    listed = list(_flat(couplings))
    ties = merged([c for c in listed if isinstance(c, Tie)])
    others = [c for c in listed if not isinstance(c, Tie)]
    # Ties come last: they have the final word on velocities.
    ordered = (*others, ties) if ties is not None else tuple(others)
    kept = {name: _with_own_types(name, member) for name, member in members.items()}
    system = System(kept, ordered)
    types = {name: System({name: member}).dtype for name, member in members.items()}
    if len(set(types.values())) > 1:
        raise ValueError(
            "members must all be of one type, got "
            + ", ".join(f"{name!r}: {dtype}" for name, dtype in types.items())
        )
    parts = system.parts()
    if state is not None:
        parts = held_parts(system, state)
    for coupling in ordered:
        coupling.check(parts)
    tied = () if ties is None else ties.pairs
    free = _free_ends(parts, ordered, system.dtype)
    known = {name: _with_free_ends(kept[name], ends) for name, ends in free.items()}
    system = replace(system, members=kept | known)
    fitted = tuple(
        coupling.fitted(parts, tied).with_free_ends(free) for coupling in ordered
    )
    if any(coupling.refresh_every is not None for coupling in fitted):
        fitted = _sized(system, fitted, state)
    typed = tuple(in_type(system.dtype, type(c).__name__, c) for c in fitted)
    _check_followers(ordered)
    return replace(system, couplings=typed, shapes=member_shapes(system.members))


def _flat(couplings: Any) -> Any:
    for coupling in couplings:
        if isinstance(coupling, Coupling):
            check_own_class(coupling, Coupling, "a coupling")
            yield coupling
        elif isinstance(coupling, Sequence) and not isinstance(coupling, str):
            yield from _flat(coupling)
        else:
            raise TypeError(
                f"couplings must be jaxrod couplings, got {type(coupling).__name__}"
            )


def _check_member(name: Any, member: Any) -> None:
    if not isinstance(name, str):
        raise TypeError(f"names of members must be strings, got {name!r}")
    if isinstance(member, RigidBodies):
        _check_axes(name, "masses", member.masses, ("bodies",))
        check_body_effects(name, member)
        return
    if not isinstance(member, Scene):
        raise TypeError(
            f"member {name!r} must be a scene from make_scene or a rigid body, got "
            f"{type(member).__name__}"
        )
    lengths = member.rod.rest_lengths
    _check_axes(name, "rest lengths", lengths, ("elements",), ("rods", "elements"))
    if not isinstance(member.method, Consistent | PyElastica):
        raise ValueError(
            f"member {name!r} steps with {type(member.method).__name__}, which has no "
            "steps in a system: use consistent() or pyelastica()"
        )


def _check_axes(name: str, what: str, given: Array, *allowed: tuple[str, ...]) -> None:
    if given.ndim in map(len, allowed):
        return
    wanted = " or ".join(f"({', '.join(axes)})" for axes in allowed)
    raise ValueError(
        f"member {name!r}: its {what} must have the shape {wanted}, got {given.shape}: "
        "use jax.vmap for a batch of systems"
    )


def _with_own_types(name: str, member: Model) -> Model:
    """The member, with the numbers of a body's effects in the type of the body."""
    if not isinstance(member, RigidBodies):
        return member
    where = f"effects of {name!r}"
    typed = in_type(member.masses.dtype, where, member.effects)
    return replace(member, effects=typed)


def _free_ends(
    parts: AllParts, couplings: Sequence[Coupling], dtype: Any
) -> dict[str, Array]:
    """One for each free end of the rods of each member, zero for other ends."""
    held = {node for coupling in couplings for node in coupling.joined_nodes()}
    return {
        name: jnp.asarray(free_ends(name, parts, held), dtype)
        for name, own in parts.items()
        if own.is_rod
    }


def _with_free_ends(member: Model, free: Float[Array, "rods 2"]) -> Model:
    """The scene, whose effects know which ends of its rods are free."""
    scene: Any = member
    if not scene.effects or bool(jnp.all(free)):
        return member
    own = free if scene.rod.rest_lengths.ndim > 1 else free[0]
    effects = tuple(effect.with_free_ends(own) for effect in scene.effects)
    return replace(scene, effects=effects)


def _sized(
    system: System, couplings: tuple[Coupling, ...], state: SystemState | None
) -> tuple[Coupling, ...]:
    """Couplings with room for their neighbours, as counted in a state."""
    if RECORD in system.members:
        raise ValueError(
            f"no member can be called {RECORD!r}: a state has its record of lists there"
        )
    if state is None:
        sizes = [c for c in couplings if c.refresh_every is not None and not c.is_sized]
        if sizes:
            raise ValueError(
                "lists of neighbours need pairs, candidates and cell_slots from "
                "neighbour_lists, or make_system a state in which to count them"
            )
        return couplings
    # Without couplings: nothing is searched yet.
    plain = replace(system, couplings=()).at(0.0)
    seen, _ = seen_at_rest(plain, state)
    parts = system.parts()
    return tuple(
        c if c.refresh_every is None else _with_room(c, parts, seen) for c in couplings
    )


def _with_room(coupling: Coupling, parts: Any, seen: Any) -> Coupling:
    ready: Any = coupling.prepared(parts)
    return replace(coupling, lists=ready.sized(seen).lists)  # type: ignore[type-var]


def _check_followers(couplings: Sequence[Coupling]) -> None:
    """Raises where a node would follow two bodies, or a body and a tie."""
    followers: dict[tuple[str, int], str] = {}
    for coupling in couplings:
        if isinstance(coupling, Attachment):
            for node in coupling.points.nodes.values:
                key = (coupling.points.member, int(node))
                if key in followers:
                    raise ValueError(
                        f"node {key[1]} of {key[0]!r} is attached to "
                        f"{followers[key]!r} and to {coupling.bodies.member!r}: it can "
                        "follow one body only"
                    )
                followers[key] = coupling.bodies.member
    for coupling in couplings:
        if isinstance(coupling, Tie):
            for points in coupling.points:
                for node in points.nodes.values:
                    key = (points.member, int(node))
                    if key in followers:
                        raise ValueError(
                            f"node {key[1]} of {key[0]!r} is tied and attached to "
                            f"{followers[key]!r}: attach all tied nodes to the body "
                            "instead"
                        )
