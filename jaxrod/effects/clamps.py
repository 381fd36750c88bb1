"""Held ends: a wall that acts through half an element; an element held rigidly."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect, Reaction, StabilityBound
from jaxrod.effects.ends import (
    End,
    Wall,
    at_end,
    check_end,
    check_made_for,
    made_again_for,
    only_at_end,
    place,
    replace_end,
    zero_at_end,
)
from jaxrod.effects.held import Held, held_end
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
from jaxrod.validation import check_kind

_LARGEST_ANGLE = 2.5
"""Angle above which a wall joint counts as folded, as in `HealthLimits` [rad]."""


@pytree
class Clamp(Effect):
    """A wall: the end node held in place, the end element joined to the wall's frame.

    Between wall and end element lies half an element. The wall therefore acts through
    an elastic joint of that length, with the end element's own bending stiffness. The
    static error is then second order in the number of elements: +0.5/n^2 for a
    cantilever, compared with -1.5/n if the end element itself is held.
    """

    orientation: Float[Array, "4"]
    """Frame of the wall: the end element's orientation at rest (w, x, y, z)."""
    end: End = static(default="base")
    """The end that is clamped."""
    position: Float[Array, "3"] | None = None
    """Position of the wall [m], used by `health` only. `None`: that of the end node."""
    made_for: int | None = static(default=None)
    """Number of elements of the state it was made from; `None` if not known."""

    def check(self, rod: Rod) -> None:
        """Raises ValueError if it was made from a state of another rod."""
        check_made_for("clamp", self.made_for, rod)

    def _joint(self, rod: Rod, orientation: Quaternion) -> tuple[Vec3, Array, Vec3]:
        """Rotation from the wall to the end element, coupling, and moment [N m]."""
        wall = conjugate(split_quaternion(self.orientation))
        rotation, coupling = rotation_log_and_coupling(
            multiply_quaternions(wall, orientation)
        )
        stiffness = vectors.split(self._stiffness(rod))
        return rotation, coupling, vectors.multiply(stiffness, rotation)

    def _stiffness(self, rod: Rod) -> Float[Array, "3"]:
        """Stiffness of the joint [N m], equal to that of half an element."""
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
        """Tangent of the joint's couple on the end element."""
        orientation = at_end(motion.orientation, self.end)
        rotation, coupling, moment = self._joint(rod, orientation)
        stiffness = vectors.split(self._stiffness(rod))
        joint = turned_joint(orientation, rotation, coupling, stiffness, moment)
        rows = subtract(joint.stiffness, skew(joint.couple))
        x, y, z = (only_at_end(row, rod.n_elements, self.end) for row in rows)
        return x, y, z

    def wall(self, rod: Rod) -> Wall:
        """The wall and its joint."""
        return Wall(self.orientation, self._stiffness(rod), self.end)

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Stops the end node."""
        return replace(motion, velocity=zero_at_end(motion.velocity, self.end))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Stiffness of the wall joint, on the end element."""
        stiffness = jnp.max(self._stiffness(rod))
        return StabilityBound(elements=place(stiffness, rod.n_elements, self.end))

    def resampled(self, rod: Rod, new_rod: Rod) -> Clamp:
        """Clamp for the new end element, whose middle has another frame if curved."""
        frame = _frame_at_new_middle(self.orientation, rod, new_rod, self.end)
        return replace(
            self, orientation=frame, made_for=made_again_for(self.made_for, new_rod)
        )

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """The end node and the end element."""
        return (held_end(self.end),)

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Larger of the end node's distance from the wall and the joint's angle.

        It is one at a distance of one radius, or at the angle at which joints are
        flagged.
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
        """Elastic energy of the wall joint [J]."""
        orientation = at_end(split_quaternion(state.orientations), self.end)
        rotation, _, moment = self._joint(rod, orientation)
        return 0.5 * vectors.dot(rotation, moment)


