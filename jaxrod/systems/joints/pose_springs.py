r"""Springs that pull a point and its orientation towards a target, which may move.

With the position $x$ and the orientation $q$ of a point of a member, and the target
$x^*, q^*$,

$$E = \tfrac12 k |x^* - x|^2 + \tfrac12 k_t |\phi|^2, \qquad
  \phi = \log(q^{*-1} q),$$

with dashpots on the velocity and the angular velocity relative to the target. The force
and the couple are external: the drive of the target has the power
$F\cdot\dot x^* + C\cdot\omega^*$. The dashpots dissipate $c |\dot x^* - \dot x|^2$
and $c_t |\omega^* - \omega|^2$; the rest goes into the system and the spring.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import Reaction, StabilityBound
from jaxrod.effects.paths import Path, Placed, Turned, Turning, schedule_of
from jaxrod.effects.time import Schedule, Timed, clock_at, is_schedule
from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    multiply_quaternions,
    rotation_log,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling, Seen
from jaxrod.systems.joints.anchors import Anchors, anchors
from jaxrod.systems.joints.places import (
    Place,
    least_inertia,
    orientation_at,
    position_of,
    scatter_add,
    spin_at,
    sum_of_loads,
)
from jaxrod.systems.stepping.assembly import seen_at_rest
from jaxrod.systems.system import System
from jaxrod.validation import (
    Numbers,
    as_array,
    check_array,
    check_kind,
    is_traced,
    optional_number,
)


@pytree
class PoseSpring(Coupling):
    """Spring between a point of a member and a target pose; see `pose_spring`.

    Example:
        >>> held = systems.pose_spring(("arm", "tip"), {"arm": state}, stiffness=100.0)
        >>> float(held.stiffness), held.turning_stiffness is None  # it turns freely
        (100.0, True)
    """

    anchor: Anchors
    """The point that is pulled, and its node and element."""
    place: Placed | Schedule
    """Target position and its velocity, or a schedule of them."""
    turn: Turned | Schedule
    """Target orientation and its angular velocity, or a schedule of them."""
    stiffness: Float[Array, ""]
    """Force per distance from the target [N/m]."""
    damping: Float[Array, ""] | None = None
    """Force per velocity relative to the target [kg/s]; if `None`, there is no damping.
    """
    turning_stiffness: Float[Array, ""] | None = None
    """Couple per angle from the target [N m]; if `None`, the element turns freely."""
    turning_damping: Float[Array, ""] | None = None
    """Couple per angular velocity relative to the target [N m s]; if `None`, there is
    no damping."""

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if the member is missing or has too few nodes."""
        self.anchor.check(parts)

    def regridded(self, grids: Any) -> PoseSpring:
        """The same point on a rod with another number of elements.

        Raises:
            ValueError: If it holds the orientation of an element of a rod that is
                curved at rest.
        """
        _, *turn = grids.turns(self.anchor.points)
        if self.turning_stiffness is not None and np.any(np.asarray(turn) != 0):
            raise ValueError(
                "a pose spring that turns an element of a rod that is curved at rest "
                "cannot be resampled: make a new one for the new rod"
            )
        return replace(self, anchor=self.anchor.regridded(grids))

    @property
    def acts_from_outside(self) -> bool:
        """True: the target is no part of the system."""
        return True

    @property
    def _placed(self) -> Placed:
        return cast(Placed, self.place)

    @property
    def _turned(self) -> Turned:
        return cast(Turned, self.turn)

    def _way(self, own: Seen) -> Vec3:
        """Vector from the point to the target position, world frame [m]."""
        x, y, z = self.anchor.positions(own)
        a, b, c = self._placed.position
        return a - x, b - y, c - z

    def _angle(self, own: Seen) -> Vec3:
        """Rotation vector from the target to the element, log(q*^-1 q) [rad].

        Its components are the same in the frames of the target and of the element.
        """
        q = _one_quaternion(self._turned.orientation)
        here = orientation_at(own, self.anchor.points)
        return rotation_log(multiply_quaternions(conjugate(q), here))

    def _pull(self, own: Seen) -> Vec3:
        """Force on the point, k (x* - x) + c (v* - v), with the target x*, v* [N]."""
        force = vectors.scale(self.stiffness, self._way(own))
        if self.damping is None:
            return force
        place = self.anchor.positions(own)
        rate = vectors.subtract(
            _one(self._placed.velocity), self.anchor.velocities(own, place)
        )
        return vectors.add(force, vectors.scale(self.damping, rate))

    def _couple(self, own: Seen) -> Vec3 | None:
        """Couple on the element, -k_t phi + c_t (w* - w), world frame [N m].

        phi is the rotation vector from the target, and w* the target's angular
        velocity. `None` if the element turns freely.
        """
        couple = None
        if self.turning_stiffness is not None:
            frame = directors(orientation_at(own, self.anchor.points))
            turn = to_world(frame, self._angle(own))
            couple = vectors.scale(-self.turning_stiffness, turn)
        if self.turning_damping is not None:
            rate = vectors.subtract(
                _one(self._turned.angular_velocity), spin_at(own, self.anchor.points)
            )
            drag = vectors.scale(self.turning_damping, rate)
            couple = drag if couple is None else vectors.add(couple, drag)
        return couple

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Loads of the spring and its dashpots on the member."""
        points = self.anchor.points
        own = seen[points.member]
        place = self.anchor.positions(own)
        loads = self.anchor.loads(own, self._pull(own), place)
        turning = self._couple(own)
        if turning is not None:
            assert loads.couples is not None
            more = to_material(directors(orientation_at(own, points)), turning)
            loads = Loads(loads.forces, vectors.add(loads.couples, more))
        return sum_of_loads((points, loads), seen=seen)

    def energy(self, seen: AllSeen) -> Array:
        r"""Elastic energy, $k d^2 / 2 + k_t \theta^2 / 2$ [J].

        The distance from the target is $d$, the angle $\theta$; $k$ is the stiffness,
        and $k_t$ the angular one.
        """
        own = seen[self.anchor.points.member]
        way = self._way(own)
        stored = 0.5 * self.stiffness * jnp.sum(vectors.dot(way, way))
        if self.turning_stiffness is None:
            return stored
        turn = self._angle(own)
        square = jnp.sum(vectors.dot(turn, turn))
        return stored + 0.5 * self.turning_stiffness * square

    def reaction(self, seen: AllSeen) -> Reaction:
        """Force F and couple C on the point, and power of the drive of the target [W].

        The power is F . v* + C . w*, with the rates v* and w* of the target.
        """
        own = seen[self.anchor.points.member]
        force = vectors.split(jnp.stack(self._pull(own))[:, 0])
        power = vectors.dot(force, vectors.split(self._placed.velocity))
        couple = self._couple(own)
        if couple is None:
            return Reaction.of(force, power=power)
        turn = vectors.split(jnp.stack(couple)[:, 0])
        spin = vectors.split(self._turned.angular_velocity)
        return Reaction.of(force, turn, power + vectors.dot(turn, spin))

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stability bounds on the pulled node and its element, by member."""
        points = self.anchor.points
        own = parts[points.member]
        ease = self.anchor.mobility(own)
        masses = own.node_masses[points.nodes.values]
        inertia = least_inertia(own, points)
        zero = jnp.zeros_like(ease)
        # A force at the node itself does not turn the element; an offset makes it turn.
        arm = vectors.split(self.anchor.offsets)
        lever = vectors.dot(arm, arm) > 0

        def on_nodes(rate: Array) -> Array:
            return scatter_add(rate * ease * masses, points.nodes, own.n_nodes)

        def on_elements(rate: Array, turning: Array | None) -> Array:
            total = jnp.where(lever, rate * ease * inertia, zero)
            if turning is not None:
                total = total + turning
            return scatter_add(total, points.elements, own.inertias.shape[1])

        drag, none = self.damping, jnp.zeros_like(self.stiffness)
        damps = drag is not None or self.turning_damping is not None
        return {
            points.member: StabilityBound(
                nodes=on_nodes(self.stiffness),
                elements=on_elements(self.stiffness, self.turning_stiffness),
                node_drag=None if drag is None else on_nodes(drag),
                element_drag=on_elements(
                    none if drag is None else drag, self.turning_damping
                )
                if damps
                else None,
            )
        }


