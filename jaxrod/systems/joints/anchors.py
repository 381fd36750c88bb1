"""Anchors: points fixed in elements of rods or in rigid bodies, where forces act.

An anchor on a rod is a node and an offset in the frame of an element there; on a body
it is an offset in the body's frame. A force at a point near the anchor acts on the
node, and the couple of its lever arm on the element. So a force and its reaction at one
point have no total moment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import StabilityBound, added_bounds
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree
from jaxrod.systems.coupling import AllParts, Parts, Seen, turning_mobility
from jaxrod.systems.joints.places import (
    Place,
    Points,
    gather,
    layouts_of,
    least_inertia,
    orientation_at,
    points_of,
    position_of,
    resolved,
    scatter_add,
    spin_at,
)


@pytree
class Anchors:
    """Points fixed on one member.

    Example:
        >>> seen = extend.Seen(scene.as_member().parts(), motion)
        >>> ends = extend.anchors([("arm", "base"), ("arm", "tip")], {"arm": state})
        >>> [part.round(3).tolist() for part in ends.positions(seen)]
        [[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]]
    """

    points: Points
    """Node and element of each anchor."""
    offsets: Float[Array, "3 anchors"]
    """Vectors from the node, or the body's origin, to the anchor, in the frame of the
    element or body [m]."""

    def regridded(self, grids: Any) -> Anchors:
        """The same points on rods with other numbers of elements."""
        offsets = grids.turned_back(self.points, self.offsets)
        return Anchors(self.points.regridded(grids), offsets)

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if the member is missing or has too few nodes."""
        self.points.check(parts)

    def arms(self, seen: Seen) -> Vec3:
        """Vectors from the nodes to the anchors, world frame [m]."""
        frame = directors(orientation_at(seen, self.points))
        return to_world(frame, vectors.split(self.offsets))

    def nodes(self, seen: Seen) -> Vec3:
        """Positions of the nodes, or of the bodies' origins, world frame [m]."""
        x, y, z = (gather(c, self.points.nodes) for c in seen.motion.position)
        return x, y, z

    def positions(self, seen: Seen) -> Vec3:
        """Positions of the anchors, world frame [m]."""
        return vectors.add(self.nodes(seen), self.arms(seen))

    def sizes(self, parts: Parts) -> Array:
        """Radius of the rod at each anchor, or of gyration of a body [m]."""
        if parts.radii is not None:
            return parts.radii[self.points.elements.values]
        index = self.points.elements.values
        gyration = jnp.max(parts.inertias, axis=0) / parts.node_masses
        return jnp.sqrt(gyration[index])

    def velocities(self, seen: Seen, point: Vec3) -> Vec3:
        """Velocity of each element's material at a point, v + w x r [m/s]."""
        x, y, z = (gather(c, self.points.nodes) for c in seen.motion.velocity)
        arm = vectors.subtract(point, self.nodes(seen))
        return vectors.add((x, y, z), vectors.cross(spin_at(seen, self.points), arm))

    def loads(self, seen: Seen, force: Vec3, point: Vec3) -> Loads:
        """Loads of a force [N] at a point [m] near each anchor, world frame.

        The force acts on the anchor's node, and the couple of the lever arm on its
        element.
        """
        arm = vectors.subtract(point, self.nodes(seen))
        frame = directors(orientation_at(seen, self.points))
        return Loads(force, to_material(frame, vectors.cross(arm, force)))

    def mobility(self, parts: Parts, reach: Array | float = 0.0) -> Array:
        """Upper bound on the velocity of each anchor per unit impulse there [1/kg].

        On rods it is `1 / m + r^2 / I`, with the mass `m` of the node, the smallest
        moment of inertia `I` of the element and `r` the length of the offset plus
        `reach`. On rigid bodies the second term is `turning_mobility`.

        Args:
            parts: Constants of the member.
            reach: Largest distance of a point of action from its anchor [m].
        """
        masses = parts.node_masses[self.points.nodes.values]
        arms = vectors.split(self.offsets)
        if parts.is_rigid:
            inertias = parts.inertias[:, self.points.elements.values]
            return 1 / masses + turning_mobility(inertias, arms, reach)
        arm = vectors.safe_norm(arms) + reach
        return 1 / masses + arm * arm / least_inertia(parts, self.points)


