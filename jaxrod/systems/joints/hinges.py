r"""Hinges and fixed joints of finite stiffness between members.

A hinge adds the energy $k_t (1 - a\cdot b)$ to a ball joint, where $a$ and $b$ are the
directions of its axis, one fixed in the first and one in the second member. Motors act
about the mean of both directions. Dashpots resist relative rotation about any axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import StabilityBound
from jaxrod.effects.time import Timed, as_timed
from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling
from jaxrod.systems.joints.elastic_joints import (
    elastic_joints,
    turning_bounds,
)
from jaxrod.systems.joints.places import (
    Place,
    Points,
    orientation_at,
    pairs,
    position_of,
    spin_at,
    sum_of_loads,
)
from jaxrod.systems.joints.springs import (
    ball_joint,
    check_limited,
    chosen,
    number_or_nan,
)
from jaxrod.validation import Numbers, as_array, optional_number


@pytree
class AxisSprings(Coupling):
    """Springs that align an axis of one element with an axis of another; for hinges."""

    a: Points
    """Elements of the first member, one for each hinge."""
    b: Points
    """Elements of the second member, one for each hinge."""
    axes_a: Float[Array, "3 hinges"]
    """Unit vectors along the hinges, fixed in the elements of `a`, in their frames."""
    axes_b: Float[Array, "3 hinges"]
    """Unit vectors along the hinges, fixed in the elements of `b`, in their frames."""
    stiffness: Float[Array, ""]
    """Couple per sine of the angle between both axes [N m]."""
    damping: Float[Array, ""] | None = None
    """Couple per relative angular velocity, about any axis [N m s]; if `None`, there is
    no damping."""
    motor: Float[Array, ""] | None = None
    """Couple on `b` about the mean axis, and its opposite on `a` [N m]; if `None`,
    there is no motor."""
    left_out: bool = static(default=False)
    """Whether `make_system` chooses the stiffness; until then it is NaN."""

    def regridded(self, grids: Any) -> AxisSprings:
        """The same axes on rods with other numbers of elements."""
        return replace(
            self,
            a=self.a.regridded(grids),
            b=self.b.regridded(grids),
            axes_a=grids.turned_back(self.a, self.axes_a),
            axes_b=grids.turned_back(self.b, self.axes_b),
        )

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing or has too few nodes.

        Raises:
            ValueError: Also if the stiffness is left out between two rigid bodies.
        """
        self.a.check(parts)
        self.b.check(parts)
        if self.left_out:
            check_limited("axis_stiffness", "N m", self.a, self.b, parts)

    @property
    def lacks_numbers(self) -> bool:
        """Whether its stiffness is left out."""
        return self.left_out

    def with_numbers(self, parts: AllParts, step: Array) -> AxisSprings:
        """Copy with a stiffness that makes the stable step at most a fifth shorter.

        Args:
            parts: Constants of the members.
            step: Largest stable step of the system without these springs [s].
        """
        bare = replace(self, damping=None, motor=None)
        return replace(self, stiffness=chosen(bare, parts, step), left_out=False)

    def _axes(self, seen: AllSeen) -> tuple[Vec3, Vec3]:
        """Unit vectors of the axes fixed in `a` and in `b`, world frame."""
        frame_a = directors(orientation_at(seen[self.a.member], self.a))
        frame_b = directors(orientation_at(seen[self.b.member], self.b))
        return (
            to_world(frame_a, vectors.split(self.axes_a)),
            to_world(frame_b, vectors.split(self.axes_b)),
        )

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Couples of springs, dashpots and motors on both elements of each hinge."""
        one, two = self._axes(seen)
        pull = vectors.scale(self.stiffness, vectors.cross(two, one))
        if self.damping is not None:
            apart = vectors.subtract(
                spin_at(seen[self.b.member], self.b),
                spin_at(seen[self.a.member], self.a),
            )
            pull = vectors.subtract(pull, vectors.scale(self.damping, apart))
        if self.motor is not None:
            both = vectors.scale(0.5 * self.motor, vectors.add(one, two))
            pull = vectors.add(pull, both)
        back = vectors.scale(-1.0, pull)
        frame_a = directors(orientation_at(seen[self.a.member], self.a))
        frame_b = directors(orientation_at(seen[self.b.member], self.b))
        return sum_of_loads(
            (self.a, Loads(couples=to_material(frame_a, back))),
            (self.b, Loads(couples=to_material(frame_b, pull))),
            seen=seen,
        )

    def energy(self, seen: AllSeen) -> Array:
        """Elastic energy, k (1 - a . b) for the axes a and b of each hinge [J]."""
        one, two = self._axes(seen)
        apart = vectors.subtract(two, one)
        return 0.5 * self.stiffness * jnp.sum(vectors.dot(apart, apart))

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stability bounds on the elements of both members, by member."""
        stiffness = jnp.broadcast_to(self.stiffness, (len(self.a.nodes),))
        if self.motor is not None:
            # The couple M rotates with the elements. The symmetric part of its
            # derivative couples their rotations perpendicular to the axis with M / 2,
            # in addition to k of the spring.
            root = jnp.sqrt(stiffness**2 + (0.5 * self.motor) ** 2)
            stiffness = 0.5 * (stiffness + root)
        return turning_bounds(self.a, self.b, parts, stiffness, self.damping)


