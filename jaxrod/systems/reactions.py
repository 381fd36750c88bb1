r"""Reactions in a system: what supports and couplings exert, and members cut free.

Supports, ties and attachments do not allow every acceleration. Without ties each node
of mass $m_i$ would have an acceleration $a_i$. Tied nodes have one, $a$, and the tie
exerts $m_i (a - a_i)$ on each of them. A tied node that a support holds takes up what
is left, so that the forces of the tie add up to zero, and the support bears the sum. A
body and the nodes attached to it move as one rigid body; the attachment exerts the same
difference on each node, and its opposite, with its couple, on the body.

A member cut free is its scene with all these loads as one more effect. Whatever is
defined for the scene of one rod, such as reactions and sensors, then takes them into
account.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Reaction
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_world
from jaxrod.rods.motion import Loads, Motion, added
from jaxrod.rods.rod import Layout
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import AllSeen, Coupling, Seen, check_named
from jaxrod.systems.joints.places import resolved
from jaxrod.systems.stepping.assembly import Assembly, SystemState, seen_at_rest
from jaxrod.systems.stepping.runs import check_system_state
from jaxrod.validation import check_kind


@pytree
class MemberLoads:
    """Loads on all nodes and elements of a member, of which equal rods are a row."""

    forces: Float[Array, "3 nodes"]
    """Forces on nodes or bodies, world frame [N]."""
    couples: Float[Array, "3 elements"]
    """Couples on elements or bodies, world frame [N m]."""


@pytree
class SystemReactions:
    """Loads of the supports and couplings of a system at one moment.

    Example:
        >>> right = replace(state, positions=state.positions.at[0].add(1.0))
        >>> states = {"left": state, "right": right}  # end to end
        >>> joint = systems.weld(("left", "tip"), ("right", "base"), states)
        >>> members = {"left": scene, "right": jaxrod.make_scene(rod)}
        >>> found = jaxrod.reactions(jaxrod.make_system(members, joint), states)
        >>> on_left, on_right = found.on("left", "tip"), found.on("right", "base")
        >>> print((on_left.force + on_right.force).round(6) + 0.0)  # opposite [N]
        [0. 0. 0.]
    """

    supports: dict[str, tuple[Reaction | None, ...]]
    """For each rod, the reaction of each of its effects; `None` for effects that hold
    nothing. Reactions of equal rods have a leading axis."""
    couplings: tuple[dict[str, MemberLoads], ...]
    """Loads of each coupling on the members that it joins, in the order of
    `System.couplings`; of ties and attachments those that keep the nodes together."""
    layouts: tuple[tuple[str, Layout], ...] = static(default=())
    """Numbers of rods and elements of each member, by name."""

    def on(self, *place: Any) -> Reaction:
        """Force and couple of all couplings on a node and its element.

        Args:
            *place: A place, such as `"arm", "tip"`, or `"arms", 2, 7`, or `"ball"`.

        Raises:
            ValueError: If there is no such place.
        """
        member, node, element = resolved("place", place, dict(self.layouts))
        force = couple = jnp.zeros(3)
        for loads in self.couplings:
            if member in loads:
                force = force + loads[member].forces[:, node]
                couple = couple + loads[member].couples[:, element]
        return Reaction(force, couple, jnp.zeros_like(force[0]))

    @property
    def force(self) -> Float[Array, "3"]:
        """Sum of the forces of all supports and couplings, world frame [N].

        Forces between members cancel in it. It is the force from outside, except for
        that of gravity, fluids and fixed bodies that touch rods.
        """
        held = [one for own in self.supports.values() for one in own if one is not None]
        loads = [own.forces for each in self.couplings for own in each.values()]
        parts = [one.force.reshape(-1, 3).sum(axis=0) for one in held]
        parts += [jnp.sum(forces, axis=1) for forces in loads]
        return sum(parts, jnp.zeros(3))


def system_reactions(system: Assembly, state: SystemState) -> SystemReactions:
    """Reactions of supports and couplings; the caller has checked the arguments."""
    layouts = tuple((name, state[name].layout) for name in system.members)
    return replace(_reactions(system, state), layouts=layouts)


@jax.jit
def _reactions(system: Assembly, state: SystemState) -> SystemReactions:
    system = system.recalling(state)
    seen, each = coupling_loads(system, state)
    total = _total(seen, each)
    supports = {
        name: member.reactions(state[name], total[name])
        for name, member in system.interfaces().items()
    }
    return SystemReactions(
        supports,
        tuple({k: _in_world(seen[k], own) for k, own in one.items()} for one in each),
    )


def coupling_loads(
    system: Assembly, state: SystemState
) -> tuple[dict[str, Seen], list[dict[str, Loads]]]:
    """Loads of every coupling, with those that keep tied and attached nodes together.

    Returns:
        The members as couplings see them; and for each coupling, by name of the member,
        forces on nodes (world frame) and couples on elements (material frame).
    """
    seen, prepared = seen_at_rest(system, state)
    each = [coupling.loads(seen) for coupling in prepared]
    if not any(list(coupling.joined_nodes()) for coupling in prepared):
        return seen, each
    total = _total(seen, each)
    members = system.interfaces()
    free = {
        name: replace(seen[name].motion, velocity=rates.velocity, spin=rates.spin)
        for name, rates in (
            (name, members[name].rates_of_change(state[name], total[name]))
            for name in seen
        )
        if rates is not None
    }
    free |= _bodies_rates(system, state, seen, prepared, total, free)
    for number, coupling in enumerate(prepared):
        for name, loads in coupling.constraint_loads(seen, free).items():
            each[number][name] = added(each[number].get(name, Loads()), loads)
    return seen, each


def _total(seen: AllSeen, each: Sequence[Mapping[str, Loads]]) -> dict[str, Loads]:
    """Sum of the loads on each member, with zeros where there are none."""
    found = {}
    for name, own in seen.items():
        x, a = own.motion.position[0], own.motion.orientation[0]
        none = Loads((0 * x, 0 * x, 0 * x), (0 * a, 0 * a, 0 * a))
        for loads in each:
            none = added(none, loads.get(name, Loads()))
        found[name] = none
    return found


def _bodies_rates(
    system: Assembly,
    state: SystemState,
    seen: AllSeen,
    prepared: Sequence[Coupling],
    total: Mapping[str, Loads],
    free: Mapping[str, Motion],
) -> dict[str, Motion]:
    """Accelerations and angular accelerations of bodies that carry nodes of rods.

    Args:
        system: The system.
        state: Its state.
        seen: Its members, as couplings see them.
        prepared: Its couplings.
        total: Loads of all couplings on each member, but those of attachments.
        free: Accelerations that all nodes would have if they were not attached.
    """
    members = system.interfaces()
    found = {}
    for name in {c.followed for c in prepared if c.followed is not None}:
        mine = [coupling for coupling in prepared if coupling.followed == name]
        parts = {k: other.parts for k, other in seen.items()}
        carried = [coupling.carried(parts)[name] for coupling in mine]
        together = functools.reduce(lambda a, b: jax.tree.map(jnp.add, a, b), carried)
        own, couples = seen[name], total[name].couples
        assert couples is not None
        turn = to_world(directors(own.motion.orientation), couples)
        push = Loads(total[name].forces, turn)
        for coupling in mine:
            # The impulse that nodes at rest would pass on, per time.
            still = {k: _with_rates(s, None) for k, s in seen.items()}
            moving = {k: _with_rates(s, free.get(k)) for k, s in seen.items()}
            push = added(push, coupling.exchange(still, moving)[name])
        one = jnp.ones((), system.dtype)
        # Only rigid bodies are followed, and their stepper has this method.
        stepper: Any = members[name].stepper(state[name], own.parts, together, one)
        found[name] = stepper.rates_of_change(stepper.enter(state[name]), push)
    return found


def _with_rates(seen: Seen, rates: Motion | None) -> Seen:
    """The member at the same place with other velocities; without `rates`, zero."""
    if rates is None:
        still = vectors.scale(0.0, seen.motion.velocity)
        return replace(seen, motion=replace(seen.motion, velocity=still))
    return replace(seen, motion=replace(seen.motion, velocity=rates.velocity))


def free_body(system: Any, state: Mapping[str, Any], name: str) -> tuple[Any, Any]:
    """One rod cut free: its scene, with the loads of all couplings as one more effect.

    What is defined for the scene of one rod then holds for the member of the system:
    sensors such as `support_force` and `accelerometer` read it, and
    `jaxrod.natural_frequencies` or `jaxrod.reactions` take it. Joints, ties,
    attachments and contact count with the loads that they have at this moment; the
    loads do not change with the state, so step the system and not this scene.

    Args:
        system: The system, at one moment: `system.at(time)` if it depends on time.
        state: State of the system.
        name: Name of a rod. Equal rods give equal scenes with a leading axis, for
            `jax.vmap`.

    Returns:
        The scene and its state.

    Raises:
        TypeError: If `system` is not a system.
        ValueError: If no rod has this name, or the system depends on time.

    Example:
        >>> right = replace(state, positions=state.positions.at[0].add(1.0))
        >>> states = {"left": state, "right": right}  # end to end
        >>> joint = systems.weld(("left", "tip"), ("right", "base"), states)
        >>> members = {"left": scene, "right": jaxrod.make_scene(rod)}
        >>> system = jaxrod.make_system(members, joint)
        >>> cut = systems.free_body(system, states, "left")
        >>> wall = jaxrod.reactions(system, states).supports["left"][0]
        >>> bool(jnp.allclose(sensors.support_force().read(*cut), wall.force))
        True
    """
    check_kind("system", system, Assembly)
    check_named(name, system.members)
    system.check_moment()
    check_system_state(system, state)
    recalled = system.recalling(state)
    member = recalled.interfaces()[name]
    if member.rod is None:
        raise ValueError(f"free_body needs a rod, and {name!r} is not one")
    loads = _total(*coupling_loads(recalled, state))[name]
    return member.loaded(loads), state[name]


def _in_world(seen: Seen, loads: Loads) -> MemberLoads:
    """Loads as arrays over all nodes and elements, with couples in the world frame."""
    (x, *_), (w, *_) = seen.motion.position, seen.motion.orientation
    forces = (0 * x, 0 * x, 0 * x) if loads.forces is None else loads.forces
    couples = (0 * w, 0 * w, 0 * w) if loads.couples is None else loads.couples
    world = to_world(directors(seen.motion.orientation), couples)
    return MemberLoads(vectors.join(forces), vectors.join(world))
