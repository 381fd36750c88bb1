"""A system: rods and rigid bodies that act on each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.analysis.health import HealthLimits
from jaxrod.effects.own_classes import (
    advice_for,
    called_hook,
    check_own_class,
    is_own,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.lanes.steps import by_kernel
from jaxrod.model import GUESSES, Model, Stepper, TimeStep
from jaxrod.statics.equilibrium import Equilibrium, search_limits
from jaxrod.structure import Hinted, pytree
from jaxrod.systems.contact.neighbour_lists import RECORD
from jaxrod.systems.coupling import AllParts, Coupling
from jaxrod.systems.equilibrium import system_equilibrium
from jaxrod.systems.health import CouplingEnergy, SystemHealth, system_health
from jaxrod.systems.joints.regridding import AskedNodes, Regridding
from jaxrod.systems.members.member import Member
from jaxrod.systems.reactions import SystemReactions, system_reactions
from jaxrod.systems.reductions import check_reduced
from jaxrod.systems.static_problem import squared_frequencies
from jaxrod.systems.stepping.assembly import (
    Assembly,
    SystemState,
    held_parts,
    member_shapes,
    seen_at_rest,
)
from jaxrod.systems.stepping.measured_step import measured_system_dt
from jaxrod.systems.stepping.runs import (
    StableSystemStep,
    check_single,
    check_system_state,
    stable_system_dt,
    system_with_memory,
    unstable_step,
)
from jaxrod.systems.stepping.stepper import (
    SystemStepper,
    stepper_at,
    system_stepper,
)
from jaxrod.validation import (
    as_array,
    as_time_step,
    check_array,
    compiled,
    in_type,
    is_traced,
    knows_constants,
)


@pytree
class System(Assembly, Model, Hinted):
    """Rods and rigid bodies by name, and the couplings between them.

    Structure is static, numbers are traced. The compiled program contains these members
    and couplings only. Build a system with `make_system`. Functions for scenes
    (`advance`, `rollout`, `stable_dt`, `health`) also accept a system; its state is a
    dict of the states of the members by name. It has the same methods as a scene, such
    as `total_energy(state)`.

    Example:
        >>> system = jaxrod.make_system({"left": scene, "right": scene})
        >>> states = {"left": state, "right": state}
        >>> sorted(system.members), float(system.kinetic_energy(states))
        (['left', 'right'], 0.0)
    """

    _hints = GUESSES

    def states_by_name(self, state: Any) -> dict[str, Any]:
        """States of the members by name, without the record of neighbour lists.

        Example:
            >>> pair = jaxrod.make_system({"a": scene, "b": scene})
            >>> states = {"a": state, "b": state}
            >>> list(pair.states_by_name(states))
            ['a', 'b']
        """
        given = set(state) - {RECORD}
        if given != set(self.members):
            raise ValueError(
                f"states must have the members {sorted(self.members)}, got "
                f"{sorted(given)}"
            )
        return {name: state[name] for name in self.members}

    def with_members(self, changed: Mapping[str, Any]) -> System:
        """Copy of the system in which named members have other entries.

        Example:
            >>> pair = jaxrod.make_system({"a": scene, "b": scene})
            >>> loaded = scene.with_effect(jaxrod.end_load(force=(0.0, 0.0, -1.0)))
            >>> changed = pair.with_members({"b": loaded})
            >>> [len(changed.members[name].effects) for name in "ab"]
            [3, 4]
        """
        return replace(self, members={**self.members, **changed})

    def joined_nodes(self) -> dict[str, set[int]]:
        """Nodes of rods that couplings are fixed to, by member, counted in each rod."""
        every = self.interfaces().items()
        rods = {k: own.rod for k, own in every if own.rod is not None}
        grids = AskedNodes(rods, rods)
        for coupling in self.couplings:
            coupling.regridded(grids)
        return grids.asked

    def missed_contact(self, state: Any) -> Any:
        """Flag of a state: neighbour lists had too few entries since the run began."""
        return state[RECORD].overflow if RECORD in state else False

    def softened(self, share: ArrayLike) -> System:
        """Copy of the system whose contacts have a share of their stiffness."""
        return self._with_contact(lambda thing: thing.softened(share))

    def thinned(self, share: float) -> System:
        """Copy whose contacts have a share of their points, at least one each."""
        return self._with_contact(lambda thing: thing.thinned(share))

    def _with_contact(self, change: Callable[[Any], Any]) -> System:
        """Copy of the system with all scenes and all couplings changed."""
        scenes = {
            name: own.each(change)
            for name, own in self.interfaces().items()
            if own.rod is not None
        }
        couplings = tuple(change(coupling) for coupling in self.couplings)
        return replace(self.with_members(scenes), couplings=couplings)

    def contact_forces(self, state: Any) -> list[tuple[str, Vec3]]:
        """Contact forces on the nodes of members, world frame [N].

        Each entry belongs to one effect or coupling: the name of a member, and the
        forces on all its nodes.
        """
        found = [
            (name, forces)
            for name, member in self.interfaces().items()
            for forces in member.contact_forces(state[name])
        ]
        seen, couplings = seen_at_rest(self, state)
        for coupling in couplings:
            if coupling.is_contact:
                found += [
                    (name, loads.forces)
                    for name, loads in coupling.loads(seen).items()
                    if loads.forces is not None
                ]
        return found

    def with_states(self, state: Any, changed: Mapping[str, Any]) -> dict[str, Any]:
        """Copy of the state in which the named members have the given states."""
        return {**state, **changed}

    def check_state(self, state: Any) -> None:
        """Raises unless this is one system, no batch, and a state fits it."""
        check_system_state(self, state)

    def regridded(self, old: System, state: Any) -> System:
        """Copy whose couplings fit rods with other numbers of elements."""
        rods = [
            {k: own.rod for k, own in model.interfaces().items() if own.rod is not None}
            for model in (old, self)
        ]
        changed = [k for k in rods[0] if rods[0][k].n_elements != rods[1][k].n_elements]
        grids = Regridding(*({k: each[k] for k in changed} for each in rods))
        joined = tuple(coupling.regridded(grids) for coupling in old.couplings)
        return make_system(self.members, joined, state=state)

    def check_run(self, state: Any, dt: TimeStep, first: Array | None) -> Array:
        """Validates state and step of a run; returns `dt` [s] in the system's dtype."""
        check_system_state(self, state)
        if not is_traced(self, state):
            check_reduced(self, state)
        return as_time_step(dt, self.dtype)

    def stepper(self, state: SystemState, dt: Array) -> SystemStepper:
        """Integrator of the system at one moment, with the constants of a run."""
        return stepper_at(self, state, dt)

    def run_stepper(self, state: Any, dt: Array, first: Array | None) -> Stepper:
        """Integrator of a run from a state.

        `first` is the number of the first step since time zero. It is `None` for a
        system that neither depends on time nor has memory.
        """
        return system_stepper(self, state, dt, first)

    def with_memory(self, state: Any) -> dict[str, Any]:
        """Copy of the state with memories of effects and a record of neighbour lists.

        Initial values are added where the state has none.
        """
        return system_with_memory(self, state)

    def step_warning(self, dt: Array, state: Any) -> tuple[str | None, bool]:
        """Warning if the step `dt` is above the stability bound; `None` below it.

        The second entry, whether compression could make the step unstable later, is
        always `False`: the bound is that of unstressed shapes.
        """
        return unstable_step(self, dt), False

    def stable_step(self, safety: ArrayLike, *, state: Any = None) -> StableSystemStep:
        """Largest stable step times the factor `safety`, and what limits it."""
        factor = as_array("safety", safety, "", positive=True, at_most=1)
        if state is None:
            check_single(self)
            return stable_system_dt(self, factor)
        check_system_state(self, state)
        self.check_moment()
        for name, member in self.interfaces().items():
            if not member.method.explicit:
                raise ValueError(
                    f"state must be None, as member {name!r} has implicit steps: its "
                    "step is measured for explicit members alone"
                )
        return measured_system_dt(self, state, factor)

    def health(
        self,
        state: Any,
        dt: TimeStep,
        *,
        limits: HealthLimits | None = None,
        energy_before: ArrayLike | None = None,
        work_input: ArrayLike = 0.0,
        n_steps: ArrayLike = 1000,
        before: Any = None,
    ) -> SystemHealth:
        """Flags of numerical faults in a state, and the values behind them."""
        check_system_state(self, state)
        if before is not None:
            check_system_state(self, before)
        self.check_moment()
        step = as_time_step(dt, self.dtype)
        if not is_traced(n_steps):
            check_array("n_steps", n_steps, [()], "", positive=True)
        return system_health(
            self, state, step, limits, energy_before, work_input, n_steps, before
        )

    def reactions(self, state: Any) -> SystemReactions:
        """Result of `jaxrod.reactions`: loads of all supports and couplings."""
        self._check_statics(state)
        return system_reactions(self, state)

    def equilibrium(
        self,
        state: Any,
        *,
        tolerance: ArrayLike | None = None,
        max_iterations: int = 400,
    ) -> Equilibrium:
        """Searches for a state in which all loads balance; see `jaxrod.equilibrium`."""
        self._check_statics(state)
        bound, most = search_limits(tolerance, max_iterations, self.dtype)
        return system_equilibrium(
            self.recalling(state), self.with_memory(state), bound, most
        )

    def squared_frequencies(self, state: Any) -> np.ndarray:
        """Squares of all angular frequencies about a state at rest [rad^2/s^2]."""
        self._check_statics(state)
        return squared_frequencies(self.recalling(state).without_slip, state)

    def _check_statics(self, state: Any) -> None:
        check_system_state(self, state)
        self.check_moment()
        for name, member in self.interfaces().items():
            member.check_statics(name)

    def check_moment(self) -> None:
        """Raises a `ValueError` if the system depends on time."""
        if self.depends_on_time:
            raise ValueError(
                "this is defined at one moment, but an effect or a coupling has a "
                "schedule: give system.at(time)"
            )

    def kinetic_energy(self, state: Any) -> Float[Array, ""]:
        """Kinetic energy of all members [J].

        Example:
            >>> pair = jaxrod.make_system({"a": scene, "b": scene})
            >>> moving = replace(state, velocities=2.0 * jnp.ones((3, 11)))
            >>> states = {"a": moving, "b": state}
            >>> round(float(pair.kinetic_energy(states)), 3)
            7.54
        """
        check_system_state(self, state)
        return system_kinetic_energy(self, state)

    def potential_energy(self, state: Any) -> Float[Array, ""]:
        """Potential energy of all members and couplings [J]."""
        check_system_state(self, state)
        self.check_moment()
        return system_potential_energy(self, state)

    def momentum(self, state: Any) -> Float[Array, "3"]:
        """Total linear momentum of all members, world frame [kg m/s].

        Example:
            >>> pair = jaxrod.make_system({"a": scene, "b": scene})
            >>> moving = replace(state, velocities=jnp.ones((3, 11)))
            >>> print(pair.momentum({"a": moving, "b": moving}).round(3))
            [2.513 2.513 2.513]
        """
        check_system_state(self, state)
        return system_momentum(self, state)

    def angular_momentum(self, state: Any) -> Float[Array, "3"]:
        """Total angular momentum about the origin, world frame [kg m^2/s]."""
        check_system_state(self, state)
        return system_angular_momentum(self, state)


