"""Parties to contact: the rigid bodies of a member, or one fixed body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

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
from jaxrod.systems.contact.posed import Posed
from jaxrod.systems.contact.samples import Samples, given_samples, samples_of
from jaxrod.systems.members.parts import Parts, mapped
from jaxrod.systems.sites.coupling import AllSeen


@pytree
class Party:
    """Bodies of one shape, with the balls that are tested for contact."""

    shape: Body
    """Surface in the bodies' own frame."""
    samples: Samples | None
    """Balls in the bodies' own frame; `None` if only the surface is known."""
    sizes: Array
    """Half the smallest thickness of each, roughly; infinite for a fixed body [m]."""
    reach: Array
    """Largest distance of the surface from the origin [m]."""
    masses: Array
    """Mass of each body; infinite for a fixed body [kg]."""
    inertias: Array
    """Smallest moment of inertia of each body; infinite for a fixed body [kg m^2]."""
    pose: Posed | None = None
    """Pose of a fixed body, or of moving bodies at one moment."""
    member: str = static(default="")
    """Name of the member; empty for a fixed body."""

    @property
    def count(self) -> int:
        """Number of bodies."""
        return self.masses.shape[0]

    @property
    def is_round(self) -> bool:
        """Whether the balls are the whole body."""
        return self.samples is not None and self.samples.is_round

    @property
    def is_ball(self) -> bool:
        """Whether the body is a single ball."""
        return self.samples is not None and self.is_round and self.samples.count == 1

    def at(self, seen: AllSeen) -> Party:
        """The party with its pose at one moment."""
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
        """Loads on the member, from couples given in the world frame."""
        frame = directors(seen[self.member].motion.orientation)
        return Loads(forces, to_material(frame, couples))


def parties_of(
    members: Mapping[str, Parts],
    fixed: Sequence[Body],
    balls: Sequence[int],
    points_per_edge: int,
    points: Mapping[str, Array],
) -> tuple[Party, ...]:
    """Members and fixed bodies with their balls.

    Args:
        members: Constants of the members.
        fixed: Bodies that stand still.
        balls: Number of balls along the axis of each.
        points_per_edge: Points on every edge of a box.
        points: Points on members, by name.
    """
    parties = []
    for (name, own), along in zip(members.items(), balls, strict=False):
        assert own.shape is not None
        samples = samples_of(own.shape, along, points_per_edge)
        if name in points:
            samples = given_samples(points[name])
        # At uniform density; exact for a sphere.
        least, most = jnp.min(own.inertias, axis=0), jnp.max(own.inertias, axis=0)
        reach = jnp.max(jnp.sqrt(5 * most / own.node_masses))
        if samples is not None:
            reach = samples.reach + jnp.max(samples.radii)
        parties.append(
            Party(
                shape=own.shape,
                samples=samples,
                sizes=jnp.sqrt(2.5 * least / own.node_masses),
                reach=reach,
                masses=own.node_masses,
                inertias=least,
                member=name,
            )
        )
    for body, along in zip(fixed, balls[len(members) :], strict=True):
        parties.append(_standing(body, along, points_per_edge))
    return tuple(parties)


def _standing(body: Body, balls: int, points_per_edge: int) -> Party:
    """Party of a fixed body, in the frame of its axes."""
    shape, centre = body, jnp.zeros(3)
    frame = directors(split_quaternion(jnp.asarray((1.0, 0.0, 0.0, 0.0))))
    if not body.is_half_space:
        solid = body.solid()
        shape, centre = solid.shape, solid.centre
        frame = directors(split_quaternion(solid.orientation))
    dtype = jax.tree.leaves(body)[0].dtype
    endless = jnp.full((1,), jnp.inf, dtype)

    def one(vector: Vec3) -> Vec3:
        return mapped(lambda c: jnp.asarray(c, dtype)[None], vector)

    zero = one(vectors.split(jnp.zeros(3, dtype)))
    d1, d2, d3 = map(one, frame)
    return Party(
        shape=shape,
        samples=samples_of(shape, balls, points_per_edge),
        sizes=endless,
        reach=jnp.zeros((), dtype),
        masses=endless,
        inertias=endless,
        pose=Posed(shape, one(vectors.split(centre)), (d1, d2, d3), zero, zero),
    )


Way = tuple[bool, bool, float]
"""Whether balls of the first party are tested against the second, whether the reverse,
and the weight of each ball."""


