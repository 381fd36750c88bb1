"""Driven nodes of rods: a node follows a path, and a wall may turn an end element."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.effects.base import Effect, Reaction, StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.ends import (
    Axes,
    End,
    Held,
    at_end,
    check_made_for,
    made_again_for,
    replace_end,
)
from jaxrod.effects.paths import Orbit, Path, Turning, schedule_of
from jaxrod.effects.supports import (
    at_node,
    axes_named,
    check_straight_end,
    distance_from,
    end_node,
    force_at,
    node_of,
    node_on,
    own_couple,
)
from jaxrod.effects.time import Schedule, Scheduled, is_schedule
from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.geometry.matrices import Matrix
from jaxrod.geometry.rotations import (
    conjugate,
    directors,
    multiply_quaternions,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState, check_one
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_kind


@pytree
class Driven(Effect):
    """A node of a rod that follows a path; at an end a wall may turn the element.

    The wall acts through an elastic joint of half an element, as in a `Clamp`, or it
    holds the element rigidly, as a `FixedEnd` does. Without a wall the element turns
    freely.
    """

    place: Scheduled
    """Position, velocity and acceleration of the end node: a `Placed`, or a schedule of
    it."""
    turn: Scheduled
    """Orientation, angular velocity and acceleration of the wall: a `Turned`, or a
    schedule of it. `None` if the end element turns freely."""
    end: End | int = static(default="base")
    """End of the rod that is driven, "base" or "tip", or the index of an inner node."""
    axes: Axes = static(default=(True, True, True))
    """World axes along which the node is driven; along the others it is free."""
    holds_element: bool = static(default=False)
    """Whether the wall holds the end element rigidly instead of through a joint."""
    made_for: int | None = static(default=None)
    """Number of elements that the rod must have, see `check`; `None` for any number."""

    @property
    def _wall_end(self) -> End:
        """End of the rod that is driven; only an end has a wall."""
        return cast(End, self.end)

    @property
    def _joint(self) -> Clamp | None:
        """Elastic joint between wall and end element; `None` without a joint."""
        if self.turn is None or self.holds_element:
            return None
        return Clamp(self.turn.orientation, self._wall_end)

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Couple on the end element, material frame, from the joint to the driven wall.

        There are no loads if only the node is driven, without such a joint.
        """
        joint = self._joint
        return Loads() if joint is None else joint.loads(rod, motion)

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix | None:
        """Negative derivative of the joint's couple, world frame [N m].

        The derivative is with respect to the rotation of the end element.
        """
        joint = self._joint
        return None if joint is None else joint.turning_tangent(rod, motion)

    def energy(self, rod: Rod, state: RodState) -> Array | float:
        """Elastic energy of the wall joint [J]; zero without a joint."""
        joint = self._joint
        return 0.0 if joint is None else joint.energy(rod, state)

    def stability_bound(self, rod: Rod) -> StabilityBound | None:
        """Rotational stiffness of the wall joint, on the end element."""
        joint = self._joint
        return None if joint is None else joint.stability_bound(rod)

    @property
    def twists(self) -> str | None:
        """Name of the wall, for the error message of methods that cannot twist."""
        return None if self.turn is None else "a wall that is driven"

    def constrain(self, rod: Rod, motion: Motion) -> Motion:
        """Puts the end node on its path and a held element in the frame of the wall."""
        if self.holds_element:
            w, x, y, z = (
                replace_end(a, b, self._wall_end)
                for a, b in zip(motion.orientation, self.turn.orientation, strict=True)
            )
            motion = replace(motion, orientation=(w, x, y, z))
        node = end_node(rod, self.end)
        there = at_node(motion.position, self.place.position, node, self.axes)
        moved = replace(motion, position=there)
        if motion.remainder is None:
            return moved
        none = jnp.zeros_like(self.place.position)
        return replace(
            moved, remainder=at_node(motion.remainder, none, node, self.axes)
        )

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Gives the end node the path's velocity, and a held element the wall's."""
        if self.holds_element:
            velocity, momentum = self._turning_element(rod)
            spin = velocity if motion.spin_is_velocity else momentum
            x, y, z = (
                replace_end(a, b, self._wall_end)
                for a, b in zip(motion.spin, spin, strict=True)
            )
            motion = replace(motion, spin=(x, y, z))
        node = end_node(rod, self.end)
        velocity = at_node(motion.velocity, self.place.velocity, node, self.axes)
        return replace(motion, velocity=velocity)

    def constrain_accelerations(
        self, rod: Rod, motion: Motion, change: Motion
    ) -> Motion:
        """Gives the end node the path's acceleration, and a held element the wall's."""
        if self.holds_element:
            x, y, z = (
                replace_end(a, b, self._wall_end)
                for a, b in zip(change.spin, self._rate_of_momentum(rod), strict=True)
            )
            change = replace(change, spin=(x, y, z))
        node = end_node(rod, self.end)
        faster = at_node(change.velocity, self.place.acceleration, node, self.axes)
        return replace(change, velocity=faster)

    def _turning_element(self, rod: Rod) -> tuple[Vec3, Vec3]:
        """Angular velocity and angular momentum of an end element held by the wall.

        Returns:
            Angular velocity, material frame [rad/s], and angular momentum, world frame
            [kg m^2/s].
        """
        frame = directors(split_quaternion(self.turn.orientation))
        local = to_material(frame, vectors.split(self.turn.angular_velocity))
        return local, to_world(frame, vectors.multiply(self._inertia(rod), local))

    def _inertia(self, rod: Rod) -> Vec3:
        """Moments of inertia of the end element about d1, d2 and d3 [kg m^2]."""
        index = 0 if self.end == "base" else -1
        return vectors.split(rod.principal_inertias[:, index])

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Distance of the end node from its path along `axes`, over the radius [1].

        With a wall joint it is the larger of this ratio and the violation of that
        joint, see `Clamp`. With a held element, twice sin(angle / 2) is added to the
        ratio, with the angle between the element and the wall.
        """
        node = end_node(rod, self.end)
        apart = distance_from(self.place.position, node, self.axes, rod, state)
        if self.holds_element:
            actual = at_end(split_quaternion(state.orientations), self._wall_end)
            held = split_quaternion(self.turn.orientation)
            _, x, y, z = multiply_quaternions(conjugate(held), actual)
            return apart + 2 * vectors.safe_norm((x, y, z))
        joint = self._joint
        return (
            apart if joint is None else jnp.maximum(apart, joint.violation(rod, state))
        )

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """End node along the driven axes; also the end element if there is a wall."""
        node = end_node(rod, self.end)
        element = None if self.turn is None else min(node, rod.n_elements - 1)
        return (Held(node, self.axes, element),)

    def resampled(self, rod: Rod, new_rod: Rod) -> Driven:
        """The same path and wall for `new_rod`.

        Raises:
            ValueError: If an end with a wall is curved at rest, or the new rod has no
                node at the place of an inner one.
        """
        made = replace(self, made_for=made_again_for(self.made_for, new_rod))
        if self.end not in ("base", "tip"):
            node = node_on(new_rod, end_node(rod, self.end), rod)
            return replace(made, end=node)
        check_straight_end(rod, self._wall_end)
        return made

    def check(self, rod: Rod) -> None:
        """Raises ValueError if the rod does not have `made_for` elements."""
        check_made_for("driven", self.made_for, rod)

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction:
        """Force along the driven axes, couple of the wall, and their power."""
        node = end_node(rod, self.end)
        mass = rod.node_masses[node]
        push = vectors.split(mass * self.place.acceleration)
        held = force_at(needed, node, self.axes)
        a, b, c = (
            force + inertia if is_held else force
            for force, inertia, is_held in zip(held, push, self.axes, strict=True)
        )
        force = (a, b, c)
        power = vectors.dot(force, vectors.split(self.place.velocity))
        if self.turn is None:
            return Reaction.of(force, power=power)
        turning = vectors.split(self.turn.angular_velocity)
        if self.holds_element:
            couple = self._couple_on_held(rod, motion, needed)
        else:
            couple = own_couple(self, rod, motion, self._wall_end)
        return Reaction.of(force, couple, power + vectors.dot(couple, turning))

    def _couple_on_held(self, rod: Rod, motion: Motion, needed: Loads) -> Vec3:
        """Couple of the wall on the held end element, world frame [N m].

        It balances all other couples on the element and changes its angular momentum as
        the rotation of the wall requires.
        """
        assert needed.couples is not None
        index = 0 if self.end == "base" else -1
        a, b, c = (component[index] for component in needed.couples)
        frame = directors(at_end(motion.orientation, self._wall_end))
        return vectors.add(to_world(frame, (a, b, c)), self._rate_of_momentum(rod))

    def _rate_of_momentum(self, rod: Rod) -> Vec3:
        """Rate of a held element's angular momentum, `I alpha + w x (I w)` [N m]."""
        frame = directors(split_quaternion(self.turn.orientation))
        faster = to_material(frame, vectors.split(self.turn.angular_acceleration))
        own = to_world(frame, vectors.multiply(self._inertia(rod), faster))
        _, momentum = self._turning_element(rod)
        turning = vectors.split(self.turn.angular_velocity)
        return vectors.add(own, vectors.cross(turning, momentum))


