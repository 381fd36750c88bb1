"""Anchors: points fixed in elements of rods and in rigid bodies, which take forces.

An anchor on a rod is a node and an offset in the frame of an element there; on a body
it is an offset in the body's frame. A force at a point near the anchor acts on the
node, and the couple of its lever arm on the element. So pairs of forces at one point
have no moment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree
from jaxrod.systems.joints.elastic_joints import least_inertia, orientation_at, spin_at
from jaxrod.systems.members.parts import Parts, Seen
from jaxrod.systems.sites.coupling import AllParts
from jaxrod.systems.sites.places import (
    Place,
    Points,
    layouts_of,
    points_of,
    position_of,
    resolved,
)
from jaxrod.systems.sites.rows import picked


@pytree
class Anchors:
    """Points fixed on one member."""

    points: Points
    """Node and element of each anchor."""
    offsets: Float[Array, "3 anchors"]
    """Offsets from the node or the body's origin, in the element's or body's frame [m].
    """

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if the member is missing or too small."""
        self.points.check(parts)

    def arms(self, seen: Seen) -> Vec3:
        """Vectors from the nodes to the anchors, world frame [m]."""
        frame = directors(orientation_at(seen, self.points))
        return to_world(frame, vectors.split(self.offsets))

    def nodes(self, seen: Seen) -> Vec3:
        """Positions of the nodes [m]."""
        x, y, z = (picked(c, self.points.nodes) for c in seen.motion.position)
        return x, y, z

    def positions(self, seen: Seen) -> Vec3:
        """Positions of the anchors, world frame [m]."""
        return vectors.add(self.nodes(seen), self.arms(seen))

    def velocities(self, seen: Seen, point: Vec3) -> Vec3:
        """Velocities of the elements' material at some points [m/s]."""
        x, y, z = (picked(c, self.points.nodes) for c in seen.motion.velocity)
        arm = vectors.subtract(point, self.nodes(seen))
        return vectors.add((x, y, z), vectors.cross(spin_at(seen, self.points), arm))

    def loads(self, seen: Seen, force: Vec3, point: Vec3) -> Loads:
        """Loads on the anchors' nodes and elements, from forces at some points."""
        arm = vectors.subtract(point, self.nodes(seen))
        frame = directors(orientation_at(seen, self.points))
        return Loads(force, to_material(frame, vectors.cross(arm, force)))

    def mobility(self, parts: Parts, reach: Array | float = 0.0) -> Array:
        """Largest velocity at the anchors per impulse [1/kg].

        Args:
            parts: Constants of the member.
            reach: Distance by which forces may act beyond the anchors [m].
        """
        masses = parts.node_masses[self.points.nodes.values]
        arm = vectors.safe_norm(vectors.split(self.offsets)) + reach
        return 1 / masses + arm * arm / least_inertia(parts, self.points)


def anchors(
    name: str,
    places: Sequence[Place],
    at: Sequence[Array | None],
    state: Mapping[str, Any],
) -> Anchors:
    """Anchors at places of one member.

    Args:
        name: Name of the argument, for messages.
        places: Places on the member.
        at: Position of each anchor in `state`, world frame [m]; `None` for the node.
        state: State of the system.
    """
    layouts = layouts_of(state)
    ends = [resolved(name, place, layouts) for place in places]
    offsets = []
    for place, point in zip(places, at, strict=True):
        pose = position_of(name, place, state)
        way = jnp.zeros_like(pose.place) if point is None else point - pose.place
        frame = directors(pose.orientation)
        offsets.append(vectors.join(to_material(frame, vectors.split(way))))
    return Anchors(points_of(name, ends), jnp.stack(offsets, axis=1))
