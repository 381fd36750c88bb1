r"""Elastic joints: moments between elements of two members.

Let $q_a, q_b$ be the orientations of the two elements and $\phi$ the rotation vector of
$(q_a r)^* q_b$. The energy is $\frac12 (\phi - \phi_0)\cdot K (\phi - \phi_0)$. For two
rods $r$ is their relative orientation at rest and $\phi_0$ is zero. The joint that
closes a ring keeps the curvature of its rod in $\phi_0$. The stiffness $K$ is that of
half an element of each rod, as springs in series, each about the axes of its section:

$$K^{-1} = \tfrac12 l_a R^T B_a^{-1} R + \tfrac12 l_b B_b^{-1}$$

with $R$ the matrix of $r$, and $l$ and $B$ the length and the bending and twisting
stiffness of an element. So the joint depends neither on the order of the two members
nor on the axes in which sections are described.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import StabilityBound, added_bounds
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix, transpose, turned_diagonal
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    join_quaternion,
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
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling, Parts
from jaxrod.systems.joints.places import (
    Place,
    Points,
    layouts_of,
    least_inertia,
    orientation_at,
    points_of,
    position_of,
    resolved,
    scatter_add,
    spin_at,
    sum_of_loads,
)


@pytree
class ElasticJoint(Coupling):
    """Elastic joints against rotation of elements of `b` relative to those of `a`."""

    a: Points
    """Elements of the first member, one for each joint."""
    b: Points
    """Elements of the second member, or of the same member, one for each joint."""
    rest_frames: Float[Array, "4 joints"]
    """Relative orientation of `b` in the frame of `a` at which the rotation vector is
    zero: quaternions (w, x, y, z)."""
    rest_rotations: Float[Array, "3 joints"]
    """Rotation vectors at which the joints exert no moment, in the frame of `b` [rad].
    """
    stiffness: Float[Array, "3 joints"] | None = None
    """Stiffness about d1, d2 and d3 of `b` [N m]; if `None`, that of half an element of
    each rod, in series."""
    mixed_stiffness: Float[Array, "3 joints"] | None = None
    """Off-diagonal stiffness for the axes d2 and d3, d3 and d1, d1 and d2 [N m]; zero
    if `None`."""
    damping: Float[Array, ""] | Float[Array, " joints"] | None = None
    """Couple per relative angular velocity, one for all joints or one for each [N m s];
    if `None`, there is no damping."""

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing or has too few nodes."""
        self.a.check(parts)
        self.b.check(parts)

    def regridded(self, grids: Any) -> ElasticJoint:
        """Copy for rods with other numbers of elements.

        The rotation at rest between the elements is that of the old ones, carried to
        the middles of the new ones. The joint of a ring is bent at rest, like those
        between all its elements, in proportion to their length.
        """
        made = replace(self, a=self.a.regridded(grids), b=self.b.regridded(grids))
        if np.any(np.asarray(self.rest_rotations) != 0):
            was, now = (
                sum(lengths)
                for lengths in zip(
                    *(grids.lengths(side) for side in (self.a, self.b)), strict=True
                )
            )
            bent = jnp.asarray(now / was)[None] * self.rest_rotations
            return replace(made, rest_rotations=bent.astype(self.rest_rotations.dtype))
        frame = conjugate(grids.turns(self.a))
        for turn in (split_quaternion(self.rest_frames), grids.turns(self.b)):
            frame = multiply_quaternions(frame, turn)
        frames = join_quaternion(frame).astype(self.rest_frames.dtype)
        return replace(made, rest_frames=frames)

    def prepared(self, parts: AllParts) -> ElasticJoint:
        """Copy with the stiffness of its rods, unless a stiffness was given."""
        if self.stiffness is not None:
            return self
        frames = split_quaternion(self.rest_frames)
        own, mixed = natural_stiffness(self.a, self.b, frames, parts)
        return replace(self, stiffness=own, mixed_stiffness=mixed)

    def _rotation(self, seen: AllSeen) -> tuple[Vec3, Array, Vec3]:
        """Rotation vectors phi [rad], factors for `joint_couples`, and moments [N m].

        phi rotates the frame of `a`, turned by `rest_frames`, to that of `b`. The
        moment is K (phi - phi_0).
        """
        before = multiply_quaternions(
            orientation_at(seen[self.a.member], self.a),
            split_quaternion(self.rest_frames),
        )
        after = orientation_at(seen[self.b.member], self.b)
        rotation, coupling = rotation_log_and_coupling(
            multiply_quaternions(conjugate(before), after)
        )
        bend = vectors.subtract(rotation, vectors.split(self.rest_rotations))
        return rotation, coupling, self._moment(bend)

    def _moment(self, bend: Vec3) -> Vec3:
        """Moments: stiffness times the rotation `bend` from rest [N m]."""
        assert self.stiffness is not None
        moment = vectors.multiply(vectors.split(self.stiffness), bend)
        if self.mixed_stiffness is None:
            return moment
        k23, k31, k12 = vectors.split(self.mixed_stiffness)
        x, y, z = bend
        more = (k12 * y + k31 * z, k12 * x + k23 * z, k31 * x + k23 * y)
        return vectors.add(moment, more)

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Couples of joints and dashpots on both elements of each joint."""
        rotation, coupling, moment = self._rotation(seen)
        odd, even = joint_couples(rotation, coupling, moment)
        # Rotates from the frame of `a` turned by `rest_frames` to the frame of `a`.
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
        """Couples of dashpots on `a` and on `b`, each in its material frame [N m]."""
        assert self.damping is not None
        one, two = seen[self.a.member], seen[self.b.member]
        apart = vectors.subtract(spin_at(two, self.b), spin_at(one, self.a))
        pull = vectors.scale(self.damping, apart)
        frame_a = directors(orientation_at(one, self.a))
        frame_b = directors(orientation_at(two, self.b))
        on_b = to_material(frame_b, pull)
        return to_material(frame_a, pull), vectors.scale(-1.0, on_b)

    def energy(self, seen: AllSeen) -> Array:
        """Elastic energy, 1/2 (phi - phi_0) . K (phi - phi_0), of rotations phi [J]."""
        rotation, _, moment = self._rotation(seen)
        bend = vectors.subtract(rotation, vectors.split(self.rest_rotations))
        return 0.5 * jnp.sum(vectors.dot(moment, bend))

    def joint_angle(self, seen: AllSeen) -> Array:
        """Largest rotation of a joint from rest, |phi - phi_0| [rad]."""
        rotation, _, _ = self._rotation(seen)
        bend = vectors.subtract(rotation, vectors.split(self.rest_rotations))
        return jnp.max(vectors.safe_norm(bend))

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stability bounds on the elements of both members, by member."""
        assert self.stiffness is not None
        stiffness = jnp.max(self.stiffness, axis=0)
        if self.mixed_stiffness is not None:
            # The stiffness about any axis is at most the largest row sum, and at most
            # the trace.
            k23, k31, k12 = jnp.abs(self.mixed_stiffness)
            rows = self.stiffness + jnp.stack([k12 + k31, k12 + k23, k31 + k23])
            trace = jnp.sum(self.stiffness, axis=0)
            stiffness = jnp.minimum(jnp.max(rows, axis=0), trace)
        return turning_bounds(self.a, self.b, parts, stiffness, self.damping)