@knows_constants
def make_system(
    members: Mapping[str, Any],
    *couplings: Coupling | Sequence[Coupling],
    state: SystemState | None = None,
) -> System:
    """Builds a system of rods and rigid bodies.

    Args:
        members: Members by name: scenes, `RigidBodies`, and members of your own. A
            scene is a rod and its effects, or equal rods if every number has a leading
            axis, as from `jax.vmap`.
        *couplings: Couplings, or sequences of them, as returned by `tie`, `weld`,
            `attach`, `hinge_joint` and others.
        state: A state of the system. If it is given, couplings are checked against the
            nodes that supports hold in it, and neighbour lists are sized for it.

    Raises:
        ValueError: If a coupling does not fit the members, dtypes differ, a member's
            method has no steps in a system, an effect does not act on rigid bodies, or
            a member's state is missing or of another size.
        TypeError: If a member or a coupling is of the wrong type, or, given a state, if
            a hook of a coupling of your own needs the value of a traced number.

    Example:
        >>> states = {"left": state, "right": state}
        >>> tips = systems.tie(("left", "tip"), ("right", "tip"), states)
        >>> scenes = {"left": scene, "right": scene}
        >>> system = jaxrod.make_system(scenes, tips, state=states)
        >>> sorted(system.members), len(system.couplings)
        (['left', 'right'], 1)
    """
    if not isinstance(members, Mapping) or not members:
        raise TypeError("members must be a dict of at least one scene or rigid body")
    asked = {name: _member(name, given) for name, given in members.items()}
    listed = list(_flat(couplings))
    ties = [coupling for coupling in listed if coupling.tied_pairs]
    others = [coupling for coupling in listed if not coupling.tied_pairs]
    # Ties come last, so that no other coupling changes velocities after them.
    ordered = (*others, ties[0].merged(ties[1:])) if ties else tuple(others)
    kept = {name: member.in_own_type(name) for name, member in asked.items()}
    system = System(kept, ordered)
    types = {name: member.dtype for name, member in asked.items()}
    if len(set(types.values())) > 1:
        raise ValueError(
            "members must all be of one type, got "
            + ", ".join(f"{name!r}: {dtype}" for name, dtype in types.items())
        )
    if state is not None:
        _check_sizes(system, state)
    # One compiled program. Under tracing `jit` would hide the numbers that are known.
    look = _parts_at if is_traced(system, state) else jax.jit(_parts_at)
    parts = look(system, state)
    for coupling in ordered:
        coupling.check(parts)
    _check_masses(ordered, parts)
    adjacent = (pair for c in ordered for pair in c.adjacent_pairs(parts))
    tied = tuple(dict.fromkeys(adjacent))  # a tie and a hinge may join the same nodes
    free = _free_ends(parts, ordered, system.dtype)
    known = {
        name: member.with_free_ends(free[name])
        for name, member in system.interfaces().items()
        if name in free
    }
    system = replace(system, members=kept | known)
    fitted = tuple(
        coupling.fitted(parts, tied).with_free_ends(free) for coupling in ordered
    )
    if any(coupling.lacks_numbers for coupling in fitted):
        fitted = _with_numbers(system, fitted, parts)
    if any(coupling.refresh_every is not None for coupling in fitted):
        fitted = _sized(system, fitted, state)
    typed = tuple(in_type(system.dtype, type(c).__name__, c) for c in fitted)
    _check_followers(ordered)
    made = replace(system, couplings=typed, shapes=member_shapes(system.members))
    if state is not None and not is_traced(made, state):
        _check_own_hooks(made, state)
        check_reduced(made, state)
    return made


