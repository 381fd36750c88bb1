r"""Contact of rods with rigid bodies that move.

The law is that of `jaxrod.contacts.contact`. At points $x$ along a rod of radius $r$ it
uses the signed distance to the surface of a body at its current pose, the normal $n$,
and the velocity of this surface. Force and reaction act at one point, $c = x - r n$ on
the rod's surface: on the rod's section with the lever arm $-r n$, on the body, with the
origin $X$, with the lever arm $c - X$. So momentum and angular momentum are conserved
exactly, also with damping and friction, and friction makes rod and body roll.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.contacts.contact_law import depth_from_onset
from jaxrod.contacts.ends import Ends
from jaxrod.contacts.passages import passages
from jaxrod.contacts.points import fewer_points
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.collision_bodies import Posed, posed, surface_mobility
from jaxrod.systems.contact.penalty_contact import (
    PenaltyContact,
    law_numbers,
    weight_over_overlap,
)
from jaxrod.systems.contact.rod_segments import (
    ContactPoints,
    RodSegments,
    SegmentLoads,
    loads_on_member,
    points_at,
    points_needed,
    segments_and_ends,
)
from jaxrod.systems.coupling import (
    AllParts,
    AllSeen,
    Parts,
    TiedPair,
    check_named,
)
from jaxrod.validation import Numbers, as_array, check_count


@pytree
class BodyContact(PenaltyContact):
    """Contact of the rods of one member with the bodies of another.

    Example:
        >>> contact = systems.body_contact("arm", "ball", stiffness=1e4)
        >>> contact.rod, contact.body, contact.is_contact
        ('arm', 'ball', True)
    """

    touching: Float[Array, ""] | None = None
    """Largest length of rod that touches a body at one time, for the stability bound
    [m]; if `None`, the whole length."""
    free_ends: Float[Array, "rods 2"] | None = None
    """Flags of the rods' ends: 1 if free, 0 if tied or attached."""
    segments: RodSegments | None = None
    """Segments and contact points of the rods, set by `prepared`. Points at ends have
    zero length here; `ends` gives their length."""
    ends: Ends | None = None
    """Ends of the rods, with their contact law, set by `prepared`."""
    rod: str = static(default="")
    """Name of the member with the rods."""
    body: str = static(default="")
    """Name of the member with the bodies."""
    points_per_element: int | None = static(default=None)
    """Contact points per element; `None` to derive the number from the radii."""

    @property
    def is_contact(self) -> bool:
        """Always `True`: a replay can show these forces as contact forces."""
        return True

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if members are missing, of a wrong kind or lack a shape."""
        for name in (self.rod, self.body):
            check_named(name, parts)
        if not (parts[self.rod].is_rod and parts[self.body].is_rigid):
            raise ValueError(
                "body_contact needs a rod and a rigid body, got "
                f"{self.rod!r} and {self.body!r}"
            )
        if parts[self.body].shape is None:
            raise ValueError(
                f"body_contact needs a surface, but {self.body!r} has no shape"
            )

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> BodyContact:
        """Copy with `points_per_element` set, for points at most a radius apart."""
        if self.points_per_element is not None:
            return self
        # At most a radius apart.
        needed = points_needed("body_contact", self.rod, parts[self.rod], 1.0)
        return replace(self, points_per_element=needed)

    def regridded(self, grids: Any) -> BodyContact:
        """Copy with contact points as dense on the new elements as on the old ones."""
        assert self.points_per_element is not None
        per = grids.points_per_element(self.rod, self.points_per_element)
        return replace(self, points_per_element=per)

    def thinned(self, share: float) -> BodyContact:
        """Copy with a share of the contact points per element, at least one."""
        assert self.points_per_element is not None
        per = fewer_points(self.points_per_element, share)
        return replace(self, points_per_element=per)

    def with_free_ends(self, free: Mapping[str, Array]) -> BodyContact:
        """Copy with the flags of free ends of its rods; `free` has them by member.

        Only free ends have an end face.
        """
        return replace(self, free_ends=free[self.rod])

    def prepared(self, parts: AllParts) -> BodyContact:
        """The coupling with `segments` and `ends` set from the rods' constants."""
        per, free = self.points_per_element, self.free_ends
        assert per is not None and free is not None
        made, ends = segments_and_ends(parts[self.rod], per, free)
        return replace(self, segments=made, ends=ends)

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on rods and bodies."""
        segments, own = self._segments(), seen[self.rod]
        points = points_at(segments, own, spins=self.friction is not None)
        total = vectors.scale(0.0, points.position)
        turning: Vec3 | None = None if self.friction is None else total
        reactions = []
        # Forces beside the ends are spread over the points once, not for every body.
        pulled = vectors.scale(0.0, self._ends().beside(points.position))
        for body in self._bodies(seen):
            force, turn, place, beside = self._force(points, body)
            total = vectors.add(total, force)
            pulled = vectors.add(pulled, beside)
            if turn is not None:
                assert turning is not None
                turning = vectors.add(turning, turn)
            couple = vectors.cross(force, vectors.subtract(place, body.position))
            # These forces are along the normal, so any point on its line will do.
            arm = vectors.subtract(self._ends().beside(points.position), body.position)
            more = vectors.cross(beside, arm)
            reactions.append(
                (
                    vectors.add(
                        vectors.mapped(_sum, force), vectors.mapped(_sum, beside)
                    ),
                    vectors.add(
                        vectors.mapped(_sum, couple), vectors.mapped(_sum, more)
                    ),
                )
            )
        total = vectors.add(total, vectors.mapped(self._ends().from_beside, pulled))
        on_rod = loads_on_member(
            segments, own, SegmentLoads(on_points=total, turning_points=turning)
        )
        return {self.rod: on_rod, self.body: self._on_bodies(seen, reactions)}

    def _on_bodies(self, seen: AllSeen, reactions: list[tuple[Vec3, Vec3]]) -> Loads:
        """Loads on the bodies, with couples rotated to their material frames.

        Args:
            seen: The members at one moment.
            reactions: For each body, the total force on the rods [N], and the couple on
                the body about its origin [N m], world frame.
        """

        def row(which: int) -> Vec3:
            x, y, z = (
                jnp.stack([reaction[which][axis] for reaction in reactions])
                for axis in range(3)
            )
            return x, y, z

        frame = directors(seen[self.body].motion.orientation)
        return Loads(vectors.scale(-1.0, row(0)), to_material(frame, row(1)))

    def _force(
        self, points: ContactPoints, body: Posed
    ) -> tuple[Vec3, Vec3 | None, Vec3, Vec3]:
        """Contact forces and couples of one body on the rods, world frame.

        Returns:
            Forces on the contact points, couples on the rod there (`None` without
            friction), points on the surface where the forces act, and forces at the
            points beside the ends (see `Ends`).
        """
        segments, ends = self._segments(), self._ends()
        distance, normal = body.surface(points.position)
        radii = segments.point_radii
        arm = vectors.scale(-radii, normal)
        place = vectors.add(points.position, arm)
        assert points.velocity is not None
        rate = vectors.subtract(points.velocity, body.velocity_at(place))
        turning = None
        if points.spin is not None:
            turning = vectors.cross(points.spin, arm)
        beside, outward = body.surface(ends.beside(points.position))
        own, own_radii = ends.of_points(distance), ends.of_points(radii)
        depth, density = self._depth(own_radii), self._density(own_radii, own)
        more = density * ends.deepened(own, beside, depth)
        push, rub = self.law.forces(
            radii - distance,
            self.onset * radii,
            normal,
            rate,
            turning,
            ends.to_points(more),
        )
        lengths, at_ends, pulls = ends.counted_and_changes(own, beside, depth, density)
        counted = segments.lengths + ends.to_points(lengths)
        pressed = counted * push + ends.to_points(at_ends)
        force = vectors.scale(pressed, normal)
        pull = vectors.scale(pulls, outward)
        if rub is None:
            return force, None, place, pull
        rub = vectors.scale(counted, rub)
        return vectors.add(force, rub), vectors.cross(arm, rub), place, pull

    def _depth(self, radii: Array) -> Callable[[Array], Array]:
        """Function from the distance d of the centreline to r - d + w/2 [m].

        r is an entry of `radii`, and w the width of the onset. Without contact the
        value is w, because `Ends.counted` needs positive ones. It is a function because
        `Ends` differentiates lengths with respect to distances.
        """
        return lambda distance: depth_from_onset(radii - distance, self.onset * radii)

    def _density(self, radii: Array, distance: Array) -> Array:
        """Spring energy per length at a rod axis's `distance` from a body [J/m]."""
        return self.law.energy(radii - distance, self.onset * radii)

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]."""
        segments, ends = self._segments(), self._ends()
        points = points_at(segments, seen[self.rod], spins=False)
        total = jnp.zeros((), self.stiffness.dtype)
        for body in self._bodies(seen):
            distance, _ = body.surface(points.position)
            beside, _ = body.surface(ends.beside(points.position))
            density = self._density(segments.point_radii, distance)
            own, radii = ends.of_points(distance), ends.of_points(segments.point_radii)
            counted = ends.counted(own, beside, self._depth(radii))
            at_ends = counted * ends.of_points(density)
            total = total + jnp.sum(segments.lengths * density) + jnp.sum(at_ends)
        return total

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration of a contact point divided by the rod's radius [1]."""
        segments = self._segments()
        points = points_at(segments, seen[self.rod], spins=False)
        worst = jnp.zeros((), self.stiffness.dtype)
        for body in self._bodies(seen):
            distance, _ = body.surface(points.position)
            worst = jnp.maximum(worst, jnp.max(1 - distance / segments.point_radii))
        return worst

    def passages(self, before: AllSeen, after: AllSeen) -> Array:
        """Number of contact points that went through a body between two states."""
        segments, count = self._segments(), jnp.zeros((), self.stiffness.dtype)
        places = [
            points_at(segments, seen[self.rod], spins=False).position
            for seen in (before, after)
        ]
        for bodies in zip(self._bodies(before), self._bodies(after), strict=True):
            ways = [b.seen(place) for b, place in zip(bodies, places, strict=True)]
            surface = bodies[0].shape.surface
            count = count + passages(surface, segments.point_radii, *ways)
        return count

    def least_stiffness(self, parts: AllParts) -> Array:
        """Stiffness with which the rod carries its own weight [N/m^2]."""
        return weight_over_overlap([parts[self.rod]])

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Bounds of stiffness and drag with each rod's whole length on every body.

        With `touching`, at most that length of rod touches a body. A spring's change of
        length is the sum of the contributions of node and body. By the Cauchy-Schwarz
        inequality its energy is at most that of all masses together at the squared
        frequency `k` times the sum of the mobilities, with the stiffness `k`. The
        mobility of a node is its length over its mass. That of a body is the length
        touching it times its `surface_mobility`.
        """
        rods, bodies = parts[self.rod], parts[self.body]
        assert rods.linear_density is not None and rods.radii is not None
        segments, ends = self._segments(), self._ends()
        lengths = segments.from_points(segments.lengths + ends.bound())
        touching = jnp.sum(lengths)
        if self.touching is not None:
            touching = jnp.minimum(touching, self.touching)
            lengths = jnp.minimum(lengths, self.touching)
        nodes = bodies.count * jnp.max(lengths / rods.node_masses)

        def moving(rubs: bool) -> Array:
            return touching * jnp.max(surface_mobility(bodies, rubs=rubs))

        rate = self.stiffness * (nodes + moving(False))
        drag, sections = self.law.largest_drag, jnp.zeros_like(rate)
        if self.friction_drag is not None:
            # Friction also turns the section, and a ball about its centre.
            own = jnp.min(rods.inertias, axis=0)
            longest = segments.lengths + ends.longest()
            on_segments = segments.to_segments(longest * segments.point_radii**2)
            sections = bodies.count * jnp.max(on_segments / own)
        slow: Array | None = None
        if drag is not None:
            rubs = self.friction_drag is not None
            slow = drag * (nodes + sections + moving(rubs))
        return {
            self.rod: _bound(rods, rate, slow, self.friction_drag is not None, False),
            self.body: _bound(bodies, rate, slow, True, True),
        }

    def _segments(self) -> RodSegments:
        assert self.segments is not None
        return self.segments

    def _ends(self) -> Ends:
        assert self.ends is not None
        return self.ends

    def _bodies(self, seen: AllSeen) -> Iterator[Posed]:
        own = seen[self.body]
        for number in range(own.parts.count):
            yield posed(own, number)


def _sum(field: Array) -> Array:
    return jnp.sum(field)


def _bound(
    parts: Parts, rate: Array, slow: Array | None, drags: bool, turns: bool
) -> StabilityBound:
    """Stability bound in proportion to masses and moments of inertia.

    Nodes have the stiffness `rate` [1/s^2] and the drag `slow` [1/s] times their mass.
    Elements have the same times their smallest moment of inertia: stiffness only if
    `turns`, drag only if `drags`.
    """
    inertia = jnp.min(parts.inertias, axis=0)
    return StabilityBound(
        nodes=rate * parts.node_masses,
        elements=rate * inertia if turns else None,
        node_drag=None if slow is None else slow * parts.node_masses,
        element_drag=None if slow is None or not drags else slow * inertia,
    )


def body_contact(
    rod: str,
    body: str,
    *,
    stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    friction: Numbers | None = None,
    friction_drag: Numbers | None = None,
    onset: Numbers = 0.01,
    points_per_element: int | None = None,
    touching: Numbers | None = None,
) -> BodyContact:
    """Contact of the rods of one member with the rigid bodies of another.

    For fixed bodies a rod's own effect `contact` is cheaper.

    Args:
        rod: Name of a rod, or of equal rods.
        body: Name of rigid bodies with a shape.
        stiffness: Force per length of rod and penetration [N/m^2]. If it is left out,
            `make_system` chooses it so that this contact halves `stable_dt`
            (`jaxrod.contacts.default_law`). It then also chooses damping and friction
            drag, unless they are given.
        damping: Force per length and normal speed [kg/(m s)]; zero by default if the
            stiffness is given.
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per length and slip speed [kg/(m s)]; by default
            equal to `damping`. It is chosen with the stiffness if both that and the
            damping are left out.
        onset: Width of the smooth onset of contact, divided by the rod's radius [1].
        points_per_element: Contact points per element; by default enough that they are
            at most a radius apart.
        touching: Largest length of rod that touches a body at one time, for
            `stable_dt`; by default the whole length [m].

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or friction is given without drag.

    Example:
        >>> shape = shapes.sphere((0.5, 0.0, -0.5), radius=0.1)
        >>> ball, there = systems.rigid_body(shape, density=1000.0)
        >>> contact = systems.body_contact(
        ...     "arm", "ball", stiffness=1e4, damping=5.0, friction=0.3
        ... )
        >>> system = jaxrod.make_system({"arm": scene, "ball": ball}, contact)
        >>> float(system.couplings[0].friction_drag)  # that of the damping [kg/(m s)]
        5.0
    """
    if points_per_element is not None:
        check_count("points_per_element", points_per_element, 1, 1000)
    return BodyContact(
        **law_numbers(
            stiffness, damping, friction, friction_drag, onset, per_length=True
        ),
        touching=(
            None
            if touching is None
            else as_array("touching", touching, "m", positive=True)
        ),
        rod=rod,
        body=body,
        points_per_element=points_per_element,
    )