def elastic_joints(
    a: Sequence[Place], b: Sequence[Place], state: Mapping[str, Any]
) -> list[ElasticJoint]:
    """Elastic joints at rest in a state, one `ElasticJoint` per pair of members."""
    layouts = layouts_of(state)
    sorted_pairs: dict[tuple[str, str], list[int]] = {}
    ends = [
        (resolved("a", one, layouts), resolved("b", two, layouts))
        for one, two in zip(a, b, strict=True)
    ]
    for k, (one, two) in enumerate(ends):
        sorted_pairs.setdefault((one[0], two[0]), []).append(k)
    joints = []
    for which in sorted_pairs.values():
        frames = jnp.stack(
            [
                join_quaternion(
                    multiply_quaternions(
                        conjugate(position_of("a", a[k], state).orientation),
                        position_of("b", b[k], state).orientation,
                    )
                )
                for k in which
            ],
            axis=1,
        )
        joints.append(
            ElasticJoint(
                a=points_of("a", [ends[k][0] for k in which]),
                b=points_of("b", [ends[k][1] for k in which]),
                rest_frames=frames,
                rest_rotations=jnp.zeros_like(frames[1:]),
            )
        )
    return joints


def natural_stiffness(
    a: Points, b: Points, frames: Quaternion, parts: AllParts
) -> tuple[Float[Array, "3 k"], Float[Array, "3 k"] | None]:
    """Stiffness of half an element of each rod, in series; bodies are rigid [N m].

    Args:
        a: Elements of the first member.
        b: Elements of the second member.
        frames: Orientations of `b` relative to `a` that count as zero rotation.
        parts: Constants of the members.

    Returns:
        Stiffness about the axes of `b`, and the mixed stiffness for d2 and d3, d3 and
        d1, d1 and d2, or `None` if it is zero.

    Raises:
        ValueError: If both members are rigid bodies.
    """
    of_a, of_b = (
        _half_compliance(parts[a.member], a),
        _half_compliance(parts[b.member], b),
    )
    if of_b is None and of_a is None:
        raise ValueError(
            f"a joint between rigid bodies {a.member!r} and {b.member!r} needs a "
            "stiffness [N m]"
        )
    if of_a is None:
        assert of_b is not None
        return 1 / jnp.stack(of_b), None
    # The rows are the axes of `a` in the frame of `b`.
    axes = transpose(directors(frames))
    compliance = turned_diagonal(axes, of_a)
    if of_b is not None:
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = compliance
        x, y, z = of_b
        compliance = (xx + x, xy, xz), (yx, yy + y, yz), (zx, zy, zz + z)
    return _inverse(compliance)