def anchors(
    places: Sequence[Place],
    state: Mapping[str, Any],
    *,
    at: Sequence[Array | None] | None = None,
    name: str = "places",
) -> Anchors:
    """Anchors at or near places on one member.

    Args:
        places: Places on the member.
        state: State of the system.
        at: Position `(3,)` of each anchor in `state`, world frame [m]. An entry `None`
            puts the anchor at the node; by default all are at their nodes.
        name: Name of the argument `places` in messages.

    Raises:
        ValueError: If there is no such place.

    Example:
        >>> hook = jnp.array([1.0, 0.0, -0.25])  # 25 cm below the tip
        >>> below = extend.anchors([("arm", "tip")], {"arm": state}, at=[hook])
        >>> round(float(jnp.linalg.norm(below.offsets)), 3)
        0.25
    """
    layouts = layouts_of(state)
    ends = [resolved(name, place, layouts) for place in places]
    points = [None] * len(places) if at is None else at
    offsets = []
    for place, point in zip(places, points, strict=True):
        pose = position_of(name, place, state)
        way = jnp.zeros_like(pose.place) if point is None else point - pose.place
        frame = directors(pose.orientation)
        offsets.append(vectors.join(to_material(frame, vectors.split(way))))
    return Anchors(points_of(name, ends), jnp.stack(offsets, axis=1))


def spring_bounds(
    a: Anchors,
    b: Anchors,
    parts: AllParts,
    stiffness: Array,
    drag: Array | None = None,
    *,
    reach: Array | float = 0.0,
) -> dict[str, StabilityBound]:
    """Stability bounds of springs and dashpots between anchors.

    The elongation of a spring of stiffness $k$ is divided among the nodes and elements
    at its ends in proportion to their inertia. A spring without stress pulls along the
    line through both anchors, so their offsets are its lever arms. A dashpot pulls in
    any direction.

    Args:
        a: Anchors on a member.
        b: Anchors on a second member, or on the same; one for each of `a`.
        parts: Constants of the members.
        stiffness: Largest force per distance, of all springs or of each [N/m].
        drag: Largest force per relative speed, if there is any [kg/s].
        reach: Largest distance from the anchors at which the drag acts [m]: half the
            length of a spring whose dashpot acts in its middle.

    Returns:
        The bounds by member, as `Coupling.stability_bounds` returns them.

    Example:
        >>> ends = ("base", "tip")
        >>> base, tip = (extend.anchors([("arm", end)], {"arm": state}) for end in ends)
        >>> parts = {"arm": scene.as_member().parts()}
        >>> bound = extend.spring_bounds(base, tip, parts, jnp.float32(100.0))["arm"]
        >>> round(float(bound.nodes[0]), 1), round(float(bound.nodes[1]), 1)  # [N/m]
        (200.0, 0.0)
    """
    sides = [(anchor, parts[anchor.points.member]) for anchor in (a, b)]
    ease = sum(anchor.mobility(own) for anchor, own in sides)
    slow = sum(anchor.mobility(own, reach) for anchor, own in sides)
    total: dict[str, StabilityBound] = {}
    for anchor, own in sides:
        points = anchor.points
        masses = own.node_masses[points.nodes.values]
        inertia = jnp.min(own.inertias, axis=0)[points.elements.values]
        sizes = own.n_nodes, own.inertias.shape[1]
        nodes = scatter_add(ease * masses * stiffness, points.nodes, sizes[0])
        elements = scatter_add(ease * inertia * stiffness, points.elements, sizes[1])
        bound = StabilityBound(nodes=nodes, elements=elements)
        if drag is not None:
            bound = replace(
                bound,
                node_drag=scatter_add(slow * masses * drag, points.nodes, sizes[0]),
                element_drag=scatter_add(
                    slow * inertia * drag, points.elements, sizes[1]
                ),
            )
        total[points.member] = added_bounds(total.get(points.member), bound)
    return total