def _one(vector: Array) -> Vec3:
    """Converts a vector `(3,)` to components of shape `(1,)`, a field of one point."""
    return vector[0][None], vector[1][None], vector[2][None]


def _one_quaternion(quaternion: Array) -> Quaternion:
    w, x, y, z = quaternion
    return w[None], x[None], y[None], z[None]


def pose_spring(
    place: Place,
    state: Mapping[str, Any],
    *,
    stiffness: Numbers,
    damping: Numbers | None = None,
    turning_stiffness: Numbers | None = None,
    turning_damping: Numbers | None = None,
    position: Numbers | None = None,
    orientation: Numbers | None = None,
    displacement: Timed = (0.0, 0.0, 0.0),
    axis: Numbers | None = None,
    angle: Timed = 0.0,
    at: Numbers | None = None,
) -> PoseSpring:
    """Pulls a node of a rod, or a body, towards a target position and orientation.

    Args:
        place: A place on a member, `("arm", "tip")` or `("ball",)`.
        state: State of the system. The target is the pose of the place in it, unless
            `position` and `orientation` are given.
        stiffness: Force per distance [N/m].
        damping: Force per speed relative to the target [kg/s].
        turning_stiffness: Couple per angle [N m]; by default the place turns freely.
        turning_damping: Couple per relative angular velocity [N m s].
        position: Target position, world frame `(3,)` [m].
        orientation: Target orientation, a quaternion (w, x, y, z).
        displacement: Displacement of the target from that position, world frame:
            `(3,)` or a schedule of such vectors [m].
        axis: Axis about which the target turns, world frame, of any length `(3,)`.
        angle: Angle by which the target turns, or a schedule [rad].
        at: Position in `state` of the point of the element or body that is pulled,
            world frame `(3,)` [m]; by default the node, or the body's origin.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If there is no such place, or a number is out of range.

    Example:
        >>> place, states = ("arm", "tip"), {"arm": state}
        >>> up = schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, 0.2), duration=1.0)
        >>> held = systems.pose_spring(place, states, stiffness=100.0, displacement=up)
        >>> halfway = jaxrod.make_system({"arm": scene}, held).at(0.5)  # 0.1 m up
        >>> force = systems.pose_spring_reactions(halfway, states)[0].force
        >>> print(force.round(3))  # [N]
        [ 0.  0. 10.]
    """
    point = None if at is None else as_array("at", at, "m", [(3,)])
    pose = position_of("place", place, state)
    origin = jnp.asarray(pose.place if point is None else point)
    if position is not None:
        origin = as_array("position", position, "m", [(3,)])
    start = jnp.stack([jnp.asarray(c) for c in pose.orientation])
    if orientation is not None:
        given = check_array("orientation", orientation, [(4,)], "")
        if not is_traced(given) and not np.any(given):
            raise ValueError("orientation must not be zero, got (0, 0, 0, 0)")
        quaternion = jnp.asarray(given, start.dtype)
        start = quaternion / jnp.sqrt(jnp.sum(quaternion * quaternion))
    turns = is_schedule(angle) or is_traced(angle) or bool(np.any(np.asarray(angle)))
    if turns and axis is None:
        raise ValueError(
            "axis must be given with angle: the orientation turns about it"
        )
    if (turns or orientation is not None or turning_damping is not None) and (
        turning_stiffness is None
    ):
        raise ValueError(
            "turning_stiffness [N m] is needed to turn the place: without it the place "
            "turns freely"
        )
    about = jnp.asarray(unit_vector("axis", (0, 0, 1) if axis is None else axis))
    path: Any = Path(origin, schedule_of("displacement", displacement, "m", (3,)))
    turning: Any = Turning(
        start, about.astype(start.dtype), schedule_of("angle", angle, "rad", ())
    )
    if not is_schedule(displacement):
        path = path(clock_at(0.0, origin.dtype))
    if not is_schedule(angle):
        turning = turning(clock_at(0.0, start.dtype))
    return PoseSpring(
        anchor=anchors([place], state, at=[point], name="place"),
        place=path,
        turn=turning,
        stiffness=as_array("stiffness", stiffness, "N/m", positive=True),
        damping=optional_number("damping", damping, "kg/s"),
        turning_stiffness=(
            None
            if turning_stiffness is None
            else as_array("turning_stiffness", turning_stiffness, "N m", positive=True)
        ),
        turning_damping=optional_number("turning_damping", turning_damping, "N m s"),
    )


def pose_spring_reactions(
    system: System, state: Mapping[str, Any]
) -> tuple[Reaction, ...]:
    """Force, couple and power of each pose spring of a system.

    The power is that of the drive, which moves and turns the target.

    Args:
        system: The system, at one moment: `system.at(time)` if it depends on time.
        state: State of the system.

    Returns:
        One reaction for each `pose_spring`, in the order in which they were given.

    Raises:
        TypeError: If `system` is not a system.
        ValueError: If the system depends on time.

    Example:
        >>> place, states = ("arm", "tip"), {"arm": state}
        >>> target = (1.0, 0.0, 0.1)  # 0.1 m above the tip
        >>> held = systems.pose_spring(place, states, stiffness=100.0, position=target)
        >>> system = jaxrod.make_system({"arm": scene}, held)
        >>> reaction = systems.pose_spring_reactions(system, states)[0]
        >>> print(reaction.force.round(3), reaction.power)  # the target stands still
        [ 0.  0. 10.] 0.0
    """
    check_kind("system", system, System)
    system.check_moment()
    seen, couplings = seen_at_rest(system, state)
    reactions = [coupling.reaction(seen) for coupling in couplings]
    return tuple(one for one in reactions if one is not None)