@pytree
class Meeting:
    """The balls of one party against the surfaces of another, `(bodies, balls)`."""

    depth: Array
    """Penetration [m]."""
    width: Array
    """Width of the onset [m]."""
    normal: Vec3
    """Outward normal of the surface."""
    rate: Vec3
    """Velocity of the ball's body relative to the other, at the place of contact [m/s].
    """
    arms: tuple[Vec3, Vec3]
    """Vectors from the origins of the ball's body and of the other to the place of
    contact [m]."""
    share: Array
    """Weight of each ball and surface [1]."""
    balls: int = static()
    """Number of balls of each body."""

    @staticmethod
    def between(a: Party, b: Party, *, same: bool) -> tuple[Way, ...]:
        """Ways in which two parties are tested against each other.

        Args:
            a: The first party.
            b: The second party, or the same.
            same: Whether both are the same: then one way covers both.
        """
        first, second = (True, False), (False, True)
        if same:
            if a.samples is None:
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
        one = () if a.samples is None else ((*first, 1.0),)
        two = () if b.samples is None else ((*second, 1.0),)
        return (*one, *two)

    @staticmethod
    def contacts(a: Party, b: Party, *, same: bool) -> float:
        """Largest number of balls, weighted, by which two of their bodies touch."""
        total = 0.0
        for first, _, share in Meeting.between(a, b, same=same):
            looks, surface = (a, b) if first else (b, a)
            assert looks.samples is not None
            most: int | None = looks.samples.at_once
            if most is None or not surface.shape.is_convex:
                most = looks.samples.count
            total += (2 if same else 1) * share * most
        return total

    @staticmethod
    def of(a: Party, b: Party, share: float, onset: Array, *, same: bool) -> Meeting:
        """Meeting of the balls of one party with the surfaces of another.

        Args:
            a: Party with the balls, at one moment.
            b: Party with the surfaces, at one moment.
            share: Weight of each ball [1].
            onset: Width of the onset over the smaller size [1].
            same: Whether both are the same: a body is not tested against itself.
        """
        samples, pose, other = a.samples, a.pose, b.pose
        assert samples is not None and pose is not None and other is not None
        count = samples.count

        def each(field: Array) -> Array:
            return jnp.repeat(field, count)

        d1, d2, d3 = pose.frame
        balls = Posed(
            shape=a.shape,
            position=mapped(each, pose.position),
            frame=(mapped(each, d1), mapped(each, d2), mapped(each, d3)),
            velocity=mapped(each, pose.velocity),
            spin=mapped(each, pose.spin),
        )
        # All balls of all bodies in one row.
        row = jax.tree.map(
            lambda leaf: jnp.tile(leaf, (1,) * (leaf.ndim - 1) + (a.count,)),
            replace(samples, axis=None),
        )
        row = replace(row, axis=samples.axis, angles=samples.angles * a.count)
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
        return Meeting(
            depth=depth,
            width=width,
            normal=normal,
            rate=rate,
            arms=arms,
            share=jnp.asarray(counts, depth.dtype),
            balls=count,
        )

    def loads(self, force: Vec3) -> tuple[tuple[Vec3, Vec3], tuple[Vec3, Vec3]]:
        """Forces and couples on all bodies of both parties, from forces on balls."""
        couples = vectors.cross(self.arms[0], force)
        back = vectors.cross(force, self.arms[1])

        def on_balls(field: Array) -> Array:
            rows = jnp.sum(field, axis=0).reshape(-1, self.balls)
            return jnp.sum(rows, axis=1)

        def on_surfaces(field: Array) -> Array:
            return jnp.sum(field, axis=1)

        return (
            (mapped(on_balls, force), mapped(on_balls, couples)),
            (
                mapped(on_surfaces, vectors.scale(-1.0, force)),
                mapped(on_surfaces, back),
            ),
        )


def _touch(
    samples: Samples, balls: Posed, body: Posed, width: Array
) -> tuple[Array, Array, Vec3, Vec3, tuple[Vec3, Vec3]]:
    """Depth, width, normal, rate and arms of balls against one surface."""

    def world(own: Vec3) -> Vec3:
        return vectors.add(balls.position, to_world(balls.frame, own))

    towards: Vec3 = vectors.split(samples.offsets)
    if samples.rim_radii is not None:
        _, outwards = body.surface(world(towards))
        towards = vectors.scale(-1.0, to_material(balls.frame, outwards))
    centre = world(samples.places(towards))
    distance, normal = body.surface(centre)
    depth = samples.radii - distance
    # Midway between the two surfaces.
    place = vectors.add(centre, vectors.scale(0.5 * depth - samples.radii, normal))
    rate = vectors.subtract(balls.velocity_at(place), body.velocity_at(place))
    arms = (
        vectors.subtract(place, balls.position),
        vectors.subtract(place, body.position),
    )
    return depth, width, normal, rate, arms