def _check_own_hooks(system: System, state: SystemState) -> None:
    """Traces hooks of couplings that a user wrote, to find those that read values.

    All other errors are left to the functions that need the hook.

    Raises:
        TypeError: If a hook needs the value of a traced number.
    """
    own = [k for k, coupling in enumerate(system.couplings) if is_own(coupling)]
    for hook in ("loads", "energy", "constrain", "constrain_rates"):
        for k in own:
            coupling = system.couplings[k]
            if getattr(type(coupling), hook) is getattr(Coupling, hook):
                continue

            def called(system: System, state: Any, k: int = k, hook: str = hook) -> Any:
                seen, prepared = seen_at_rest(system, state)
                return getattr(prepared[k], hook)(seen)

            try:
                jax.eval_shape(called, system, state)
            except jax.errors.JAXTypeError:
                with called_hook(coupling, hook):
                    raise
            except Exception:
                continue


def _check_masses(couplings: Sequence[Coupling], parts: AllParts) -> None:
    """Raises ValueError if a joint shares impulses of rods with coupled masses."""
    coupled = [k for k, own in parts.items() if own.mass_matrix == "higher_order"]
    if not coupled:
        return
    for coupling in couplings:
        joined = {name for name, _ in coupling.joined_nodes()}
        held = [name for name in coupled if not joined or name in joined]
        if coupling.is_exact and held:
            raise ValueError(
                f"{type(coupling).__name__} holds nodes exactly, by impulses in "
                f"proportion to the masses of single nodes, but those of member "
                f'{held[0]!r} are coupled by mass_matrix="higher_order": give its rod '
                'mass_matrix="lumped", or join it by springs'
            )


