"""One side of glue: elements of a rod, and the points on them that are glued."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.elastic_joints import least_inertia, orientation_at, spin_at
from jaxrod.systems.parts import Parts, Seen
from jaxrod.systems.places import Indices, Points
from jaxrod.systems.rows import picked, summed


@pytree
class GluedSide:
    """Elements of one rod, and the points of glue on them."""

    points: Points
    """The elements, with their first nodes."""
    offsets: Float[Array, "3 pairs"]
    """Vectors from the middles of the elements to the glue, in their frames [m]."""
    nexts: Indices = static()
    """Next nodes of the elements."""

    def middles(self, seen: Seen, field: Vec3) -> Vec3:
        """Values of a field on nodes at the middles of the elements."""
        x, y, z = (
            0.5 * (picked(c, self.points.nodes) + picked(c, self.nexts)) for c in field
        )
        return x, y, z

    def places(self, seen: Seen) -> Vec3:
        """Points of glue, world frame [m]."""
        frame = directors(orientation_at(seen, self.points))
        arms = to_world(frame, vectors.split(self.offsets))
        return vectors.add(self.middles(seen, seen.motion.position), arms)

    def velocities(self, seen: Seen, place: Vec3) -> Vec3:
        """Velocities of the elements' material at some places [m/s]."""
        arm = vectors.subtract(place, self.middles(seen, seen.motion.position))
        swing = vectors.cross(spin_at(seen, self.points), arm)
        return vectors.add(self.middles(seen, seen.motion.velocity), swing)

    def loads(self, seen: Seen, force: Vec3, place: Vec3) -> tuple[Any, Any]:
        """Loads of forces at some places: on the first nodes, and on the next nodes."""
        arm = vectors.subtract(place, self.middles(seen, seen.motion.position))
        frame = directors(orientation_at(seen, self.points))
        couple = to_material(frame, vectors.cross(arm, force))
        half = vectors.scale(0.5, force)
        others = Points(self.points.member, self.nexts, self.points.elements)
        return (self.points, Loads(half, couple)), (others, Loads(half))

    def mobility(self, parts: Parts) -> Array:
        """Largest velocity at the glue per impulse [1/kg]."""
        first = parts.node_masses[self.points.nodes.values]
        following = parts.node_masses[self.nexts.values]
        arms = vectors.split(self.offsets)
        turning = vectors.dot(arms, arms) / least_inertia(parts, self.points)
        return 0.25 / first + 0.25 / following + turning

    def bound(self, parts: Parts, rate: Array, slow: Array | None) -> StabilityBound:
        """Bound on one side: squared frequency and rate of drag, times inertia.

        Args:
            parts: Constants of the member.
            rate: Stiffness times the mobility of both sides [1/s^2].
            slow: Drag times the mobility of both sides [1/s].
        """
        first = parts.node_masses[self.points.nodes.values]
        following = parts.node_masses[self.nexts.values]
        least = least_inertia(parts, self.points)

        def on_nodes(rate: Array) -> Array:
            size = parts.n_nodes
            one = summed(rate * first, self.points.nodes, size)
            return one + summed(rate * following, self.nexts, size)

        def on_elements(rate: Array) -> Array:
            return summed(rate * least, self.points.elements, parts.inertias.shape[1])

        return StabilityBound(
            nodes=on_nodes(rate),
            elements=on_elements(rate),
            node_drag=None if slow is None else on_nodes(slow),
            element_drag=None if slow is None else on_elements(slow),
        )


def between_surfaces(
    a: GluedSide, b: GluedSide, thicker: Array
) -> tuple[GluedSide, GluedSide]:
    """Glue moved from midway between the axes of rods to midway between their surfaces.

    Args:
        a: Elements of the first rod.
        b: Elements of the second rod.
        thicker: Radii of `a` minus radii of `b` [m].
    """
    half = vectors.safe_norm(vectors.split(a.offsets))
    # If both axes coincide there is no direction in which to move it.
    apart = half > 0
    more = jnp.clip(0.5 * thicker / jnp.where(apart, half, 1), -1, 1)
    share = jnp.where(apart, more, 0)
    return (
        replace(a, offsets=(1 + share)[None, :] * a.offsets),
        replace(b, offsets=(1 - share)[None, :] * b.offsets),
    )
