"""PyElastica's joint of rods side by side, as a coupling here."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree
from jaxrod.systems.coupling import AllSeen, Seen
from jaxrod.systems.joints.glue import Glue, GluedSide
from jaxrod.systems.joints.places import Points, gather, orientation_at, sum_of_loads


@pytree
class SurfaceJoint(Glue):
    """Glue as PyElastica has it, without its repulsion.

    Arms change with the radius of what is stretched, each force acts at its own end
    of the gap, and dashpots see middles of elements. Angular momentum is not kept.
    """

    def energy(self, seen: AllSeen) -> Array:
        """None: its forces are no gradient."""
        # Not `Glue.energy`, whose arms do not change with the radius.
        raise NotImplementedError("PyElastica's joint side by side has no energy")

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on both rods."""
        one, two = seen[self.a.points.member], seen[self.b.points.member]
        first, arm = _middles_and_arms(self.a, one)
        second, other_arm = _middles_and_arms(self.b, two)
        apart = vectors.subtract(second, first)
        gap = vectors.add(apart, vectors.subtract(other_arm, arm))
        assert self.lengths is not None
        spring = vectors.scale(self.stiffness * self.lengths, gap)
        force = spring
        if self.damping is not None:
            rate = vectors.subtract(
                self.b.middles(two, two.motion.velocity),
                self.a.middles(one, one.motion.velocity),
            )
            drag = vectors.scale(self.damping * self.lengths, rate)
            force = vectors.add(spring, drag)
        return sum_of_loads(
            *_loads(self.a, one, force, vectors.cross(arm, spring)),
            *_loads(
                self.b,
                two,
                vectors.scale(-1.0, force),
                vectors.cross(spring, other_arm),
            ),
            seen=seen,
        )


def surface_joint(made: Glue) -> SurfaceJoint:
    """The joint of glue that is the same at rest.

    Raises:
        ValueError: If that resists turning: theirs does not.
    """
    if made.turning_stiffness is not None:
        raise ValueError("PyElastica's joint side by side has no turning_stiffness")
    return SurfaceJoint(
        **{each.name: getattr(made, each.name) for each in fields(made)}
    )


def _middles_and_arms(side: GluedSide, seen: Seen) -> tuple[Vec3, Vec3]:
    """Middles of elements, and from there to the joint [m]."""
    nodes, nexts = side.points.nodes, side.nexts
    x, y, z = (gather(c, nexts) - gather(c, nodes) for c in seen.motion.position)
    rest: Any = seen.parts.rest_lengths
    lengths = jnp.sqrt(x * x + y * y + z * z)
    thinner: Array = jnp.sqrt(gather(rest, side.points.elements) / lengths)
    frame = directors(orientation_at(seen, side.points))
    arms = vectors.scale(thinner, to_world(frame, vectors.split(side.offsets)))
    return side.middles(seen, seen.motion.position), arms


def _loads(side: GluedSide, seen: Seen, force: Vec3, couple: Vec3) -> Any:
    """Half of a force on both nodes, and a couple of the world frame."""
    frame = directors(orientation_at(seen, side.points))
    half = vectors.scale(0.5, force)
    others = Points(side.points.member, side.nexts, side.points.elements)
    return (side.points, Loads(half, to_material(frame, couple))), (
        others,
        Loads(half),
    )