def _check_sizes(system: System, state: Any) -> None:
    """Raises unless every member has its state; states of others are not looked at."""
    if not isinstance(state, Mapping):
        raise TypeError(
            "state must be a dict of the states of all members by name, got "
            f"{type(state).__name__}"
        )
    missing = sorted(set(system.members) - set(state))
    if missing:
        raise ValueError(
            f"state must have the members {sorted(system.members)}, got "
            f"{sorted(state)}: add the state of {missing[0]!r}"
        )
    for name, member in system.interfaces().items():
        member.check_state(name, state[name], system.dtype)


def _parts_at(system: System, state: SystemState | None) -> AllParts:
    """Constants of all members; given a state, with flags of nodes held by supports."""
    return system.parts() if state is None else held_parts(system, state)


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
                + advice_for(coupling, "coupling")
            )


def _member(name: Any, given: Any) -> Member:
    """Converts an entry of `members` to a `Member`, and checks it."""
    if not isinstance(name, str):
        raise TypeError(f"names of members must be strings, got {name!r}")
    as_member = getattr(given, "as_member", None)
    if as_member is None:
        raise TypeError(
            f"member {name!r} must be a scene (jaxrod.make_scene), a rigid body or a "
            f"Member, got {type(given).__name__}"
            + (
                " (factories return a pair: the member, and its state)"
                if isinstance(given, tuple)
                else ""
            )
        )
    member: Member = as_member()
    member.check(name)
    return member