@pytree
class FixedEnd(Effect):
    """The end node and the whole end element held: PyElastica's `OneEndFixedBC`.

    It is first order in the number of elements (see `Clamp`); for comparisons.
    """

    position: Float[Array, "3"]
    """Position at which the end node is held [m]."""
    orientation: Float[Array, "4"]
    """Orientation at which the end element is held (w, x, y, z)."""
    end: End = static(default="base")
    """The end that is held."""
    made_for: int | None = static(default=None)
    """Number of elements of the state it was made from; `None` if not known."""

    def check(self, rod: Rod) -> None:
        """Raises ValueError if it was made from a state of another rod."""
        check_made_for("fixed_end", self.made_for, rod)

    def resampled(self, rod: Rod, new_rod: Rod) -> FixedEnd:
        """Support for the new end element, whose middle has another frame if curved."""
        frame = _frame_at_new_middle(self.orientation, rod, new_rod, self.end)
        return replace(
            self, orientation=frame, made_for=made_again_for(self.made_for, new_rod)
        )

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """The end node and the end element."""
        return (held_end(self.end),)

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Displacement of the end section's rim from where it is held, over the radius.

        It is the end node's distance over the radius plus twice sin(angle / 2).
        """
        actual = at_end(split_quaternion(state.orientations), self.end)
        held = split_quaternion(self.orientation)
        _, x, y, z = multiply_quaternions(conjugate(held), actual)
        turned = 2 * vectors.safe_norm((x, y, z))
        return _offset(self.position, self.end, rod, state) + turned

    def wall(self, rod: Rod) -> Wall:
        """The end element itself, held rigidly."""
        return Wall(self.orientation, None, self.end)

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction:
        """Force and couple that keep the end node and the end element in place."""
        assert needed.couples is not None
        return _reaction_at(self.end, motion, needed, needed.couples)

    def constrain(self, rod: Rod, motion: Motion) -> Motion:
        """Puts the end node and end element back."""
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
        """Stops the end node and the end element."""
        return replace(
            motion,
            velocity=zero_at_end(motion.velocity, self.end),
            spin=zero_at_end(motion.spin, self.end),
        )


def _reaction_at(end: End, motion: Motion, needed: Loads, couples: Vec3) -> Reaction:
    """Reaction of the force needed at an end node and a couple on the end element."""
    assert needed.forces is not None
    index = 0 if end == "base" else -1
    fx, fy, fz = (component[index] for component in needed.forces)
    cx, cy, cz = (component[index] for component in couples)
    frame = directors(at_end(motion.orientation, end))
    return Reaction.of((fx, fy, fz), to_world(frame, (cx, cy, cz)))


def _offset(place: Array, end: End, rod: Rod, state: RodState) -> Array:
    """Distance of an end node from a place, over the radius there [1]."""
    index = 0 if end == "base" else -1
    apart = vectors.split(state.positions[:, index] - place)
    return vectors.safe_norm(apart) / rod.radii[index]


def _frame_at_new_middle(orientation: Array, rod: Rod, new_rod: Rod, end: End) -> Array:
    """Frame of an end element, carried along the rest curvature to another middle."""
    index, sign = (0, 1) if end == "base" else (-1, -1)
    way = sign * 0.5 * (new_rod.rest_lengths[index] - rod.rest_lengths[index])
    turn = vectors.split(way * rod.rest_curvatures[:, index])
    carried = multiply_quaternions(split_quaternion(orientation), rotation_exp(turn))
    return join_quaternion(carried)


def clamp(state: RodState, end: End = "base") -> Clamp:
    """Clamps one end: its position and orientation stay as they are in `state`.

    The wall's frame is the end element's orientation in `state`.

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
    return Clamp(state.orientations[:, index], end, state.positions[:, index], count)


def fixed_end(state: RodState, end: End = "base") -> FixedEnd:
    """Holds one end node and end element at their place in the given state.

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
