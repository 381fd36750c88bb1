"""Surfaces of rigid bodies at their current poses."""

from __future__ import annotations

from jaxtyping import Array

from jaxrod.contacts.bodies import Body
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.members.parts import Seen


@pytree
class Posed:
    """One rigid body at one moment; every number has an axis of length one."""

    shape: Body
    """Surface of the body in its own frame."""
    position: Vec3
    """Origin of the body [m]."""
    frame: tuple[Vec3, Vec3, Vec3]
    """Axes of the body, world frame."""
    velocity: Vec3
    """Velocity of the origin [m/s]."""
    spin: Vec3
    """Angular velocity [rad/s]."""

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Signed distance [m] and outward normal at points in the world frame."""
        own = to_material(self.frame, vectors.subtract(points, self.position))
        distance, normal = self.shape.surface(own)
        return distance, to_world(self.frame, normal)

    def velocity_at(self, points: Vec3) -> Vec3:
        """Velocity of the body's material at points in the world frame [m/s]."""
        arm = vectors.subtract(points, self.position)
        return vectors.add(self.velocity, vectors.cross(self.spin, arm))


def posed(seen: Seen, number: int) -> Posed:
    """One of the bodies of a member."""
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
