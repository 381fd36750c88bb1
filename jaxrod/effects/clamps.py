"""Clamped ends of a rod: joined to a wall by an elastic joint, or held rigidly."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect, Reaction, StabilityBound
from jaxrod.effects.ends import (
    End,
    Held,
    Wall,
    at_end,
    check_end,
    check_made_for,
    held_end,
    made_again_for,
    only_at_end,
    place,
    replace_end,
    zero_at_end,
)
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix, skew, subtract
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    join_quaternion,
    multiply_quaternions,
    rotation_exp,
    rotation_log_and_coupling,
    split_quaternion,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.elasticity import joint_couples, turned_joint
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState, check_one
from jaxrod.structure import pytree, static
from jaxrod.validation import check_kind, is_traced

_LARGEST_ANGLE = 2.5
"""Angle above which a wall joint counts as folded, as in `HealthLimits` [rad]."""


@pytree
class Clamp(Effect):
    """Clamped end: end node held in place, end element joined to the frame of a wall.

    The wall is half an element away from the middle of the end element. It therefore
    acts through an elastic joint of that length, with the bending and twisting
    stiffness of the end element. The relative static error of a cantilever of n
    elements is then second order, +0.5/n^2, compared with -1.5/n if the end element
    itself is held.
    """

    orientation: Float[Array, "4"]
    """Frame of the wall: orientation of the end element at rest (w, x, y, z)."""
    end: End = static(default="base")
    """End of the rod that is clamped, "base" or "tip"."""
    position: Float[Array, "3"] | None = None
    """Position of the wall, world frame [m], which only `health` uses. If `None`, the
    distance of the end node from the wall is not checked."""
    made_for: int | None = static(default=None)
    """Number of elements that the rod must have, see `check`; `None` for any number."""

    def check(self, rod: Rod) -> None:
        """Raises ValueError if the rod does not have `made_for` elements."""
        check_made_for("clamp", self.made_for, rod)

    def _joint(self, rod: Rod, orientation: Quaternion) -> tuple[Vec3, Array, Vec3]:
        """Rotation vector [rad], coupling coefficient, moment [N m] of the wall joint.

        The rotation takes the wall's frame to `orientation`, that of the end element.
        The moment is stiffness times rotation, in the material frame. For the
        coefficient see `rotations.rotation_log_and_coupling`.
        """
        wall = conjugate(split_quaternion(self.orientation))
        rotation, coupling = rotation_log_and_coupling(
            multiply_quaternions(wall, orientation)
        )
        stiffness = vectors.split(self._stiffness(rod))
        return rotation, coupling, vectors.multiply(stiffness, rotation)

    def _stiffness(self, rod: Rod) -> Float[Array, "3"]:
        """Stiffness of the joint: that of half an element about d1, d2, d3 [N m]."""
        index = 0 if self.end == "base" else -1
        half = 0.5 * rod.rest_lengths[..., index, None]
        return rod.bend_twist_stiffness[..., index] / half

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Couple of the wall joint on the end element."""
        orientation = at_end(motion.orientation, self.end)
        rotation, coupling, moment = self._joint(rod, orientation)
        odd, even = joint_couples(rotation, coupling, moment)
        return Loads(
            couples=only_at_end(vectors.subtract(even, odd), rod.n_elements, self.end)
        )

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix:
        """Negative derivative of the joint's couple, world frame [N m].

        The derivative is with respect to the rotation of the end element.
        """
        orientation = at_end(motion.orientation, self.end)
        rotation, coupling, moment = self._joint(rod, orientation)
        stiffness = vectors.split(self._stiffness(rod))
        joint = turned_joint(orientation, rotation, coupling, stiffness, moment)
        rows = subtract(joint.stiffness, skew(joint.couple))
        x, y, z = (only_at_end(row, rod.n_elements, self.end) for row in rows)
        return x, y, z

    def wall(self, rod: Rod) -> Wall:
        """Frame of the wall, stiffness of its joint, and clamped end."""
        return Wall(self.orientation, self._stiffness(rod), self.end)

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Sets the velocity of the end node to zero."""
        return replace(motion, velocity=zero_at_end(motion.velocity, self.end))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Largest stiffness of the wall joint, against rotation of the end element."""
        stiffness = jnp.max(self._stiffness(rod))
        return StabilityBound(elements=place(stiffness, rod.n_elements, self.end))

    def resampled(self, rod: Rod, new_rod: Rod) -> Clamp:
        """Clamp for `new_rod`, with the frame of the middle of its end element.

        It differs from the old frame if the rod is curved at rest.
        """
        frame = _frame_at_new_middle(self.orientation, rod, new_rod, self.end)
        return replace(
            self, orientation=frame, made_for=made_again_for(self.made_for, new_rod)
        )

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """The end node along all axes, and the orientation of the end element."""
        return (held_end(self.end),)

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Larger of two ratios: distance over radius, and joint angle over 2.5 rad [1].

        The distance is that of the end node from the wall. `HealthLimits` flags joints
        above 2.5 rad.
        """
        orientation = at_end(split_quaternion(state.orientations), self.end)
        rotation, _, _ = self._joint(rod, orientation)
        folded = vectors.safe_norm(rotation) / _LARGEST_ANGLE
        if self.position is None:
            return folded
        return jnp.maximum(_offset(self.position, self.end, rod, state), folded)

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction:
        """Force that keeps the end node in place, and couple of the wall joint."""
        couples = self.loads(rod, motion).couples
        assert couples is not None
        return _reaction_at(self.end, motion, needed, couples)

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Elastic energy of the wall joint, rotation times moment over two [J]."""
        orientation = at_end(split_quaternion(state.orientations), self.end)
        rotation, _, moment = self._joint(rod, orientation)
        return 0.5 * vectors.dot(rotation, moment)


