r"""Rigid bodies in contact: surfaces, balls tested against surfaces, and mobilities.

Mobilities of surfaces limit the time step with contact. The convex hull of the balls of
a shape (`jaxrod.systems.contact.sphere_cloud`) contains the shape. The mobility grows
outwards, so its maximum is at a ball. Without friction, forces are normal to the
surface. On a round body they pass through the centre of a ball, which is then the end
of the lever arm.

Other shapes are bounded by `Body.bounding_radius`. If that is not known, the body is
assumed to be convex and of uniform density. Then it extends from its centre of mass by
at most $\sqrt{15\,s/m}$ in the direction of each principal axis, with the mass $m$ and
the second moment of mass $s$ along the axis (R. Kannan, L. Lovász and M. Simonovits,
Discrete Comput. Geom. 13 (1995) 541). For a cone, this is the distance of its tip from
the centre of mass.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.sphere_cloud import SphereCloud, given_points, spheres_of
from jaxrod.systems.coupling import AllSeen, Parts, Seen, turning_mobility


@pytree
class Posed:
    """Pose and velocity of rigid bodies, in arrays that broadcast against points."""

    shape: Body
    """Surface of the body in its own frame."""
    position: Vec3
    """Origin of the body's frame, world frame [m]."""
    frame: tuple[Vec3, Vec3, Vec3]
    """Axes d1, d2, d3 of the body's frame, as vectors in the world frame."""
    velocity: Vec3
    """Velocity of the origin, world frame [m/s]."""
    spin: Vec3
    """Angular velocity, world frame [rad/s]."""

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Signed distance [m] and outward normal at points in the world frame."""
        distance, normal = self.shape.surface(self.seen(points))
        return distance, to_world(self.frame, normal)

    def seen(self, points: Vec3) -> Vec3:
        """Points in the world frame as the body sees them [m]."""
        return to_material(self.frame, vectors.subtract(points, self.position))

    def velocity_at(self, points: Vec3) -> Vec3:
        """Velocity of the body's material at points in the world frame [m/s]."""
        arm = vectors.subtract(points, self.position)
        return vectors.add(self.velocity, vectors.cross(self.spin, arm))


def posed(seen: Seen, number: int) -> Posed:
    """Pose and velocity of the body with index `number` of a member."""
    assert seen.parts.shape is not None
    motion = seen.motion

    def one(field: Vec3) -> Vec3:
        return (
            field[0][number : number + 1],
            field[1][number : number + 1],
            field[2][number : number + 1],
        )

    d1, d2, d3 = map(one, directors(motion.orientation))
    return Posed(
        shape=seen.parts.shape,
        position=one(motion.position),
        frame=(d1, d2, d3),
        velocity=one(motion.velocity),
        spin=one(seen.angular_velocities),
    )


@pytree
class CollisionBodies:
    """Group of bodies of one shape, with the balls that are tested for contact."""

    shape: Body
    """Surface of each body in its own frame."""
    cloud: SphereCloud | None
    """Balls of each body in its own frame; `None` if only the surface is known."""
    sizes: Array
    """Size of each body, to scale the onset of contact: sqrt(2.5 J/m) with its smallest
    moment of inertia J and mass m, which is a sphere's radius; infinite for a fixed
    body [m]."""
    mobilities: tuple[Array, Array]
    """Largest mobilities of each body at a contact, for normal forces and for forces in
    any direction; zero if fixed [1/kg]."""
    masses: Array
    """Mass of each body; infinite for a fixed body [kg]."""
    inertias: Array
    """Smallest moment of inertia of each body; infinite for a fixed body [kg m^2]."""
    pose: Posed | None = None
    """Pose and velocity of a fixed body, or of moving bodies at one moment; `None` for
    moving bodies before `at`."""
    member: str = static(default="")
    """Name of the member; empty for a fixed body."""

    @property
    def count(self) -> int:
        """Number of bodies."""
        return self.masses.shape[0]

    @property
    def is_round(self) -> bool:
        """Whether the balls make up the whole body (spheres and capsules)."""
        return self.cloud is not None and self.cloud.is_round

    @property
    def is_ball(self) -> bool:
        """Whether each body is a single ball."""
        return self.cloud is not None and self.is_round and self.cloud.count == 1

    def at(self, seen: AllSeen) -> CollisionBodies:
        """The group with its pose and velocity in the given state."""
        if not self.member:
            return self
        own = seen[self.member]
        motion = own.motion
        pose = Posed(
            shape=self.shape,
            position=motion.position,
            frame=directors(motion.orientation),
            velocity=motion.velocity,
            spin=own.angular_velocities,
        )
        return replace(self, pose=pose)

    def loads(self, seen: AllSeen, forces: Vec3, couples: Vec3) -> Loads:
        """Loads on the member, with couples rotated from world to body frames."""
        frame = directors(seen[self.member].motion.orientation)
        return Loads(forces, to_material(frame, couples))