def hinge_joint(
    a: Place,
    b: Place,
    state: Mapping[str, Any],
    *,
    axis: Numbers,
    stiffness: Numbers | None = None,
    axis_stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    axis_damping: Numbers | None = None,
    motor: Timed | None = None,
    at: Numbers | None = None,
) -> tuple[Coupling, ...]:
    """A hinge between two members, which turn about an axis that is fixed in both.

    Args:
        a: A place on the first member.
        b: A place on the second member.
        state: State of the system at rest.
        axis: Direction of the hinge in `state`, world frame `(3,)`.
        stiffness: Force per distance between the two points [N/m].
        axis_stiffness: Couple per angle between the axes of both members [N m]. If this
            or `stiffness` is left out, `make_system` takes one that makes the stable
            time step at most a fifth shorter; if both are, at most 30 %.
        damping: Force per relative speed [kg/s].
        axis_damping: Couple per relative angular velocity [N m s].
        motor: Couple on `b` about the axis, and its opposite on `a`; may be a schedule
            [N m].
        at: Position of the hinge in `state`, world frame `(3,)` [m]; by default at `a`.

    Returns:
        Couplings for `make_system`.

    Raises:
        ValueError: If there is no such place, or a number is out of range.
            `make_system` also raises it if a stiffness is left out between two rigid
            bodies.

    Example:
        >>> tips = ("left", "tip"), ("right", "tip")
        >>> hinge = systems.hinge_joint(
        ...     *tips,
        ...     {"left": state, "right": state},
        ...     axis=(0.0, 1.0, 0.0),
        ...     stiffness=100.0,
        ...     axis_stiffness=0.1,
        ...     motor=schedules.ramp(0.0, 0.02, duration=1.0),
        ... )
        >>> system = jaxrod.make_system({"left": scene, "right": scene}, hinge)
        >>> system.depends_on_time  # because the motor does
        True
    """
    held = ball_joint(a, b, state, stiffness=stiffness, damping=damping, at=at)
    world = unit_vector("axis", axis)
    own = []
    for place in (a, b):
        frame = directors(position_of("a", place, state).orientation)
        axis_of = to_material(frame, vectors.split(jnp.asarray(world)))
        own.append(vectors.join(axis_of)[:, None])
    axes = AxisSprings(
        a=held.a.points,
        b=held.b.points,
        axes_a=own[0],
        axes_b=own[1],
        stiffness=number_or_nan("axis_stiffness", axis_stiffness, "N m"),
        left_out=axis_stiffness is None,
        damping=optional_number("axis_damping", axis_damping, "N m s"),
        motor=None if motor is None else as_timed("motor", motor, "N m", ()),
    )
    return held, axes


def fixed_joint(
    a: Place | Sequence[Place],
    b: Place | Sequence[Place],
    state: Mapping[str, Any],
    *,
    stiffness: Numbers | None = None,
    turning_stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    turning_damping: Numbers | None = None,
    at: Numbers | None = None,
) -> tuple[Coupling, ...]:
    """Members held together at a point and at their angle in `state`, by springs.

    `weld` and `attach` join without compliance; this joint has a stiffness.

    Args:
        a: A place on the first member, or several.
        b: A place on the second member, or one for each place of `a`.
        state: State of the system at rest.
        stiffness: Force per distance between the two points [N/m]. If it is left out,
            `make_system` takes one that makes the stable time step at most a fifth
            shorter.
        turning_stiffness: Couple per angle from rest [N m]. If it is left out, the
            joint bends and twists like half an element of each rod.
        damping: Force per relative speed [kg/s].
        turning_damping: Couple per relative angular velocity [N m s].
        at: Position of the joint in `state`, world frame `(3,)` [m]; by default at `a`.

    Returns:
        Couplings for `make_system`.

    Raises:
        ValueError: If there is no such place, or a number is out of range.
            `make_system` also raises it if a stiffness is left out between two rigid
            bodies.

    Example:
        >>> states = {"left": state, "right": state}
        >>> tips = ("left", "tip"), ("right", "tip")
        >>> joint = systems.fixed_joint(
        ...     *tips, states, stiffness=100.0, turning_stiffness=0.1
        ... )
        >>> system = jaxrod.make_system({"left": scene, "right": scene}, joint)
        >>> len(system.couplings)  # one for the point, one for the angle
        2
    """
    held = ball_joint(a, b, state, stiffness=stiffness, damping=damping, at=at)
    drag = optional_number("turning_damping", turning_damping, "N m s")
    first, second = pairs(a, b)
    joints = [replace(j, damping=drag) for j in elastic_joints(first, second, state)]
    if turning_stiffness is not None:
        couple = as_array("turning_stiffness", turning_stiffness, "N m", positive=True)
        joints = [
            replace(j, stiffness=jnp.broadcast_to(couple, (3, len(j.a.nodes))))
            for j in joints
        ]
    return (held, *joints)
