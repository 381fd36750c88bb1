r"""Contact of rigid bodies with one another and with fixed bodies.

Balls on one body (`jaxrod.systems.contact.sphere_cloud`) are tested against the signed
distance of the other's surface. Every ball has the law of
`jaxrod.contacts.contact_law`, with a stiffness in N/m. If one of the two bodies is
round, testing its balls is enough. If both have edges, the corners of each are tested
against the other.

Force and reaction act at one point, midway between the two surfaces, with the
velocities of both bodies there. So momentum and angular momentum are conserved exactly,
also with damping and friction, and friction makes bodies roll.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.contacts.bodies import Body
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.collision_bodies import (
    CollisionBodies,
    CollisionPair,
    collision_bodies,
)
from jaxrod.systems.contact.penalty_contact import (
    PenaltyContact,
    check_members,
    law_numbers,
)
from jaxrod.systems.contact.sphere_cloud import spheres_needed
from jaxrod.systems.coupling import AllParts, AllSeen, TiedPair
from jaxrod.validation import Numbers, as_array, check_count, check_kind, numeric


@pytree
class RigidContact(PenaltyContact):
    """Contact among rigid bodies of some members and with fixed bodies.

    Example:
        >>> floor = shapes.plane()
        >>> contact = systems.rigid_contact("balls", fixed=floor, stiffness=1e4)
        >>> contact.members, len(contact.fixed)
        (('balls',), 1)
    """

    fixed: tuple[Body, ...] = ()
    """Fixed bodies."""
    points: dict[str, Array] | None = None
    """Contact points on the surfaces of members, by name, in the bodies' frames `(3,
    points)` [m]."""
    groups: tuple[CollisionBodies, ...] = ()
    """Members, then fixed bodies, with their balls; set by `prepared`."""
    members: tuple[str, ...] = static(default=())
    """Names of the members."""
    balls: tuple[int, ...] = static(default=())
    """Number of balls along the axis of each member and fixed body; set by `fitted`."""
    balls_per_axis: int | None = static(default=None)
    """Number of balls along each axis, if given; `None` to derive it from the shape."""
    points_per_edge: int = static(default=2)
    """Number of contact points on every edge of a box, corners included."""
    max_contacts: int | None = static(default=None)
    """Bodies that may touch one body, for the stability bound; `None` for all."""

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if members are missing, are rods or have no shape."""
        for name in self.members:
            if name not in parts:
                raise ValueError(
                    f"no member is called {name!r}; there are "
                    + ", ".join(map(repr, parts))
                )
            if parts[name].is_rod:
                raise ValueError(
                    f"rigid_contact is between rigid bodies, and {name!r} is a rod: "
                    "use body_contact"
                )
            if parts[name].shape is None:
                raise ValueError(
                    f"rigid_contact needs a surface, but {name!r} has no shape"
                )

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> RigidContact:
        """Copy with `balls` set: the numbers of balls, at which contact is detected.

        They are `balls_per_axis`, if given, and otherwise follow from the shapes.

        Raises:
            ValueError: If no bodies can meet, or contact of two bodies cannot be
                detected.
        """
        named = [(repr(name), parts[name].shape) for name in self.members]
        named += [(f"fixed[{k}]", body) for k, body in enumerate(self.fixed)]
        given = self.balls_per_axis
        balls = []
        for name, shape in named:
            assert shape is not None
            needed = 0 if given is not None else spheres_needed(name, shape)
            balls.append(needed if given is None else given)
        fitted = replace(self, balls=tuple(balls))
        groups = fitted.prepared(parts).groups
        for a, b in fitted._pairs(groups):
            if not CollisionPair.between(groups[a], groups[b], same=a == b):
                raise ValueError(
                    f"rigid_contact cannot find where {named[a][0]} and {named[b][0]} "
                    "touch: neither has known corners or round ends; give "
                    "points on the surface of one, points={name: (3, k) [m]}"
                )
        if not any(True for _ in fitted._pairs(groups)):
            raise ValueError(
                "one body has nothing to touch: name more members, or give fixed= "
                "bodies such as jaxrod.shapes.plane()"
            )
        return fitted

    def prepared(self, parts: AllParts) -> RigidContact:
        """The coupling with `groups` set: all bodies and their balls."""
        return replace(
            self,
            groups=collision_bodies(
                {name: parts[name] for name in self.members},
                self.fixed,
                self.balls,
                self.points_per_edge,
                self.points or {},
            ),
        )

    def _pairs(self, groups: Sequence[CollisionBodies]) -> Iterator[tuple[int, int]]:
        """Yields index pairs (a, b), a <= b, of groups that may touch.

        The bodies of group a move; those of group b move or are fixed.
        """
        moving = len(self.members)
        for a in range(moving):
            for b in range(a, len(groups)):
                if a != b or groups[a].count > 1:
                    yield a, b

    def _collisions(self, seen: AllSeen) -> Iterator[tuple[int, int, CollisionPair]]:
        """Contacts (a, b, pair) of the balls of group a with the surfaces of group b.

        `a` and `b` are indices into `groups`.
        """
        for a, b in self._pairs(self.groups):
            one, two = self.groups[a], self.groups[b]
            for first, _, share in CollisionPair.between(one, two, same=a == b):
                from_, to = (a, b) if first else (b, a)
                yield (
                    from_,
                    to,
                    CollisionPair.of(
                        self.groups[from_].at(seen),
                        self.groups[to].at(seen),
                        share,
                        self.onset,
                        same=a == b,
                    ),
                )

    @property
    def acts_from_outside(self) -> bool:
        """Whether there are fixed bodies."""
        return bool(self.fixed)

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Contact forces and couples on the rigid bodies of each member."""
        total: dict[int, tuple[Vec3, Vec3]] = {}
        for a, b, pair in self._collisions(seen):
            for number, own in zip((a, b), pair.loads(self._force(pair)), strict=True):
                if number in total:
                    own = (
                        vectors.add(total[number][0], own[0]),
                        vectors.add(total[number][1], own[1]),
                    )
                total[number] = own
        return {
            name: self.groups[k].loads(seen, *total[k])
            for k, name in enumerate(self.members)
            if k in total
        }

    def _force(self, pair: CollisionPair) -> Vec3:
        """Forces on the balls, times their weights, world frame [N]."""
        push, rub = self.law.forces(pair.depth, pair.width, pair.normal, pair.rate)
        force = vectors.scale(push, pair.normal)
        if rub is not None:
            force = vectors.add(force, rub)
        return vectors.scale(pair.share, force)

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]."""
        total = jnp.zeros((), self.stiffness.dtype)
        for _, _, pair in self._collisions(seen):
            density = self.law.energy(pair.depth, pair.width)
            total = total + jnp.sum(pair.share * density)
        return total

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration divided by the size of the smaller body [1]."""
        worst = jnp.zeros((), self.stiffness.dtype)
        for _, _, pair in self._collisions(seen):
            depth = jnp.where(pair.share > 0, pair.depth, 0)
            worst = jnp.maximum(worst, jnp.max(self.onset * depth / pair.width))
        return worst

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Bounds of stiffness and drag with as many balls in contact as possible."""
        moving, rubs = self.groups[: len(self.members)], self.friction is not None
        drag = self.law.largest_drag
        springs: list[list[Array]] = [[] for _ in moving]
        dashpots: list[list[Array]] = [[] for _ in moving]
        for a, b in self._pairs(self.groups):
            one, two = self.groups[a], self.groups[b]
            contacts = CollisionPair.contacts(one, two, same=a == b)
            for columns, turning in ((springs, False), (dashpots, rubs)):
                ease = contacts * (
                    one.mobilities[turning][:, None] + two.mobilities[turning][None, :]
                )
                if a == b:
                    ease = jnp.where(jnp.eye(one.count, dtype=bool), 0, ease)
                columns[a].append(ease)
                if b != a and b < len(moving):
                    columns[b].append(ease.T)
        bounds = {}
        for group, spring, dashpot in zip(moving, springs, dashpots, strict=True):
            if not spring:
                continue
            rate = self.stiffness * _worst(spring, self.max_contacts)
            slow = None if drag is None else drag * _worst(dashpot, self.max_contacts)
            turns, drags = _turns(group, False), _turns(group, rubs)
            bounds[group.member] = StabilityBound(
                nodes=rate * group.masses,
                elements=rate * group.inertias if turns else None,
                node_drag=None if slow is None else slow * group.masses,
                element_drag=(
                    None if slow is None or not drags else slow * group.inertias
                ),
            )
        return bounds


def rigid_contact(
    *members: str,
    fixed: Body | Sequence[Body] = (),
    stiffness: Numbers,
    damping: Numbers | None = None,
    friction: Numbers | None = None,
    friction_drag: Numbers | None = None,
    onset: Numbers = 0.01,
    points: Mapping[str, Numbers] | None = None,
    points_per_edge: int = 2,
    balls_per_axis: int | None = None,
    max_contacts: int | None = None,
) -> RigidContact:
    """Contact of rigid bodies with one another and with fixed bodies.

    Contact of spheres is exact. Capsules and cylinders are rows of balls at most a
    radius apart; cylinders also stand and roll on their rims. Boxes touch with their
    corners. Where the edges of two boxes cross, with no corner of one in the other,
    only the points of `points_per_edge` touch.

    Args:
        *members: Names of members that are rigid bodies. Every body touches all others,
            including those of its own member.
        fixed: Fixed bodies, such as `jaxrod.shapes.plane()` for the ground.
        stiffness: Force per penetration of every ball or corner that touches [N/m].
        damping: Force per normal speed [kg/s].
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per slip speed [kg/s]; by default equal to
            `damping`.
        onset: Width of the smooth onset of contact, divided by the size of the smaller
            body (the radius of a sphere) [1].
        points: Contact points on the surfaces of members, by name, in the bodies'
            frames `(3, k)` [m]. Bodies from `jaxrod.shapes.signed_distance` need them.
        points_per_edge: Points on every edge of a box, corners included.
        balls_per_axis: Balls along the axis of capsules and cylinders; by default
            enough that they are at most a radius apart.
        max_contacts: Bodies that may touch one body at the same time, for `stable_dt`:
            12 for equal spheres; by default all bodies.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or friction is given without drag.
        TypeError: If a name is not a string, or a fixed body is not a body.

    Example:
        >>> shape = shapes.sphere((0.0, 0.0, 0.09), radius=0.1)  # 1 cm in the floor
        >>> ball, there = systems.rigid_body(shape, density=1000.0)
        >>> contact = systems.rigid_contact("ball", fixed=shapes.plane(), stiffness=1e4)
        >>> system = jaxrod.make_system({"ball": ball}, contact)
        >>> round(float(system.potential_energy({"ball": there})), 2)  # [J]
        0.5
    """
    check_members(members)
    obstacles = (fixed,) if isinstance(fixed, Body) else tuple(fixed)
    for body in obstacles:
        check_kind("fixed", body, Body)
        if body.count is not None:
            raise ValueError("fixed must be a single body or a list of single bodies")
    unknown = set(points or {}) - set(members)
    if unknown:
        raise ValueError(
            f"points names {sorted(unknown)}, which are not among the members"
        )

    def listed(name: str, value: Any) -> Array:
        shape = numeric("points", value, "m").shape
        if len(shape) != 2 or shape[0] != 3 or shape[1] < 1:
            raise ValueError(f"points of {name!r} must have shape (3, k), got {shape}")
        return as_array(f"points of {name!r}", value, "m", [shape])

    return RigidContact(
        **law_numbers(
            stiffness, damping, friction, friction_drag, onset, per_length=False
        ),
        fixed=obstacles,
        points=None
        if points is None
        else {name: listed(name, value) for name, value in points.items()},
        members=members,
        points_per_edge=check_count("points_per_edge", points_per_edge, 2, 100),
        balls_per_axis=(
            None
            if balls_per_axis is None
            else check_count("balls_per_axis", balls_per_axis, 2, 1000)
        ),
        max_contacts=None
        if max_contacts is None
        else check_count("max_contacts", max_contacts, 1, 1000),
    )


def _turns(group: CollisionBodies, rubs: bool) -> bool:
    """Whether contact exerts couples: on a ball only friction does (`rubs`)."""
    return rubs or not group.is_ball


def _worst(columns: list[Array], max_contacts: int | None) -> Array:
    """Sum of each body's entries in `columns`, over all bodies that may touch it.

    `columns` are matrices `(bodies of a group, bodies of another)`, joined along the
    second axis. With `max_contacts` the sum is at most this number times the largest
    entry.
    """
    every = jnp.concatenate(columns, axis=1)
    total = jnp.sum(every, axis=1)
    if max_contacts is None:
        return total
    return jnp.minimum(total, max_contacts * jnp.max(every, axis=1))