def collision_bodies(
    members: Mapping[str, Parts],
    fixed: Sequence[Body],
    balls: Sequence[int],
    points_per_edge: int,
    points: Mapping[str, Array],
) -> tuple[CollisionBodies, ...]:
    """Groups of bodies with their balls: members first, then fixed bodies.

    Args:
        members: Constants of the members.
        fixed: Fixed bodies.
        balls: Number of balls along the axis of each member and fixed body.
        points_per_edge: Points on every edge of a box, corners included.
        points: Contact points of members, by name, in place of their balls `(3, k)`
            [m].
    """
    groups = []
    for (name, own), along in zip(members.items(), balls, strict=False):
        assert own.shape is not None
        cloud = spheres_of(own.shape, along, points_per_edge)
        if name in points:
            cloud = given_points(points[name])
        normal, any_way = (
            surface_mobility(own, rubs=rubs, points=points.get(name))
            for rubs in (False, True)
        )
        least = jnp.min(own.inertias, axis=0)
        groups.append(
            CollisionBodies(
                shape=own.shape,
                cloud=cloud,
                # At uniform density; exact for a sphere.
                sizes=jnp.sqrt(2.5 * least / own.node_masses),
                mobilities=(normal, any_way),
                masses=own.node_masses,
                inertias=least,
                member=name,
            )
        )
    for body, along in zip(fixed, balls[len(members) :], strict=True):
        groups.append(_standing(body, along, points_per_edge))
    return tuple(groups)


def _standing(body: Body, balls: int, points_per_edge: int) -> CollisionBodies:
    """Group of one fixed body, of infinite mass, in the frame of its principal axes.

    `balls` is the number of balls along its axis.
    """
    shape, centre = body, jnp.zeros(3)
    frame = directors(split_quaternion(jnp.asarray((1.0, 0.0, 0.0, 0.0))))
    if not body.is_half_space:
        solid = body.solid()
        shape, centre = solid.shape, solid.centre
        frame = directors(split_quaternion(solid.orientation))
    dtype = jax.tree.leaves(body)[0].dtype
    endless = jnp.full((1,), jnp.inf, dtype)

    def one(vector: Vec3) -> Vec3:
        return vectors.mapped(lambda c: jnp.asarray(c, dtype)[None], vector)

    zero = one(vectors.split(jnp.zeros(3, dtype)))
    d1, d2, d3 = map(one, frame)
    return CollisionBodies(
        shape=shape,
        cloud=spheres_of(shape, balls, points_per_edge),
        sizes=endless,
        mobilities=(1 / endless, 1 / endless),
        masses=endless,
        inertias=endless,
        pose=Posed(shape, one(vectors.split(centre)), (d1, d2, d3), zero, zero),
    )


Way = tuple[bool, bool, float]
"""Test of balls against surfaces: `(True, False, w)` for the balls of the first group
against the surfaces of the second, `(False, True, w)` for the reverse. Each ball has
the weight w [1]."""


