r"""Elastic joints: moments between elements of two members, as within a rod.

With $q_a, q_b$ the orientations of the two elements, $\phi$ is the rotation vector of
$(q_a r)^* q_b$ and the energy $\frac12 (\phi - \phi_0)\cdot K (\phi - \phi_0)$. Where
the elements were nearly aligned, $r$ is the identity and $\phi_0$ what they were
turned by at rest: then the joint is one of the rod's own, and two halves of a rod are
the whole. Where they were not, $r$ is their relative orientation and $\phi_0$ zero.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    multiply_quaternions,
    rotation_log_and_coupling,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.elasticity import joint_couples
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling
from jaxrod.systems.loads import sum_of_loads
from jaxrod.systems.parts import Parts, Seen
from jaxrod.systems.places import Points
from jaxrod.systems.rows import picked, summed


@pytree
class ElasticJoint(Coupling):
    """Elastic joints between elements of `a` and elements of `b`, one each."""

    a: Points
    """Elements of the one member."""
    b: Points
    """Elements of the other, or of the same."""
    rest_frames: Float[Array, "4 joints"]
    """Relative orientations that count as none."""
    rest_rotations: Float[Array, "3 joints"]
    """Rotation vectors at rest, in the frames of `b` but for these rotations [rad]."""
    stiffness: Float[Array, "3 joints"] | None = None
    """Stiffness about d1, d2, d3 [N m]; `None`: that of half an element of each rod."""
    damping: Float[Array, ""] | Float[Array, " joints"] | None = None
    """Couple per relative angular velocity, one for all or one for each [N m s]."""

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing or smaller."""
        self.a.check(parts)
        self.b.check(parts)

    def prepared(self, parts: AllParts) -> ElasticJoint:
        """With the stiffness of the rods it joins, where none was given."""
        if self.stiffness is not None:
            return self
        return replace(self, stiffness=natural_stiffness(self.a, self.b, parts))

    def _rotation(self, seen: AllSeen) -> tuple[Vec3, Array, Vec3]:
        """Rotation vector [rad], its coupling, and the moment [N m]."""
        assert self.stiffness is not None
        before = multiply_quaternions(
            orientation_at(seen[self.a.member], self.a),
            split_quaternion(self.rest_frames),
        )
        after = orientation_at(seen[self.b.member], self.b)
        rotation, coupling = rotation_log_and_coupling(
            multiply_quaternions(conjugate(before), after)
        )
        bend = vectors.subtract(rotation, vectors.split(self.rest_rotations))
        moment = vectors.multiply(vectors.split(self.stiffness), bend)
        return rotation, coupling, moment

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """The joints' couples on both elements, and the dashpots'."""
        rotation, coupling, moment = self._rotation(seen)
        odd, even = joint_couples(rotation, coupling, moment)
        # In the frame of the element as it is, not as it counts.
        frame = directors(split_quaternion(self.rest_frames))
        on_a = to_world(frame, vectors.add(odd, even))
        on_b = vectors.subtract(even, odd)
        if self.damping is not None:
            drag_a, drag_b = self._drag(seen)
            on_a, on_b = vectors.add(on_a, drag_a), vectors.add(on_b, drag_b)
        return sum_of_loads(
            (self.a, Loads(couples=on_a)), (self.b, Loads(couples=on_b)), seen=seen
        )

    def _drag(self, seen: AllSeen) -> tuple[Vec3, Vec3]:
        """Couples of the dashpots, in the frames of the elements."""
        assert self.damping is not None
        one, two = seen[self.a.member], seen[self.b.member]
        apart = vectors.subtract(spin_at(two, self.b), spin_at(one, self.a))
        pull = vectors.scale(self.damping, apart)
        frame_a = directors(orientation_at(one, self.a))
        frame_b = directors(orientation_at(two, self.b))
        on_b = to_material(frame_b, pull)
        return to_material(frame_a, pull), vectors.scale(-1.0, on_b)

    def energy(self, seen: AllSeen) -> Array:
        """Elastic energy of the joints [J]."""
        rotation, _, moment = self._rotation(seen)
        bend = vectors.subtract(rotation, vectors.split(self.rest_rotations))
        return 0.5 * jnp.sum(vectors.dot(moment, bend))

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """The stiffness of the joints on both elements."""
        assert self.stiffness is not None
        stiffness = jnp.max(self.stiffness, axis=0)
        return turning_bounds(self.a, self.b, parts, stiffness, self.damping)