def _half_compliance(own: Parts, points: Points) -> Vec3 | None:
    """Compliance of half an element about d1, d2, d3 [1/(N m)]; `None` for bodies."""
    if not own.is_rod:
        return None
    assert own.rest_lengths is not None and own.bend_twist_stiffness is not None
    index = points.elements.values
    lengths = own.rest_lengths[index]
    x, y, z = (0.5 * lengths / k for k in own.bend_twist_stiffness[:, index])
    return x, y, z


def _inverse(matrix: Matrix) -> tuple[Array, Array]:
    """Diagonal and off-diagonal entries of the inverse of positive definite matrices.

    It is computed from the factors $L D L^T$. These are exact to round-off even for
    flat sections, whose stiffnesses differ by orders of magnitude.
    """
    (a, b, c), (_, d, e), (_, _, f) = matrix
    # Rows of L, and the diagonal D.
    l21, l31 = b / a, c / a
    second = d - l21 * b
    l32 = (e - l31 * b) / second
    third = f - l31 * c - l32 * l32 * second
    # Columns of the inverse of L: (1, m21, m31), (0, 1, m32).
    m21, m32 = -l21, -l32
    m31 = l21 * l32 - l31
    own = (
        1 / a + m21 * m21 / second + m31 * m31 / third,
        1 / second + m32 * m32 / third,
        1 / third,
    )
    mixed = (m32 / third, m31 / third, m21 / second + m31 * m32 / third)
    return jnp.stack(own), jnp.stack(mixed)


def turning_bounds(
    a: Points, b: Points, parts: AllParts, stiffness: Array, damping: Array | None
) -> dict[str, StabilityBound]:
    r"""Stability bounds of springs and dashpots against relative rotation.

    For elements with the smallest moments of inertia $I_a$ and $I_b$ and the stiffness
    $k$, the bound on element $i$ is $k\,(1/I_a + 1/I_b)\,I_i$. The same holds for
    damping.
    """
    inertia = least_inertia(parts[a.member], a), least_inertia(parts[b.member], b)
    ease = 1 / inertia[0] + 1 / inertia[1]
    total: dict[str, StabilityBound] = {}
    for points, own in ((a, inertia[0]), (b, inertia[1])):
        size = parts[points.member].inertias.shape[1]
        elements = scatter_add(stiffness * ease * own, points.elements, size)
        drag = None
        if damping is not None:
            drag = scatter_add(damping * ease * own, points.elements, size)
        bound = StabilityBound(elements=elements, element_drag=drag)
        total[points.member] = added_bounds(total.get(points.member), bound)
    return total