@pytree
class FixedEnd(Effect):
    """End node and end element held rigidly, as by PyElastica's `OneEndFixedBC`.

    The error is first order in the number of elements (see `Clamp`); for comparisons.
    """

    position: Float[Array, "3"]
    """Position at which the end node is held, world frame [m]."""
    orientation: Float[Array, "4"]
    """Orientation at which the end element is held (w, x, y, z), material to world."""
    end: End = static(default="base")
    """End of the rod that is held, "base" or "tip"."""
    made_for: int | None = static(default=None)
    """Number of elements that the rod must have, see `check`; `None` for any number."""

    def check(self, rod: Rod) -> None:
        """Raises ValueError if the rod does not have `made_for` elements."""
        check_made_for("fixed_end", self.made_for, rod)

    def resampled(self, rod: Rod, new_rod: Rod) -> FixedEnd:
        """Support for `new_rod`, with the frame of the middle of its end element.

        It differs from the old frame if the rod is curved at rest.
        """
        frame = _frame_at_new_middle(self.orientation, rod, new_rod, self.end)
        return replace(
            self, orientation=frame, made_for=made_again_for(self.made_for, new_rod)
        )

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """The end node along all axes, and the orientation of the end element."""
        return (held_end(self.end),)

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Bound on the displacement of the rim of the end section, over the radius [1].

        It is the distance of the end node from the held position over the radius, plus
        twice sin(angle / 2), with the angle from the held orientation.
        """
        actual = at_end(split_quaternion(state.orientations), self.end)
        held = split_quaternion(self.orientation)
        _, x, y, z = multiply_quaternions(conjugate(held), actual)
        turned = 2 * vectors.safe_norm((x, y, z))
        return _offset(self.position, self.end, rod, state) + turned

    def wall(self, rod: Rod) -> Wall:
        """Wall that holds the end element rigidly at its orientation."""
        return Wall(self.orientation, None, self.end)

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction:
        """Force and couple that keep the end node and the end element in place."""
        assert needed.couples is not None
        return _reaction_at(self.end, motion, needed, needed.couples)

    def constrain(self, rod: Rod, motion: Motion) -> Motion:
        """Puts the end node and the end element back where they are held."""
        x, y, z = (
            replace_end(a, b, self.end)
            for a, b in zip(motion.position, self.position, strict=True)
        )
        q0, q1, q2, q3 = (
            replace_end(a, b, self.end)
            for a, b in zip(motion.orientation, self.orientation, strict=True)
        )
        return replace(motion, position=(x, y, z), orientation=(q0, q1, q2, q3))

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Sets the velocity of the end node and the spin of the end element to zero."""
        return replace(
            motion,
            velocity=zero_at_end(motion.velocity, self.end),
            spin=zero_at_end(motion.spin, self.end),
        )


