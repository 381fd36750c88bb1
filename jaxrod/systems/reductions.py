r"""Demands of members that leave something out: all that couples them must let them.

A planar member needs its whole neighbourhood in the plane: every member that couplings
join to it, at one height, and no load that leaves the plane. The system is then
symmetric by reflection in the plane, and stays so. A member without twist needs
couplings that neither turn with its elements nor twist them. Loads are tested
numerically, at displaced configurations in which most couplings act.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.effects.directions import frame_along
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, multiply_quaternions, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.systems.coupling import AllSeen, Coupling, Parts, Seen
from jaxrod.systems.stepping.assembly import Assembly, SystemState, seen_at_rest

SHIFTS = 6
"""Number of displaced configurations in which the loads of couplings are tested."""
STILL = 1e-6
"""Velocities that count as round-off, divided by the wave speed of rods [1]."""
DISPLACED = 0.1
"""Displacements of nodes that strain couplings, divided by the shortest element [1]."""
SHORT_ARM = 1e-4
"""Lever arms that count as round-off, divided by the shortest element [1]."""
_HURRIED = {"xla_backend_optimization_level": 0}
"""Options of programs that take longer to optimise than to run."""


def check_reduced(system: Assembly, state: SystemState) -> None:
    """Checks that all members can leave out what their methods leave out.

    The values of the system and of the state are known, not traced.

    Raises:
        ValueError: If something moves a planar member out of its plane, or twists a
            member without twist.
    """
    members = system.interfaces().values()
    if any(not member.method.twist for member in members):
        check_untwisted(system, state)
    if any(member.method.normal_axis is not None for member in members):
        check_in_plane(system, state)


def check_untwisted(system: Assembly, state: SystemState) -> None:
    """Checks that no coupling twists a member without twist.

    Raises:
        ValueError: If a coupling has loads on such a member that turn with its elements
            or have couples about their axes.
    """
    bare = {name: state[name] for name in system.members}
    shares = jax.device_get(_twisting_shares(system.at_largest, bare))
    for (name, number), (turning, about) in shares.items():
        coupling = system.couplings[number]
        tolerance = np.sqrt(np.finfo(turning.dtype).eps)
        found = coupling.twists
        if found is None and not about <= tolerance:
            found = "couples about the axes of its elements"
        if found is None and not turning <= tolerance:
            found = "loads that turn with its elements"
        if found is not None:
            raise ValueError(
                f"member {name!r} has no twist, and {type(coupling).__name__} acts on "
                f"it with {found}: use a method with twist for it"
            )


def check_in_plane(system: Assembly, state: SystemState) -> None:
    """Checks that all that is coupled to planar members stays in their plane.

    The values of the system and of the state are known, not traced.

    Raises:
        ValueError: If a planar member, its neighbours or their loads leave the plane.
    """
    members = system.interfaces()
    bare = {name: state[name] for name in system.members}
    shares = jax.device_get(_shares_outside(system.at(0.0), bare))
    for name, other in dict.fromkeys((name, other) for name, other, _ in shares):
        members[other].check_for(members[name].method, other, state[other])
    # First what the members are, then "forces of" and "couples of".
    for name, other, what in sorted(shares, key=lambda key: " of " in key[2]):
        share = shares[name, other, what]
        if not share <= np.sqrt(np.finfo(share.dtype).eps):
            raise ValueError(
                f"member {name!r} moves in a plane and needs {what} of {other!r} in "
                f"it, got {share:.2g} of their size out of it: leave out planar(...) "
                "for a motion in space"
            )


def _members_of(coupling: Coupling, seen: AllSeen) -> set[str]:
    """Names of the members that a prepared coupling loads or moves."""
    found: set[str] = set()

    def look(coupling: Any) -> None:
        loads, placed = _acting(coupling, seen).loads(seen), coupling.constrain(seen)
        found.update(loads, placed, coupling.exchange(seen, seen))

    jax.eval_shape(look, coupling)
    return found


def _acting(coupling: Coupling, seen: AllSeen) -> Any:
    """Copy of a coupling with the neighbours that it finds, if it searches any."""
    ready: Any = coupling
    if ready.refresh_every is None:
        return ready
    return replace(ready, found=ready.search(seen))


def _neighbourhoods(
    system: Assembly, couplings: Iterable[Coupling], seen: AllSeen
) -> dict[str, tuple[list[str], int]]:
    """Members that couplings join, directly or not, and the normal of their plane.

    There is an entry for each group that has a planar member, by the first one's name.

    Raises:
        ValueError: If planes differ.
    """
    members = system.interfaces()
    groups = [{name} for name in members]
    for coupling in couplings:
        joined = _members_of(coupling, seen)
        touched = [group for group in groups if group & joined]
        groups = [group for group in groups if not group & joined]
        groups.append(set().union(*touched))
    found = {}
    for group in map(sorted, groups):
        planes = {name: members[name].method.normal_axis for name in group}
        flat = {name: axis for name, axis in planes.items() if axis is not None}
        if len(set(flat.values())) > 1:
            raise ValueError(
                f"coupled members must move in one plane, got {' and '.join(flat)} in "
                "different ones: leave out planar(...) for them"
            )
        for name, axis in list(flat.items())[:1]:
            found[name] = group, axis
    return found


@functools.partial(jax.jit, compiler_options=_HURRIED)
def _twisting_shares(
    system: Assembly, state: SystemState
) -> dict[tuple[str, int], tuple[Array, Array]]:
    """Fractions of loads on members without twist that turn with them or twist them.

    They are listed by the name of the member and the number of the coupling. Nodes are
    where they are in the state; elements have irregular directions, and all have
    irregular rates. Nodes are displaced for the former fraction.
    """
    given, couplings = seen_at_rest(system, state)
    seen, apart = (
        {
            name: _stirred(own, number, share)
            for number, (name, own) in enumerate(sorted(given.items()))
        }
        for share in (0.0, DISPLACED)
    )
    found = {}
    for name, member in system.interfaces().items():
        if member.method.twist:
            continue
        for number, coupling in enumerate(couplings):
            if name not in _members_of(coupling, seen):
                continue
            none = jnp.zeros((), system.dtype)
            # Of contact only friction twists, which `twists` declares.
            found[name, number] = (
                (none, none)
                if coupling.is_contact
                else (_turning(coupling, apart, name), _about(coupling, seen, name))
            )
    return found


def _turning(coupling: Coupling, seen: AllSeen, name: str) -> Array:
    """Fraction of loads that changes if elements of a member turn about their axes."""
    motion = seen[name].motion
    k = jnp.arange(motion.spin[0].size, dtype=motion.spin[0].dtype)
    zero = jnp.zeros_like(k)
    turn = (jnp.cos(k + 0.4), zero, zero, jnp.sin(k + 0.4))
    orientation = multiply_quaternions(motion.orientation, turn)
    own = replace(seen[name], motion=replace(motion, orientation=orientation))
    after = {**seen, name: own}
    share = jnp.zeros_like(k[0])
    others = coupling.loads(after)
    for key, loads in coupling.loads(seen).items():
        pairs = [(loads.forces, others[key].forces)]
        if key != name:
            pairs.append(
                (_in_world(seen[key], loads), _in_world(after[key], others[key]))
            )
        for before, then in pairs:
            if before is not None and then is not None:
                change = vectors.join(vectors.subtract(then, before))
                share = jnp.maximum(share, _share(change, before))
    return share


def _about(coupling: Coupling, seen: AllSeen, name: str) -> Array:
    """Fraction of the couples on a member that acts about the axes of its elements."""
    loads, own = coupling.loads(seen).get(name, Loads()), seen[name]
    couples = _in_world(own, loads)
    if couples is None:
        return jnp.zeros_like(own.motion.spin[0][0])
    least: Array | float = 0.0
    if loads.forces is not None and own.parts.rest_lengths is not None:
        # The round-off of lever arms.
        whole = jnp.max(jnp.abs(vectors.join(loads.forces)))
        least = SHORT_ARM * whole * jnp.min(own.parts.rest_lengths)
    along = vectors.dot(directors(own.motion.orientation)[2], couples)
    return _share(along, couples, least)


def _stirred(own: Seen, number: int, share: float) -> Seen:
    """A member with irregular directions and rates, different for every number.

    Nodes of rods are displaced by a `share` of the shortest element, and bodies too.
    """
    motion, parts = own.motion, own.parts

    def field(size: int, shift: float) -> Vec3:
        k = jnp.arange(size, dtype=motion.spin[0].dtype) + 2.3 * number + shift
        return jnp.cos(1.1 * k + 0.3), jnp.sin(1.7 * k + 0.7), jnp.cos(0.6 * k - 0.5)

    n = parts.inertias.shape[1]
    d3 = field(n, 0.4)
    lengths = parts.rest_lengths
    size = share if lengths is None else share * jnp.min(lengths)
    stirred = replace(
        motion,
        position=vectors.add(
            motion.position, vectors.scale(size, field(parts.n_nodes, 0.2))
        ),
        orientation=frame_along(vectors.scale(1 / vectors.safe_norm(d3), d3)),
        velocity=field(parts.n_nodes, 0.9),
        spin=vectors.scale(parts.inertias[0], field(n, 1.3)),
        spin_is_velocity=False,
    )
    return replace(own, motion=stirred)


Shares = dict[tuple[str, str, str], Array]
"""Fractions by the name of a planar member, that of a member joined to it, and words.
"""


@functools.partial(jax.jit, compiler_options=_HURRIED)
def _shares_outside(system: Assembly, state: SystemState) -> Shares:
    """Out-of-plane fractions of members that are joined to planar ones, and of loads.

    The system has no schedules.
    """
    seen, couplings = seen_at_rest(system, state)
    shares: Shares = {}
    for name, (joined, axis) in _neighbourhoods(system, couplings, seen).items():
        own = {other: seen[other] for other in joined}
        for (other, what), share in _shares_of_states(own, name, axis).items():
            shares[name, other, what] = share
        for other in joined:
            if seen[other].parts.is_rod:
                continue  # Effects on rods are checked with their scenes.
            for effect in system.interfaces()[other].effects:
                acting = effect.loads(system.members[other], seen[other].motion).forces
                if acting is not None:
                    what = f"forces of {type(effect).__name__}"
                    shares[name, other, what] = _share(acting[axis], acting)

        def loads(number: Array, own: Any = own, axis: int = axis) -> Any:
            shifted = {**seen, **_shifted(own, axis, number)}
            return _sizes_of_loads(couplings, shifted, axis)

        sizes = jax.lax.map(loads, jnp.arange(SHIFTS))
        for (other, what), (part, whole) in sizes.items():
            if other in joined:
                whole = jnp.max(whole)
                whole = jnp.where(whole > 0, whole, 1)
                shares[name, other, what] = jnp.max(part) / whole
    return shares


def _shares_of_states(
    seen: Mapping[str, Seen], planar: str, axis: int
) -> dict[tuple[str, str], Array]:
    """Out-of-plane fractions of positions, rates and inertia, by member and words.

    The plane is at the height of the first node of the member `planar`, across the
    world axis `axis`.
    """
    a, b = (k for k in range(3) if k != axis)
    spans = [c for own in seen.values() for c in own.motion.position]
    size = jnp.max(jnp.stack([jnp.max(c) - jnp.min(c) for c in spans]))
    middle = seen[planar].motion.position[axis][0]
    still = STILL * _wave_speed([own.parts for own in seen.values()])
    found: dict[tuple[str, str], Array] = {}
    for name, own in seen.items():
        motion, height = own.motion, own.motion.position[axis]
        least = jnp.maximum(size, jnp.max(jnp.abs(height)))
        found[name, "node positions"] = jnp.max(jnp.abs(height - middle)) / least
        moving = motion.velocity
        found[name, "velocities"] = _share(moving[axis], moving, still)
        x, y, z = (jnp.full_like(motion.spin[0], k == axis) for k in range(3))
        about = replace(motion, spin=(x, y, z), spin_is_velocity=False)
        turning = replace(own, motion=about).angular_velocities
        outside = jnp.stack([turning[a], turning[b]])
        found[name, "rotary inertia"] = _share(outside, turning)
        rates = own.angular_velocities
        outside = jnp.stack([rates[a], rates[b]])
        found[name, "angular velocities"] = _share(outside, rates, still / size)
    return found


def _sizes_of_loads(
    couplings: tuple[Coupling, ...], seen: AllSeen, axis: int
) -> dict[tuple[str, str], tuple[Array, Array]]:
    """Largest out-of-plane component, and largest component, of loads of couplings.

    They are listed by member and words.
    """
    a, b = (k for k in range(3) if k != axis)
    found: dict[tuple[str, str], tuple[Array, Array]] = {}
    for coupling in couplings:
        if coupling.is_symmetric:
            continue
        for name, loads in _acting(coupling, seen).loads(seen).items():
            couples = _in_world(seen[name], loads)
            for what, vector, outside in (
                ("forces", loads.forces, (axis,)),
                ("couples", couples, (a, b)),
            ):
                if vector is None:
                    continue
                whole = jnp.max(jnp.abs(vectors.join(vector)))
                part = jnp.max(jnp.abs(jnp.stack([vector[k] for k in outside])))
                key = name, f"{what} of {type(coupling).__name__}"
                before = found.get(key, (part, whole))
                found[key] = (
                    jnp.maximum(before[0], part),
                    jnp.maximum(before[1], whole),
                )
    return found


def _shifted(seen: Mapping[str, Seen], axis: int, number: Array) -> dict[str, Seen]:
    """Members moved in the plane as a whole, to lie on the first one or beside it.

    The middle of each is near a node of the first member, another one for every
    `number` below `SHIFTS`. `axis` is the world axis along the normal.
    """
    names = list(seen)
    first = seen[names[0]].motion.position
    size = jnp.max(jnp.stack([jnp.max(c) - jnp.min(c) for c in first]))
    node = number * (len(first[0]) - 1) // (SHIFTS - 1)
    there = jnp.arange(len(first[0])) == node
    moved = {}
    for place, name in enumerate(names):
        motion = seen[name].motion
        position = list(motion.position)
        for k in range(3):
            if k == axis or place == 0:
                continue
            beside = 0.02 * size * (1 + number)
            beside = beside * jnp.cos(1.3 * number + 1.9 * place + k)
            target = jnp.sum(jnp.where(there, first[k], 0))
            moving = target - jnp.mean(position[k]) + beside
            position[k] = position[k] + moving.astype(position[k].dtype)
        x, y, z = position
        moved[name] = replace(seen[name], motion=replace(motion, position=(x, y, z)))
    return moved


def _in_world(seen: Seen, loads: Loads) -> Vec3 | None:
    """Couples in the world frame, of loads whose couples are in material frames."""
    if loads.couples is None:
        return None
    return to_world(directors(seen.motion.orientation), loads.couples)


def _share(part: Array, whole: Vec3, least: ArrayLike = 0.0) -> Float[Array, ""]:
    """Largest entry of `part`, divided by the largest of `whole` or by `least` [1]."""
    size = jnp.maximum(jnp.max(jnp.abs(vectors.join(whole))), least)
    return jnp.max(jnp.abs(part)) / jnp.where(size > 0, size, 1)


def _wave_speed(parts: list[Parts]) -> Array:
    """Largest speed of stretching waves in round rods of these members [m/s]."""
    squares = [
        jnp.max(4 * own.bend_twist_stiffness[0] / own.radii**2 / own.linear_density)
        for own in parts
        if own.bend_twist_stiffness is not None
        and own.radii is not None
        and own.linear_density is not None
    ]
    return jnp.sqrt(jnp.max(jnp.stack(squares)))