@pytree
class CollisionPair:
    """Contacts of the balls of a first group with the surfaces of a second.

    Arrays are `(bodies of the second group, balls of all bodies of the first)`.
    """

    depth: Array
    """Penetration of each ball of the first group into each surface of the second: the
    ball's radius minus the distance of its centre, negative when apart [m]."""
    width: Array
    """Width of the smooth onset of contact of each ball with each surface [m]."""
    normal: Vec3
    """Outward unit normal of each surface at each ball, world frame."""
    rate: Vec3
    """Velocity of the ball's body relative to the surface's body at the contact point,
    world frame [m/s]."""
    arms: tuple[Vec3, Vec3]
    """Lever arms from the origins of the ball's body and of the surface's body to the
    contact point, world frame [m]."""
    share: Array
    """Weight of each ball at each surface; zero at the surface of its own body [1]."""
    balls: int = static()
    """Number of balls of each body."""

    @staticmethod
    def between(
        a: CollisionBodies, b: CollisionBodies, *, same: bool
    ) -> tuple[Way, ...]:
        """Tests of balls against surfaces that two groups need; see `Way`.

        Args:
            a: The first group.
            b: The second group, or the same.
            same: Whether both groups are the same; then one direction is enough.
        """
        first, second = (True, False), (False, True)
        if same:
            if a.cloud is None:
                return ()
            return ((*first, 0.5 if a.is_round else 1.0),)
        if a.is_ball:
            return ((*first, 1.0),)
        if b.is_ball:
            return ((*second, 1.0),)
        if a.is_round and b.is_round:
            return ((*first, 0.5), (*second, 0.5))
        if a.is_round or b.is_round:
            return ((*(first if a.is_round else second), 1.0),)
        one = () if a.cloud is None else ((*first, 1.0),)
        two = () if b.cloud is None else ((*second, 1.0),)
        return (*one, *two)

    @staticmethod
    def contacts(a: CollisionBodies, b: CollisionBodies, *, same: bool) -> float:
        """Largest weighted number of balls in contact between a body of `a` and of `b`.

        With `same`, `a` and `b` are one group.
        """
        total = 0.0
        for first, _, share in CollisionPair.between(a, b, same=same):
            looks, surface = (a, b) if first else (b, a)
            assert looks.cloud is not None
            most: int | None = looks.cloud.at_once
            if most is None or not surface.shape.is_convex:
                most = looks.cloud.count
            total += (2 if same else 1) * share * most
        return total

    @staticmethod
    def of(
        a: CollisionBodies,
        b: CollisionBodies,
        share: float,
        onset: Array,
        *,
        same: bool,
    ) -> CollisionPair:
        """Contacts of all balls of group `a` with all surfaces of group `b`.

        Args:
            a: Group with the balls, at one moment.
            b: Group with the surfaces, at one moment.
            share: Weight of each ball [1].
            onset: Width of the onset divided by the size of the smaller body [1].
            same: Whether both groups are the same; no body is tested against itself.
        """
        cloud, pose, other = a.cloud, a.pose, b.pose
        assert cloud is not None and pose is not None and other is not None
        count = cloud.count

        def each(field: Array) -> Array:
            return jnp.repeat(field, count)

        d1, d2, d3 = pose.frame
        balls = Posed(
            shape=a.shape,
            position=vectors.mapped(each, pose.position),
            frame=(
                vectors.mapped(each, d1),
                vectors.mapped(each, d2),
                vectors.mapped(each, d3),
            ),
            velocity=vectors.mapped(each, pose.velocity),
            spin=vectors.mapped(each, pose.spin),
        )
        # All balls of all bodies in one row.
        row = jax.tree.map(
            lambda leaf: jnp.tile(leaf, (1,) * (leaf.ndim - 1) + (a.count,)),
            replace(cloud, axis=None),
        )
        row = replace(row, axis=cloud.axis, angles=cloud.angles * a.count)
        sizes = each(a.sizes)

        def against(
            position: Vec3,
            frame: tuple[Vec3, Vec3, Vec3],
            velocity: Vec3,
            spin: Vec3,
            size: Array,
        ) -> tuple[Array, Array, Vec3, Vec3, tuple[Vec3, Vec3]]:
            body = Posed(b.shape, position, frame, velocity, spin)
            return _touch(row, balls, body, onset * jnp.minimum(sizes, size))

        depth, width, normal, rate, arms = jax.vmap(against)(
            other.position, other.frame, other.velocity, other.spin, b.sizes
        )
        counts = np.full(depth.shape, share)
        if same:
            numbers = np.repeat(np.arange(a.count), count)
            counts[np.arange(a.count)[:, None] == numbers[None, :]] = 0
        return CollisionPair(
            depth=depth,
            width=width,
            normal=normal,
            rate=rate,
            arms=arms,
            share=jnp.asarray(counts, depth.dtype),
            balls=count,
        )

    def loads(self, force: Vec3) -> tuple[tuple[Vec3, Vec3], tuple[Vec3, Vec3]]:
        """Total force and couple on each body of the first and of the second group.

        Couples are about the origins of the bodies, world frame.

        Args:
            force: Force of each surface on each ball, world frame, of the shape of
                `depth` [N].
        """
        couples = vectors.cross(self.arms[0], force)
        back = vectors.cross(force, self.arms[1])

        def on_balls(field: Array) -> Array:
            rows = jnp.sum(field, axis=0).reshape(-1, self.balls)
            return jnp.sum(rows, axis=1)

        def on_surfaces(field: Array) -> Array:
            return jnp.sum(field, axis=1)

        return (
            (vectors.mapped(on_balls, force), vectors.mapped(on_balls, couples)),
            (
                vectors.mapped(on_surfaces, vectors.scale(-1.0, force)),
                vectors.mapped(on_surfaces, back),
            ),
        )