def _free_ends(
    parts: AllParts, couplings: Sequence[Coupling], dtype: Any
) -> dict[str, Array]:
    """Flags `(rods, 2)` of the two ends of each member's rods, by name of the member.

    They are 1 for a free end, and 0 for an end that is tied or attached.
    """
    free = {name: np.ones((own.count, 2)) for name, own in parts.items() if own.is_rod}
    for name, node in {key for c in couplings for key in c.joined_nodes()}:
        if name in free:
            last = parts[name].n_elements
            rod, place = divmod(node, last + 1)
            if place in (0, last):
                free[name][rod, int(place == last)] = 0.0
    return {name: jnp.asarray(flags, dtype) for name, flags in free.items()}


@compiled
def _with_numbers(
    system: System, couplings: tuple[Coupling, ...], parts: AllParts
) -> tuple[Coupling, ...]:
    """Couplings with the numbers that they lack, from the step that others allow."""
    # Compiled, because the bounds of contact take a hundred operations.
    others = tuple(
        in_type(system.dtype, type(c).__name__, c)
        for c in couplings
        if not c.lacks_numbers
    )
    step = stable_system_dt(replace(system, couplings=others), 1.0).dt
    return tuple(
        c.with_numbers(parts, step) if c.lacks_numbers else c for c in couplings
    )


