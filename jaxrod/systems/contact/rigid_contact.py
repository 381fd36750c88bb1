r"""Contact of rigid bodies with one another and with bodies that stand still.

Balls on one body (`jaxrod.systems.contact.samples`) are tested against the signed
distance of the other's surface. Every ball has the law of
`jaxrod.contacts.contact_law`, with a stiffness in N/m. If one of the two bodies is
round, its balls are enough. If both have edges, the corners of each are tested against
the other.

Force and reaction act at one point, midway between the two surfaces, with the
velocities of both bodies there. So momentum and angular momentum are exact, with
damping and friction too, and friction makes bodies roll.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body
from jaxrod.contacts.contact_law import energy_density, friction_force, normal_force
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.parties import Meeting, Party, parties_of
from jaxrod.systems.contact.samples import balls_needed
from jaxrod.systems.sites.coupling import AllParts, AllSeen, Coupling, TiedPair
from jaxrod.validation import Numbers, as_array, check_count, check_kind, numeric


@pytree
class RigidContact(Coupling):
    """Contact among rigid bodies of some members and with fixed bodies."""

    stiffness: Float[Array, ""]
    """Force per penetration of a ball [N/m]."""
    onset: Float[Array, ""]
    """Width of the smooth onset over the size of the smaller body [1]."""
    damping: Float[Array, ""] | None = None
    """Force per speed along the normal [kg/s]."""
    friction: Float[Array, ""] | None = None
    """Coefficient of Coulomb friction [1]."""
    friction_drag: Float[Array, ""] | None = None
    """Largest friction per slip speed [kg/s]."""
    fixed: tuple[Body, ...] = ()
    """Bodies that stand still."""
    points: dict[str, Array] | None = None
    """Points on the surfaces of members by name, own frames `(3, points)` [m]."""
    parties: tuple[Party, ...] = ()
    """Members, then fixed bodies, with their balls, once prepared."""
    members: tuple[str, ...] = static(default=())
    """Names of the members."""
    balls: tuple[int, ...] = static(default=())
    """Balls along the axis of each member and fixed body, once fitted."""
    balls_per_axis: int | None = static(default=None)
    """Given number of balls along an axis; `None` to derive it from the shape."""
    points_per_edge: int = static(default=2)
    """Points on every edge of a box, corners included."""
    partners: int | None = static(default=None)
    """Bodies that may touch one body at a time, for the bound; `None` for all."""

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
        """The coupling with the number of balls along axes.

        Raises:
            ValueError: If nothing can meet, or two bodies cannot detect contact.
        """
        named = [(repr(name), parts[name].shape) for name in self.members]
        named += [(f"fixed[{k}]", body) for k, body in enumerate(self.fixed)]
        given = self.balls_per_axis
        balls = []
        for name, shape in named:
            assert shape is not None
            needed = 0 if given is not None else balls_needed(name, shape)
            balls.append(needed if given is None else given)
        fitted = replace(self, balls=tuple(balls))
        parties = fitted.prepared(parts).parties
        for a, b in fitted._pairs(parties):
            if not Meeting.between(parties[a], parties[b], same=a == b):
                raise ValueError(
                    f"rigid_contact cannot see where {named[a][0]} and {named[b][0]} "
                    "touch: neither has corners or round ends that it knows; give "
                    "points on the surface of one, points={name: (3, k) [m]}"
                )
        if not any(True for _ in fitted._pairs(parties)):
            raise ValueError(
                "one body has nothing to touch: name more members, or give fixed= "
                "bodies such as jaxrod.shapes.plane()"
            )
        return fitted

    def prepared(self, parts: AllParts) -> RigidContact:
        """The coupling with the balls of all bodies."""
        return replace(
            self,
            parties=parties_of(
                {name: parts[name] for name in self.members},
                self.fixed,
                self.balls,
                self.points_per_edge,
                self.points or {},
            ),
        )

    def _pairs(self, parties: Sequence[Party]) -> Iterator[tuple[int, int]]:
        """Numbers of the pairs of parties that may meet."""
        moving = len(self.members)
        for a in range(moving):
            for b in range(a, len(parties)):
                if a != b or parties[a].count > 1:
                    yield a, b

    def _meetings(self, seen: AllSeen) -> Iterator[tuple[int, int, Meeting]]:
        """Meetings of all balls with all surfaces, with the numbers of both parties."""
        for a, b in self._pairs(self.parties):
            one, two = self.parties[a], self.parties[b]
            for first, _, share in Meeting.between(one, two, same=a == b):
                from_, to = (a, b) if first else (b, a)
                yield (
                    from_,
                    to,
                    Meeting.of(
                        self.parties[from_].at(seen),
                        self.parties[to].at(seen),
                        share,
                        self.onset,
                        same=a == b,
                    ),
                )

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on all bodies."""
        total: dict[int, tuple[Vec3, Vec3]] = {}
        for a, b, meeting in self._meetings(seen):
            for number, own in zip(
                (a, b), meeting.loads(self._force(meeting)), strict=True
            ):
                if number in total:
                    own = (
                        vectors.add(total[number][0], own[0]),
                        vectors.add(total[number][1], own[1]),
                    )
                total[number] = own
        return {
            name: self.parties[k].loads(seen, *total[k])
            for k, name in enumerate(self.members)
            if k in total
        }

    def _force(self, meeting: Meeting) -> Vec3:
        """Forces on the balls."""
        leaving = vectors.dot(meeting.rate, meeting.normal)
        push = normal_force(
            meeting.depth, leaving, meeting.width, self.stiffness, self.damping
        )
        force = vectors.scale(push, meeting.normal)
        if self.friction is not None:
            assert self.friction_drag is not None
            slip = vectors.subtract(
                meeting.rate, vectors.scale(leaving, meeting.normal)
            )
            rub = friction_force(push, slip, self.friction, self.friction_drag)
            force = vectors.add(force, rub)
        return vectors.scale(meeting.share, force)

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]."""
        total = jnp.zeros((), self.stiffness.dtype)
        for _, _, meeting in self._meetings(seen):
            density = energy_density(meeting.depth, meeting.width, self.stiffness)
            total = total + jnp.sum(meeting.share * density)
        return total

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration over the size of the smaller body."""
        worst = jnp.zeros((), self.stiffness.dtype)
        for _, _, meeting in self._meetings(seen):
            depth = jnp.where(meeting.share > 0, meeting.depth, 0)
            worst = jnp.maximum(worst, jnp.max(self.onset * depth / meeting.width))
        return worst

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stiffness and drag as if all bodies touched with all their balls."""
        pairs = [
            (a, b, Meeting.contacts(self.parties[a], self.parties[b], same=a == b))
            for a, b in self._pairs(self.parties)
        ]
        drags = [c for c in (self.damping, self.friction_drag) if c is not None]
        drag = None
        for one in drags:
            drag = one if drag is None else jnp.maximum(drag, one)
        return contact_bounds(
            self.parties[: len(self.members)],
            self.parties,
            pairs,
            self.stiffness,
            drag,
            rubs=self.friction is not None,
            partners=self.partners,
        )


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
    partners: int | None = None,
) -> RigidContact:
    """Contact of rigid bodies with one another and with bodies that stand still.

    Spheres touch everything exactly. Capsules and cylinders are rows of balls a radius
    apart; cylinders also stand and roll on their rims. Boxes touch with their corners.
    If the edges of two boxes cross, with no corner of one in the other, they meet at
    the points of `points_per_edge`.

    Args:
        *members: Names of members that are rigid bodies. Every body touches all others,
            including those of its own member.
        fixed: Bodies that stand still, such as `jaxrod.shapes.plane()` for the ground.
        stiffness: Force per penetration of every ball or corner that touches [N/m].
        damping: Force per normal speed [kg/s].
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per slip speed [kg/s]; by default equal to
            `damping`.
        onset: Width of the smooth onset of contact over the size of the smaller body
            (the radius of a sphere) [1].
        points: Points on the surfaces of members by name, tested for contact, in their
            own frames `(3, k)` [m]. Bodies from `jaxrod.shapes.signed_distance` need
            them.
        points_per_edge: Points on every edge of a box, corners included.
        balls_per_axis: Balls along the axis of capsules and cylinders; by default so
            many that they are at most a radius apart.
        partners: Bodies that may touch one body at the same time, for `stable_dt`: 12
            for equal spheres; by default all bodies.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or friction has no drag.
        TypeError: If a name is not a string, or a fixed body is not a body.
    """
    for name in members:
        if not isinstance(name, str):
            raise TypeError(f"members are named by strings, got {name!r}")
    if not members or len(set(members)) < len(members):
        raise ValueError(f"members must be named once each, got {list(members)}")
    obstacles = (fixed,) if isinstance(fixed, Body) else tuple(fixed)
    for body in obstacles:
        check_kind("fixed", body, Body)
        if body.count is not None:
            raise ValueError("fixed must be single bodies, in a list for several")
    drag = damping if friction_drag is None else friction_drag
    if friction is not None and drag is None:
        raise ValueError(
            "friction needs friction_drag > 0 kg/s, what it resists per speed at the "
            "onset of slip (by default the damping), got none"
        )
    unknown = set(points or {}) - set(members)
    if unknown:
        raise ValueError(
            f"points are given of {sorted(unknown)}, not among the members"
        )

    def number(name: str, value: Numbers | None, unit: str) -> Array | None:
        return None if value is None else as_array(name, value, unit, positive=True)

    def listed(name: str, value: Any) -> Array:
        shape = numeric("points", value, "m").shape
        if len(shape) != 2 or shape[0] != 3 or shape[1] < 1:
            raise ValueError(f"points of {name!r} must have shape (3, k), got {shape}")
        return as_array(f"points of {name!r}", value, "m", [shape])

    return RigidContact(
        stiffness=as_array("stiffness", stiffness, "N/m", positive=True),
        onset=as_array("onset", onset, "", positive=True),
        damping=number("damping", damping, "kg/s"),
        friction=number("friction", friction, ""),
        friction_drag=(
            None if friction is None else number("friction_drag", drag, "kg/s")
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
        partners=None
        if partners is None
        else check_count("partners", partners, 1, 1000),
    )


def contact_bounds(
    moving: Sequence[Party],
    parties: Sequence[Party],
    pairs: Sequence[tuple[int, int, float]],
    stiffness: Array,
    drag: Array | None,
    *,
    rubs: bool,
    partners: int | None,
) -> dict[str, StabilityBound]:
    """Bounds on all bodies, as if the bodies of all pairs touched.

    Args:
        moving: Parties that are members, the first of all parties.
        parties: All parties.
        pairs: Numbers of two parties, and the most balls by which two bodies touch.
        stiffness: Stiffness of a ball [N/m].
        drag: Drag of a ball along the normal or along the surface [kg/s].
        rubs: Whether there is friction: it turns balls too.
        partners: Bodies that may touch one body at a time; `None` for all.
    """
    springs: list[list[Array]] = [[] for _ in moving]
    dashpots: list[list[Array]] = [[] for _ in moving]
    for a, b, contacts in pairs:
        one, two = parties[a], parties[b]
        for columns, turning in ((springs, False), (dashpots, rubs)):
            ease = contacts * (
                _ease(one, turning)[:, None] + _ease(two, turning)[None, :]
            )
            if a == b:
                ease = jnp.where(jnp.eye(one.count, dtype=bool), 0, ease)
            columns[a].append(ease)
            if b != a and b < len(moving):
                columns[b].append(ease.T)
    bounds = {}
    for party, spring, dashpot in zip(moving, springs, dashpots, strict=True):
        if not spring:
            continue
        rate = stiffness * _worst(spring, partners)
        slow = None if drag is None else drag * _worst(dashpot, partners)
        turns, drags = _turns(party, False), _turns(party, rubs)
        bounds[party.member] = StabilityBound(
            nodes=rate * party.masses,
            elements=rate * party.inertias if turns else None,
            node_drag=None if slow is None else slow * party.masses,
            element_drag=None if slow is None or not drags else slow * party.inertias,
        )
    return bounds


def _turns(party: Party, rubs: bool) -> bool:
    """Whether contact turns a body: only friction turns a ball."""
    return rubs or not party.is_ball


def _ease(party: Party, rubs: bool) -> Array:
    """Largest velocity at a place of contact per impulse there [1/kg]."""
    moving = 1 / party.masses
    if not _turns(party, rubs):
        return moving
    return moving + party.reach * party.reach / party.inertias


def _worst(columns: list[Array], partners: int | None) -> Array:
    """Sum over all other bodies, or a bound for the most that touch at a time."""
    every = jnp.concatenate(columns, axis=1)
    total = jnp.sum(every, axis=1)
    if partners is None:
        return total
    return jnp.minimum(total, partners * jnp.max(every, axis=1))