def _reaction_at(end: End, motion: Motion, needed: Loads, couples: Vec3) -> Reaction:
    """Reaction on an end: the force needed there and the support's couple, world frame.

    `needed` balances all other loads; `couples` are those of the support on all
    elements, in the material frame.
    """
    assert needed.forces is not None
    index = 0 if end == "base" else -1
    fx, fy, fz = (component[index] for component in needed.forces)
    cx, cy, cz = (component[index] for component in couples)
    frame = directors(at_end(motion.orientation, end))
    return Reaction.of((fx, fy, fz), to_world(frame, (cx, cy, cz)))


def _offset(place: Array, end: End, rod: Rod, state: RodState) -> Array:
    """Distance of an end node from the point `place`, divided by the radius [1]."""
    index = 0 if end == "base" else -1
    apart = vectors.split(state.positions[:, index] - place)
    return vectors.safe_norm(apart) / rod.radii[index]


def _frame_at_new_middle(orientation: Array, rod: Rod, new_rod: Rod, end: End) -> Array:
    """Orientation of the end element of `new_rod`, from that of `rod`'s end element.

    Both elements begin at the same end but differ in length. The frame is carried along
    the rest curvature from the middle of the old element to that of the new one.
    """
    index, sign = (0, 1) if end == "base" else (-1, -1)
    way = sign * 0.5 * (new_rod.rest_lengths[index] - rod.rest_lengths[index])
    turn = vectors.split(way * rod.rest_curvatures[:, index])
    carried = multiply_quaternions(split_quaternion(orientation), rotation_exp(turn))
    return join_quaternion(carried)


def clamp(state: RodState, end: End = "base") -> Clamp:
    """Clamps one end to a wall at its position and orientation in `state`.

    The end node does not move. The end element is held through an elastic joint, which
    is at rest in `state`; see `Clamp`.

    Args:
        state: The state of the rod.
        end: The end that is held, "base" or "tip".

    Raises:
        ValueError: If there is no such end, or the state is of several rods.
        TypeError: If `state` is not a `RodState`.

    Example:
        >>> built_in = jaxrod.clamp(state), jaxrod.clamp(state, "tip")
        >>> scene = jaxrod.make_scene(rod, *built_in)
        >>> [wall.position.round(3).tolist() for wall in scene.effects]
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    check_kind("state", state, RodState)
    check_one(state)
    index = 0 if check_end(end) == "base" else -1
    count = state.orientations.shape[1]
    frame, place = (_entry(a, index) for a in (state.orientations, state.positions))
    return Clamp(frame, end, place, count)


def _entry(array: Array, index: int) -> Array:
    """Last-axis entry of an array; a known one is read without a compiled program."""
    known = array if is_traced(array) else np.asarray(array)
    return jnp.asarray(known[:, index])


def fixed_end(state: RodState, end: End = "base") -> FixedEnd:
    """Holds one end node and end element where they are in the given state.

    Args:
        state: The state of the rod.
        end: The end that is held, "base" or "tip".

    Raises:
        ValueError: If there is no such end, or the state is of several rods.
        TypeError: If `state` is not a `RodState`.

    Example:
        >>> scene = jaxrod.make_scene(rod, jaxrod.fixed_end(state))
        >>> pushed = replace(state, velocities=jnp.ones_like(state.velocities))
        >>> after = jaxrod.step(scene, pushed, 1e-4)
        >>> after.positions[:, 0].tolist()  # the end does not move
        [0.0, 0.0, 0.0]
    """
    check_kind("state", state, RodState)
    check_one(state)
    index = 0 if check_end(end) == "base" else -1
    count = state.orientations.shape[1]
    return FixedEnd(state.positions[:, index], state.orientations[:, index], end, count)