def _sized(
    system: System, couplings: tuple[Coupling, ...], state: SystemState | None
) -> tuple[Coupling, ...]:
    """Couplings whose neighbour lists are sized by counting neighbours in a state.

    Without a state, all lists must have sizes already.
    """
    if RECORD in system.members:
        raise ValueError(
            f"no member can be called {RECORD!r}: this is the name of the record of "
            "lists in a state"
        )
    if state is None:
        sizes = [c for c in couplings if c.refresh_every is not None and not c.is_sized]
        if sizes:
            raise ValueError(
                "lists of neighbours need pairs, candidates and cell_slots from "
                "neighbour_lists, or make_system a state in which to count them"
            )
        return couplings
    listed = tuple(c for c in couplings if c.refresh_every is not None)
    known = not is_traced(system, listed, state)
    seen, prepared = (jax.jit(_prepared) if known else _prepared)(system, listed, state)
    ready: Any = iter(prepared)
    # mypy does not know that a coupling with lists is a dataclass.
    return tuple(
        c
        if c.refresh_every is None
        else replace(c, lists=next(ready).sized(seen).lists)  # type: ignore[type-var]
        for c in couplings
    )


def _prepared(
    system: System, couplings: tuple[Coupling, ...], state: SystemState
) -> tuple[Any, tuple[Coupling, ...]]:
    """Motion of all members, and couplings that are ready to search for neighbours."""
    # Without the system's own couplings, whose neighbours have not been searched yet.
    seen, _ = seen_at_rest(replace(system, couplings=()).at(0.0), state)
    parts = system.parts()
    return seen, tuple(coupling.prepared(parts) for coupling in couplings)


def _check_followers(couplings: Sequence[Coupling]) -> None:
    """Raises a ValueError if a node is attached twice, or both attached and tied."""
    followers: dict[tuple[str, int], str] = {}
    for coupling in couplings:
        followed = coupling.followed
        if followed is None:
            continue
        for key in coupling.joined_nodes():
            if key in followers:
                raise ValueError(
                    f"node {key[1]} of {key[0]!r} is attached to {followers[key]!r} "
                    f"and to {followed!r}: it can follow one body only"
                )
            followers[key] = followed
    for coupling in couplings:
        for member, node, _, _ in coupling.tied_pairs:
            if (member, node) in followers:
                raise ValueError(
                    f"node {node} of {member!r} is tied and attached to "
                    f"{followers[member, node]!r}: attach all tied nodes to the body "
                    "instead"
                )


@jax.jit
def system_kinetic_energy(system: Assembly, state: SystemState) -> Float[Array, ""]:
    """Kinetic energy of all members [J]."""
    members = system.interfaces()
    return _total(member.kinetic_energy(state[k]) for k, member in members.items())


@jax.jit
def system_potential_energy(system: Assembly, state: SystemState) -> Float[Array, ""]:
    """Elastic energy plus potential energies of effects and couplings [J]."""
    members = system.interfaces()
    total = _total(member.potential_energy(state[k]) for k, member in members.items())
    if not system.couplings:
        return total
    # A kernel, because XLA takes many seconds to compile contact with lists.
    return total + by_kernel(CouplingEnergy(system), "energy", state)


@jax.jit
def system_momentum(system: Assembly, state: SystemState) -> Float[Array, "3"]:
    """Total linear momentum of all members, world frame [kg m/s]."""
    members = system.interfaces()
    return _total(member.momentum(state[k]) for k, member in members.items())


@jax.jit
def system_angular_momentum(system: Assembly, state: SystemState) -> Float[Array, "3"]:
    """Total angular momentum about the origin, world frame [kg m^2/s]."""
    members = system.interfaces()
    return _total(member.angular_momentum(state[k]) for k, member in members.items())


def _total(values: Any) -> Any:
    total = None
    for value in values:
        total = value if total is None else total + value
    return total