def driven(
    state: RodState,
    end: End | int = "base",
    *,
    displacement: Schedule | Numbers = (0.0, 0.0, 0.0),
    axes: str = "xyz",
    axis: Numbers | None = None,
    angle: Schedule | Numbers = 0.0,
    about: Numbers | None = None,
    free_to_turn: bool = False,
    holds_element: bool = False,
) -> Driven:
    """Moves a node of a rod along a path, and turns the wall that holds an end element.

    `jaxrod.reactions` gives the force, couple and power that this takes.

    Args:
        state: The state of the rod, from which displacement and angle are measured.
        end: The end that is driven; or the index of an inner node, from 1, where a
            gripper holds the rod. Elements turn freely there: `free_to_turn=True`.
        displacement: Displacement of the end node, world frame: `(3,)`, or a schedule
            of it [m].
        axes: World axes along which it is driven; along the others it is free.
        axis: Axis about which the wall turns, world frame, of any length `(3,)`; needed
            if `angle` is given.
        angle: Angle by which the wall turns, or a schedule of it [rad].
        about: Point on the axis `(3,)`, which moves with the wall [m]. The end then
            moves on a circle about the axis, as on a drum or a lever. By default the
            axis goes through the end, which then stays in place.
        free_to_turn: Whether the end element turns freely, as on a ball joint.
        holds_element: Whether the wall holds the end element itself, as `fixed_end`
            does, and not through an elastic joint of half an element, as `clamp` does.
            Its error is of first order in the number of elements; use it to compare.

    Raises:
        ValueError: If an argument is out of range.
        TypeError: If `state` is not a `RodState`.

    Example:
        >>> path = schedules.sine((0.0, 0.0, 0.25), period=2.0)
        >>> scene = jaxrod.make_scene(rod, jaxrod.driven(state, displacement=path))
        >>> crest = scene.at(0.5).effects[0].place  # at half a second
        >>> crest.position.round(3).tolist()
        [0.0, 0.0, 0.25]
    """
    check_kind("state", state, RodState)
    check_one(state)
    index, last = node_of(state, end, "end"), state.positions.shape[-1] - 1
    is_end = end in ("base", "tip")
    if not is_end and index in (0, last):
        raise ValueError(
            f'end must be "base", "tip" or the number of an inner node, 1 to '
            f"{last - 1}, got {end}"
        )
    if not is_end and not free_to_turn:
        raise ValueError(
            f"node {index} is inside the rod, where no wall holds an element: give "
            "free_to_turn=True"
        )
    start = state.positions[:, index]
    way = schedule_of("displacement", displacement, "m", (3,))
    turn = schedule_of("angle", angle, "rad", ())
    if about is not None and axis is None:
        raise ValueError("axis must be given with about: the end turns about it")
    if free_to_turn and axis is not None and about is None:
        raise ValueError("an end that is free to turn cannot be turned about an axis")
    if free_to_turn and holds_element:
        raise ValueError("an end element cannot be both held and free to turn")
    if axis is None and (is_schedule(angle) or np.any(np.asarray(angle) != 0)):
        raise ValueError("axis must be given with angle: the wall turns about it")
    unit = unit_vector("axis", (0, 0, 1) if axis is None else axis)
    along = jnp.asarray(unit, state.positions.dtype)
    path: Schedule = Path(start, way)
    if about is not None:
        centre = as_array("about", about, "m", [(3,)], dtype=state.positions.dtype)
        path = Orbit(start, way, centre, along, turn)
    wall = None
    if not free_to_turn:
        wall = Turning(state.orientations[:, min(index, last - 1)], along, turn)
    where: End | int = end if is_end else index
    return Driven(path, wall, where, axes_named(axes), bool(holds_element), last)