def natural_stiffness(a: Points, b: Points, parts: AllParts) -> Float[Array, "3 k"]:
    """Stiffness of half an element of each rod; of a body none is needed [N m]."""
    one, two = parts[a.member], parts[b.member]
    rods = [(p, own) for p, own in ((a, one), (b, two)) if own.is_rod]
    if not rods:
        raise ValueError(
            f"a joint between rigid bodies {a.member!r} and {b.member!r} needs a "
            "stiffness [N m]"
        )
    weighted = length = compliance = jnp.zeros((), rods[0][1].inertias.dtype)
    for points, own in rods:
        assert own.rest_lengths is not None and own.bend_twist_stiffness is not None
        index = points.elements.values
        lengths = own.rest_lengths[index]
        stiffness = own.bend_twist_stiffness[:, index]
        weighted = weighted + stiffness * lengths[None, :]
        compliance = compliance + 0.5 * lengths[None, :] / stiffness
        length = length + lengths
    if any(own.joint_mean == "series" for _, own in rods):
        return 1 / compliance
    # The mean by length, over the length from middle to middle, as within a rod.
    return weighted / length[None, :] / (0.5 * length[None, :])


def orientation_at(seen: Seen, points: Points) -> Quaternion:
    """Orientations of some elements."""
    w, x, y, z = (picked(c, points.elements) for c in seen.motion.orientation)
    return w, x, y, z


def spin_at(seen: Seen, points: Points) -> Vec3:
    """Angular velocities of some elements, world frame [rad/s]."""
    x, y, z = (picked(c, points.elements) for c in seen.angular_velocities)
    return x, y, z


def least_inertia(parts: Parts, points: Points) -> Array:
    """The smallest moment of inertia of some elements [kg m^2]."""
    return jnp.min(parts.inertias, axis=0)[points.elements.values]


def turning_bounds(
    a: Points, b: Points, parts: AllParts, stiffness: Array, damping: Array | None
) -> dict[str, StabilityBound]:
    """Bounds of springs against relative turns: shared by inertia."""
    inertia = least_inertia(parts[a.member], a), least_inertia(parts[b.member], b)
    ease = 1 / inertia[0] + 1 / inertia[1]
    total: dict[str, StabilityBound] = {}
    for points, own in ((a, inertia[0]), (b, inertia[1])):
        size = parts[points.member].inertias.shape[1]
        elements = summed(stiffness * ease * own, points.elements, size)
        drag = None
        if damping is not None:
            drag = summed(damping * ease * own, points.elements, size)
        bound = StabilityBound(elements=elements, element_drag=drag)
        total[points.member] = added_bounds(total.get(points.member), bound)
    return total


def added_bounds(a: StabilityBound | None, b: StabilityBound) -> StabilityBound:
    """Sum of bounds, of which parts may be missing."""
    if a is None:
        return b

    def one(x: Array | None, y: Array | None) -> Array | None:
        if x is None or y is None:
            return y if x is None else x
        return x + y

    return StabilityBound(
        nodes=one(a.nodes, b.nodes),
        elements=one(a.elements, b.elements),
        node_drag=one(a.node_drag, b.node_drag),
        element_drag=one(a.element_drag, b.element_drag),
    )


def world_of(seen: Seen, points: Points, own: Vec3) -> Vec3:
    """World components of vectors given in the frames of some elements."""
    return to_world(directors(orientation_at(seen, points)), own)