def _touch(
    cloud: SphereCloud, balls: Posed, body: Posed, width: Array
) -> tuple[Array, Array, Vec3, Vec3, tuple[Vec3, Vec3]]:
    """Penetration, width, normal, velocity and lever arms of balls at a surface.

    They are fields of `CollisionPair` for all balls and one `body`. `cloud` contains
    the balls of all bodies in a row, and `balls` the pose of the body of each. The
    onset `width` [m] is returned unchanged.
    """

    def world(own: Vec3) -> Vec3:
        return vectors.add(balls.position, to_world(balls.frame, own))

    towards: Vec3 = vectors.split(cloud.offsets)
    if cloud.rim_radii is not None:
        _, outwards = body.surface(world(towards))
        towards = vectors.scale(-1.0, to_material(balls.frame, outwards))
    centre = world(cloud.places(towards))
    distance, normal = body.surface(centre)
    depth = cloud.radii - distance
    # Midway between the two surfaces.
    place = vectors.add(centre, vectors.scale(0.5 * depth - cloud.radii, normal))
    rate = vectors.subtract(balls.velocity_at(place), body.velocity_at(place))
    arms = (
        vectors.subtract(place, balls.position),
        vectors.subtract(place, body.position),
    )
    return depth, width, normal, rate, arms


@functools.partial(jax.jit, static_argnames="rubs")
def surface_mobility(
    bodies: Parts, *, rubs: bool, points: Array | None = None
) -> Float[Array, " k"]:
    """Bound on the velocity of surface points per unit impulse, for each body [1/kg].

    Args:
        bodies: Constants of the bodies, which have a shape.
        rubs: Whether forces can have any direction, as with friction; otherwise they
            are normal to the surface.
        points: Contact points on the surface, in the bodies' frames `(3, points)`, if
            there are any [m].
    """
    assert bodies.shape is not None
    turning = _turning(bodies, rubs)
    if points is not None:
        turning = jnp.maximum(turning, _of_balls(bodies, points, 0 * points[0]))
    return 1 / bodies.node_masses + turning


def _turning(bodies: Parts, rubs: bool) -> Array:
    assert bodies.shape is not None
    # Only the ends of a row of balls count, and only the corners of a box.
    cloud = spheres_of(bodies.shape, 2, 2)
    if cloud is not None:
        return _of_cloud(bodies, cloud, rubs)
    radius, least = bodies.shape.bounding_radius, jnp.min(bodies.inertias, axis=0)
    if radius is not None:
        return radius * radius / least
    spread = 0.5 * jnp.sum(bodies.inertias, axis=0)[None] - bodies.inertias
    spread = 15 * jnp.maximum(spread, 0) / bodies.node_masses[None]
    corner = vectors.split(jnp.sqrt(jnp.maximum(spread, jnp.finfo(spread.dtype).tiny)))
    return jnp.minimum(
        turning_mobility(bodies.inertias, corner), jnp.max(spread, axis=0) / least
    )


def _of_cloud(bodies: Parts, cloud: SphereCloud, rubs: bool) -> Array:
    normal = cloud.is_round and not rubs
    radii = jnp.zeros_like(cloud.radii) if normal else cloud.radii
    if cloud.rim_radii is None:
        return _of_balls(bodies, cloud.offsets, radii)
    # A rim is in a ball around its centre, and a ring of points at equal distance.
    rims = cloud.rim_radii
    arms = jnp.max(jnp.sum(cloud.offsets**2, axis=0) + rims * rims)
    return jnp.minimum(
        _of_balls(bodies, cloud.offsets, radii + rims),
        arms / jnp.min(bodies.inertias, axis=0),
    )


def _of_balls(bodies: Parts, centres: Array, radii: Array) -> Array:
    """Largest mobility through rotation of any ball, for each body [1/kg]."""
    x, y, z = (c[:, None] for c in centres)
    each = turning_mobility(bodies.inertias[:, None, :], (x, y, z), radii[:, None])
    return jnp.max(each, axis=0)
