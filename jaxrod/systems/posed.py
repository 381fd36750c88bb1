"""Surfaces of rigid bodies where they are."""

from __future__ import annotations

from jaxtyping import Array

from jaxrod.contacts.bodies import Body
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.parts import Seen


@pytree
class Posed:
    """One rigid body at a moment; every number has an axis of length one."""

    shape: Body
    """Its surface in its own frame."""
    position: Vec3
    """Its origin [m]."""
    frame: tuple[Vec3, Vec3, Vec3]
    """Its axes."""
    velocity: Vec3
    """Of its origin [m/s]."""
    spin: Vec3
    """Its angular velocity [rad/s]."""

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Signed distance [m] and outward normal at points of the world."""
        own = to_material(self.frame, vectors.subtract(points, self.position))
        distance, normal = self.shape.surface(own)
        return distance, to_world(self.frame, normal)

    def velocity_at(self, points: Vec3) -> Vec3:
        """Velocity of what is fixed to the body at points of the world [m/s]."""
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
