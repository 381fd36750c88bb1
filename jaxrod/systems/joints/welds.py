r"""Welds: rods joined to rods, and to rigid bodies, at a fixed relative angle.

Nodes of rods can be part of a rigid body. A node attached at the position $p$ in the
frame of a body moves exactly with the body: $x = X + R p$, $v = V + \omega\times R p$.
The node's mass is included in the body's mass, centre of mass and inertia. The body
takes the impulse of every kick of the node, $J = m\,\Delta v$ at $x$, so momentum is
conserved exactly. Added inertia does not limit the time step. Any number of nodes can
be attached to one body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.geometry import matrices, vectors
from jaxrod.geometry.rotations import (
    directors,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.structure import pytree
from jaxrod.systems.coupling import AllParts, AllSeen, Carried, Coupling, Seen
from jaxrod.systems.joints.elastic_joints import elastic_joints
from jaxrod.systems.joints.places import (
    Indices,
    Place,
    Points,
    gather,
    layouts_of,
    orientation_at,
    pairs,
    points_of,
    position_of,
    resolved,
    scatter_add,
    scatter_set,
    spin_at,
    sum_of_loads,
)
from jaxrod.systems.joints.ties import tie
from jaxrod.validation import is_traced


def weld(
    a: Place | Sequence[Place], b: Place | Sequence[Place], state: Mapping[str, Any]
) -> tuple[Coupling, ...]:
    """Joins rods: nodes become one, and an elastic joint connects their elements.

    The joint is half an element of each rod, as two springs in series that are at rest
    in `state`, each about the axes of its own section. The order of `a` and `b` does
    not matter. Two halves of a rod welded end to end are equivalent to the whole rod.
    If the elements at the weld differ, as in a tapered rod, this holds only for a whole
    rod with `joint_mean="series"`.

    Args:
        a: A place, `("trunk", "tip")` or `("arms", 2, 7)`; or several.
        b: The place to which `a` is joined; or one for each place of `a`.
        state: State of the system at rest.

    Returns:
        Couplings for `make_system`.

    Raises:
        ValueError: If there is no such place, or two joined nodes are apart.
        TypeError: If a place is not a sequence such as `("arm", "tip")`.

    Example:
        >>> left = replace(state, positions=state.positions.at[0].add(-1.0))
        >>> states = {"left": left, "right": state}  # end to end
        >>> joint = systems.weld(("left", "tip"), ("right", "base"), states)
        >>> loose = jaxrod.make_scene(rod)
        >>> system = jaxrod.make_system({"left": loose, "right": loose}, joint)
        >>> len(system.couplings)  # one for the shared node, one for the angle
        2
    """
    first, second = pairs(a, b)
    joints = elastic_joints(first, second, state)
    return (tie(first, second, state), *joints)


def attach(
    a: Place | Sequence[Place],
    b: Place | Sequence[Place],
    state: Mapping[str, Any],
    *,
    turning: bool = False,
) -> tuple[Coupling, ...]:
    """Makes nodes of rods part of a rigid body, at their places in `state`.

    The attachment is exact and does not limit the time step: the body carries the
    nodes' masses. An elastic joint holds the element at its angle to the body, as a
    clamp would, unless `turning` is set.

    Args:
        a: A place on a rod, `("arm", "base")`; or several of one member.
        b: A body, `("head",)`; or one for each place of `a`.
        state: State of the system at rest.
        turning: Whether the elements turn freely about their nodes.

    Returns:
        Couplings for `make_system`.

    Raises:
        ValueError: If there is no such place.
        TypeError: If a place is not a sequence such as `("arm", "tip")`.

    Example:
        >>> shape = shapes.sphere((1.0, 0.0, 0.0), radius=0.1)
        >>> ball, there = systems.rigid_body(shape, density=1000.0)
        >>> states = {"arm": state, "ball": there}
        >>> held = systems.attach(("arm", "tip"), ("ball",), states)
        >>> system = jaxrod.make_system({"arm": scene, "ball": ball}, held)
        >>> list(system.couplings[0].joined_nodes())  # the tip is part of the ball
        [('arm', 10)]
    """
    first = pairs(a, a)[0]
    second = pairs(b, b)[0]
    if len(second) == 1:
        second = second * len(first)
    first, second = pairs(first, second)
    fixed = attachment(first, second, state)
    if turning:
        return (fixed,)
    return (fixed, *elastic_joints(second, first, state))


@pytree
class Attachment(Coupling):
    """Nodes that are part of bodies; see `attach`."""

    points: Points
    """The attached nodes, with their elements."""
    bodies: Points
    """The body to which each node is attached."""
    places: Float[Array, "3 nodes"]
    """Position of each node in its body's frame [m]."""

    @property
    def followed(self) -> str:
        """Name of the member that contains the bodies."""
        return self.bodies.member

    def joined_nodes(self) -> list[tuple[str, int]]:
        """All attached nodes, as pairs of a member and a node."""
        return [(self.points.member, int(i)) for i in self.points.nodes.values]

    def check(self, parts: AllParts) -> None:
        """Validates the members.

        Raises:
            ValueError: If members are missing, of the wrong kind or have too few nodes,
                or if a support holds one of the nodes.
        """
        self.points.check(parts)
        self.bodies.check(parts)
        if not (
            parts[self.points.member].is_rod and parts[self.bodies.member].is_rigid
        ):
            raise ValueError(
                f"attach joins rods to a rigid body, got {self.points.member!r} and "
                f"{self.bodies.member!r}; weld and tie join rods"
            )
        held = parts[self.points.member].held
        if held is None or is_traced(held):
            return
        index = self.points.nodes.values
        if any(bool(np.any(np.asarray(c)[index] > 0)) for c in held):
            raise ValueError(
                f"a node of {self.points.member!r} is held by a support and attached "
                f"to {self.bodies.member!r}: it can follow one only"
            )

    def carried(self, parts: AllParts) -> dict[str, Carried]:
        """Mass and moments of mass of the nodes, summed for each body."""
        masses = parts[self.points.member].node_masses[self.points.nodes.values]
        place = vectors.split(self.places)
        weighted = vectors.scale(masses, place)
        count = parts[self.bodies.member].count

        def total(field: Array) -> Array:
            return scatter_add(field, self.bodies.elements, count)

        x, y, z = (total(component) for component in weighted)
        one, two, three = (
            (total(row[0]), total(row[1]), total(row[2]))
            for row in matrices.outer(weighted, place)
        )
        own = Carried(total(masses), (x, y, z), (one, two, three))
        return {self.bodies.member: own}

    def _arms(self, seen: Seen) -> Vec3:
        """Vectors from the bodies' origins to the nodes, world frame [m]."""
        frame = directors(orientation_at(seen, self.bodies))
        return to_world(frame, vectors.split(self.places))

    def _velocities(self, seen: Seen, arms: Vec3) -> Vec3:
        x, y, z = (gather(c, self.bodies.nodes) for c in seen.motion.velocity)
        swing = vectors.cross(spin_at(seen, self.bodies), arms)
        return vectors.add((x, y, z), swing)

    def constrain(self, seen: AllSeen) -> dict[str, Motion]:
        """Moves the nodes to their positions on the bodies; sets their velocities."""
        body = seen[self.bodies.member]
        arms = self._arms(body)
        x, y, z = (gather(c, self.bodies.nodes) for c in body.motion.position)
        place = vectors.add((x, y, z), arms)
        motion = seen[self.points.member].motion
        nodes = self.points.nodes
        moved = replace(
            motion,
            position=_put(motion.position, nodes, place),
            velocity=_put(motion.velocity, nodes, self._velocities(body, arms)),
        )
        if motion.remainder is not None:
            zero = vectors.scale(0.0, place)
            moved = replace(moved, remainder=_put(motion.remainder, nodes, zero))
        return {self.points.member: moved}

    def constrain_rates(self, seen: AllSeen) -> dict[str, Motion]:
        """Gives the nodes the velocities of their positions on the bodies."""
        body = seen[self.bodies.member]
        motion = seen[self.points.member].motion
        velocity = self._velocities(body, self._arms(body))
        nodes = self.points.nodes
        changed = replace(motion, velocity=_put(motion.velocity, nodes, velocity))
        return {self.points.member: changed}

    def exchange(self, before: AllSeen, after: AllSeen) -> dict[str, Loads]:
        """Impulses that the kick gave to the nodes, passed on to their bodies.

        For a node of mass m the impulse is `m (v_after - v_before)`, with its velocity
        v before and after the kick. It acts on the body at the node, so it has a couple
        about the body's origin.
        """
        name, nodes = self.points.member, self.points.nodes
        masses = gather(before[name].parts.node_masses, nodes)
        was, now = before[name].motion.velocity, after[name].motion.velocity
        gained = vectors.subtract(now, was)
        x, y, z = (masses * gather(component, nodes) for component in gained)
        couple = vectors.cross(self._arms(before[self.bodies.member]), (x, y, z))
        return sum_of_loads((self.bodies, Loads((x, y, z), couple)), seen=before)

    def constraint_loads(
        self, seen: AllSeen, rates: Mapping[str, Motion]
    ) -> dict[str, Loads]:
        """Forces that make the nodes follow the bodies, and their opposites there."""
        body, own = seen[self.bodies.member], seen[self.points.member]
        arms, spin = self._arms(body), spin_at(body, self.bodies)
        led, turned = rates[self.bodies.member].velocity, rates[self.bodies.member].spin
        x, y, z = (gather(c, self.bodies.nodes) for c in led)
        a, b, c = (gather(c, self.bodies.elements) for c in turned)
        swing = vectors.add(
            vectors.cross((a, b, c), arms),
            vectors.cross(spin, vectors.cross(spin, arms)),
        )
        needed = vectors.add((x, y, z), swing)
        free = rates[self.points.member].velocity
        u, v, w = (gather(c, self.points.nodes) for c in free)
        masses = gather(own.parts.node_masses, self.points.nodes)
        pull = vectors.scale(masses, vectors.subtract(needed, (u, v, w)))
        back = vectors.scale(-1.0, pull)
        frame = directors(orientation_at(body, self.bodies))
        couple = to_material(frame, vectors.cross(arms, back))
        return sum_of_loads(
            (self.points, Loads(pull)), (self.bodies, Loads(back, couple)), seen=seen
        )

    def violation(self, seen: AllSeen) -> Array:
        """Largest distance of a node from its point on the body, in rod radii [1].

        The radius is the smallest of the rods.
        """
        body, own = seen[self.bodies.member], seen[self.points.member]
        x, y, z = (gather(c, self.bodies.nodes) for c in body.motion.position)
        place = vectors.add((x, y, z), self._arms(body))
        at, bt, ct = (gather(c, self.points.nodes) for c in own.motion.position)
        apart = vectors.safe_norm(vectors.subtract((at, bt, ct), place))
        assert own.parts.radii is not None
        return jnp.max(apart) / jnp.min(own.parts.radii)


def _put(field: Vec3, index: Indices, value: Vec3) -> Vec3:
    x, y, z = (scatter_set(a, index, b) for a, b in zip(field, value, strict=True))
    return x, y, z


def attachment(
    places: Sequence[Place], bodies: Sequence[Place], state: Mapping[str, Any]
) -> Attachment:
    """Attachment of nodes to bodies, at their relative positions in a state.

    Args:
        places: Nodes of one member, such as `("arm", "tip")`.
        bodies: Bodies of one member, one for each node.
        state: State of the system.
    """
    layouts = layouts_of(state)
    nodes = [resolved("a", place, layouts) for place in places]
    owners = [resolved("b", place, layouts) for place in bodies]
    offsets = []
    for place, body in zip(places, bodies, strict=True):
        origin = position_of("b", body, state)
        way = position_of("a", place, state).place - origin.place
        frame = directors(origin.orientation)
        offsets.append(vectors.join(to_material(frame, vectors.split(way))))
    return Attachment(
        points_of("a", nodes), points_of("b", owners), jnp.stack(offsets, axis=1)
    )
