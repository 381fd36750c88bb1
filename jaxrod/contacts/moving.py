r"""Bodies that move by a schedule: plates, jaws, drums and needles.

The body keeps its shape, and a frame carries it. Its point $c$ follows a path, with the
velocity $V$, and it turns by $Q$ about this point, with the angular velocity $w$. A rod
at $x$, $v$, $\omega$ touches the body as it would touch a fixed one, seen from the
frame:

$$x' = c_0 + Q^T(x - c), \qquad v' = Q^T(v - V - w\times(x - c)), \qquad
  \omega' = Q^T(\omega - w).$$

Loads are turned back by $Q$. So penetration, damping, friction and the springs of
static friction all count relative to the surface of the body, and a rod that moves with
it feels nothing of the motion.

With the total force $F$ of the body on the rod and its total moment $M$ about $c$, the
body's drive supplies the power $F\cdot V + M\cdot w$.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.contacts.bodies import IDENTITY, Body
from jaxrod.contacts.contact import Contact
from jaxrod.effects.base import (
    Effect,
    Reach,
    Reaction,
    StabilityBound,
    memory_of,
    recalled,
    remembers,
)
from jaxrod.effects.paths import Path, Turning, schedule_of
from jaxrod.effects.time import Schedule, Scheduled, at_clock, clock_at, is_schedule
from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    join_quaternion,
    multiply_quaternions,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion, motion_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import memory, pytree
from jaxrod.validation import Numbers, as_array, check_kind


@pytree
class MovingContact(Effect):
    """Contact of a rod with bodies that move by a schedule; see `moving_contact`."""

    contact: Contact
    """Contact with the bodies where they are at zero displacement and angle."""
    place: Scheduled
    """Position, velocity and acceleration of the point `about`: a `Placed`, or a
    schedule of it."""
    turn: Scheduled
    """Rotation of the bodies about this point: a `Turned`, or a schedule of it; `None`
    if they do not turn."""
    about: Float[Array, "3"]
    """Point of the bodies about which they turn, at zero displacement [m]."""

    reach: ClassVar[Reach] = "neighbours"

    @property
    def touching(self) -> Contact:
        """The contact in the frame of the bodies, with its present memory."""
        return self.contact

    @property
    def obstacle(self) -> tuple[Body, int | None]:
        """Bodies at zero displacement and angle; their number, `None` for one."""
        return self.contact.obstacle

    @property
    def obstacle_pose(self) -> tuple[Array, Array]:
        """Displacement of the world's origin [m] and rotation of the bodies."""
        if self.turn is None:
            shift = self.place.position - self.about
            return shift, jnp.asarray(IDENTITY, shift.dtype)
        turned = to_world(self._axes, vectors.split(self.about))
        origin = vectors.subtract(vectors.split(self.place.position), turned)
        return vectors.join(origin), self.turn.orientation

    @property
    def bearing(self) -> Array:
        """Stiffness of the contact [N/m^2]."""
        return self.contact.bearing

    @property
    def lacks_numbers(self) -> bool:
        """Whether the stiffness of the contact is left out."""
        return self.contact.lacks_numbers

    def with_numbers(self, rod: Rod, step: Array) -> MovingContact:
        """Copy with the numbers that the contact lacks, see `Contact.with_numbers`."""
        return replace(self, contact=self.contact.with_numbers(rod, step))

    @property
    def twists(self) -> str | None:
        """Name of the cause of twist: friction, which makes rods roll; else `None`."""
        return self.contact.twists

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Loads of the contact as the bodies see it, turned back to the world."""
        loads = self.touching.loads(rod, self.seen(rod, motion))
        if self.turn is None or loads.forces is None:
            return loads
        return Loads(to_world(self._axes, loads.forces), loads.couples)

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bounds of the contact, which do not depend on the motion of the bodies."""
        return self.contact.stability_bound(rod)

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Energy of the springs of the contact [J]."""
        return self.touching.energy(rod, self._seen_state(state))

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Deepest penetration of the centreline divided by the radius [1]."""
        return self.touching.violation(rod, self._seen_state(state))

    def passages(self, rod: Rod, before: RodState, after: RodState) -> Array:
        """Number of points that went through the bodies where they are now."""
        seen = map(self._seen_state, (before, after))
        return self.touching.passages(rod, *seen)

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction:
        """Total force of the bodies, their moment about the moved point, and power.

        The power is what their drive supplies to the rod and to the contact.
        """
        loads = self.loads(rod, motion)
        assert loads.forces is not None
        force = vectors.mapped(jnp.sum, loads.forces)
        moment = vectors.mapped(
            jnp.sum, vectors.cross(self._arm(motion.position), loads.forces)
        )
        if loads.couples is not None:
            couples = to_world(directors(motion.orientation), loads.couples)
            moment = vectors.add(moment, vectors.mapped(jnp.sum, couples))
        power = vectors.dot(force, vectors.split(self.place.velocity))
        if self.turn is not None:
            turning = vectors.split(self.turn.angular_velocity)
            power = power + vectors.dot(moment, turning)
        return Reaction.of(force, moment, power)

    def check(self, rod: Rod) -> None:
        """Warns or raises where the contact does."""
        self.contact.check(rod)

    def force_directions(self, rod: Rod, motion: Motion) -> Vec3:
        """Normals of the bodies at the nodes, and ways in which friction may pull.

        The latter are the displacement of each place of the bodies by translation and
        by rotation.
        """
        normals = self.touching.force_directions(rod, self.seen(rod, motion))
        if self.turn is not None:
            normals = to_world(self._axes, normals)
        if self.contact.friction is None:
            return normals
        shift = vectors.split(self.place.position - self.about)
        ways = [vectors.add(shift, vectors.scale(0, motion.position))]
        if self.turn is not None:
            _, x, y, z = split_quaternion(self.turn.orientation)
            ways.append(vectors.cross((x, y, z), self._arm(motion.position)))
        every = [normals, *(_unit_or_zero(way) for way in ways)]
        a, b, c = (
            jnp.concatenate([jnp.ravel(part) for part in parts])
            for parts in zip(*every, strict=True)
        )
        return a, b, c

    def resampled(self, rod: Rod, new_rod: Rod) -> MovingContact:
        """The same motion of the bodies, and the contact for `new_rod`."""
        return replace(self, contact=self.contact.resampled(rod, new_rod))

    def softened(self, share: ArrayLike) -> MovingContact:
        """The same motion of the bodies, and softer contact: see `Contact.softened`."""
        return replace(self, contact=self.contact.softened(share))

    def thinned(self, share: float) -> MovingContact:
        """The same motion of the bodies, and fewer points: see `Contact.thinned`."""
        return replace(self, contact=self.contact.thinned(share))

    def with_free_ends(self, free: Float[Array, "2"]) -> MovingContact:
        """The same with flags of free ends, see `Contact.with_free_ends`."""
        return replace(self, contact=self.contact.with_free_ends(free))

    def seen(self, rod: Rod, motion: Motion) -> Motion:
        """Motion of the rod as the bodies see it."""
        place, frame = self.seen_configuration(motion.position, motion.orientation)
        speed = vectors.split(self.place.velocity)
        velocity = vectors.subtract(motion.velocity, speed)
        seen = replace(motion, position=place, orientation=frame, velocity=velocity)
        if self.turn is None:
            return seen
        arm = self._arm(motion.position)
        turning = vectors.split(self.turn.angular_velocity)
        velocity = vectors.subtract(velocity, vectors.cross(turning, arm))
        seen = replace(seen, velocity=to_material(self._axes, velocity))
        # Without friction contact takes no notice of spins.
        if self.contact.friction is None:
            return seen
        own = to_material(directors(motion.orientation), turning)
        if motion.spin_is_velocity:
            return replace(seen, spin=vectors.subtract(motion.spin, own))
        inertia = vectors.split(rod.principal_inertias)
        carried = vectors.multiply(inertia, own)
        carried = to_world(directors(motion.orientation), carried)
        spin = to_material(self._axes, vectors.subtract(motion.spin, carried))
        return replace(seen, spin=spin)

    def seen_configuration(
        self, position: Vec3, orientation: Quaternion
    ) -> tuple[Vec3, Quaternion]:
        """Positions and orientations of a rod as the bodies see them."""
        arm, about = self._arm(position), vectors.split(self.about)
        if self.turn is None:
            return vectors.add(arm, about), orientation
        back = conjugate(split_quaternion(self.turn.orientation))
        here = vectors.add(to_material(self._axes, arm), about)
        return here, multiply_quaternions(back, orientation)

    @property
    def without_slip(self) -> MovingContact:
        """The same motion of the bodies, and `Contact.without_slip`."""
        contact = self.contact.without_slip
        return self if contact is self.contact else replace(self, contact=contact)

    def _arm(self, position: Vec3) -> Vec3:
        """Vectors from the moved point to `position` [m]."""
        return vectors.subtract(position, vectors.split(self.place.position))

    @property
    def _axes(self) -> tuple[Vec3, Vec3, Vec3]:
        """Axes of the frame that turns with the bodies, in the world."""
        return directors(split_quaternion(self.turn.orientation))

    def _seen_state(self, state: RodState) -> RodState:
        """Configuration of a state as the bodies see it; its rates do not change."""
        motion = motion_of(state)
        place, frame = self.seen_configuration(motion.position, motion.orientation)
        return replace(
            state, positions=vectors.join(place), orientations=join_quaternion(frame)
        )


@pytree
class RememberingMovingContact(MovingContact):
    """Contact with moving bodies whose contact has memory, such as static friction."""

    kept: Any = memory(kw_only=True)
    """Memory of the contact, in the frame of the bodies, by name of its fields."""

    @property
    def touching(self) -> Contact:
        """The contact in the frame of the bodies, with its present memory."""
        (contact,) = recalled((self.contact,), (self.kept,))
        # `recalled` keeps the class of an effect, but its type does not show that.
        return contact  # type: ignore[return-value]

    def after_step(
        self, rod: Rod, motion: Motion, dt: Array
    ) -> RememberingMovingContact:
        """The same with the memory that the contact has after the step."""
        after = self.touching.after_step(rod, self.seen(rod, motion), dt)
        return replace(self, kept=memory_of((after,))[0])

    @property
    def stirred(self) -> RememberingMovingContact:
        """The same with the contact's memory stirred, as the contact itself does it."""
        return replace(self, kept=memory_of((self.touching.stirred,))[0])


def moving_contact(
    contact: Contact,
    *,
    displacement: Schedule | Numbers = (0.0, 0.0, 0.0),
    axis: Numbers | None = None,
    angle: Schedule | Numbers = 0.0,
    about: Numbers = (0.0, 0.0, 0.0),
) -> MovingContact:
    """The same contact with bodies that move by a schedule: a plate, a jaw, a drum.

    Damping and friction act on the velocity relative to the bodies. All bodies of the
    contact move together; list a contact for each that moves on its own.
    `jaxrod.reactions` gives the force, moment and power that the motion takes. The
    integral of the power is the `work_input` of `health`.

    Args:
        contact: Contact with fixed bodies: a `contact`, a `sticking_contact` or a
            `near_contact`. For the latter two the given state of the rod is that at
            time zero.
        displacement: Displacement of the bodies from where the contact has them, world
            frame: `(3,)`, or a schedule of it [m].
        axis: Axis about which the bodies turn, world frame, of any length `(3,)`;
            needed if `angle` is given.
        angle: Angle by which they turn, or a schedule of it [rad].
        about: Point on the axis, which is displaced with the bodies `(3,)` [m].

    Returns:
        An effect to list in a scene in place of `contact`.

    Raises:
        ValueError: If an argument is out of range, or there is an angle without axis.
        TypeError: If `contact` is something else.

    Example:
        >>> belt = jaxrod.contact(shapes.plane((0.0, 0.0, -0.019)), stiffness=1e4)
        >>> up = schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, 0.5), duration=1.0)
        >>> lift = jaxrod.moving_contact(belt, displacement=up)
        >>> scene = jaxrod.make_scene(rod, lift)
        >>> taken = jaxrod.reactions(scene.at(0.0005), state)[0]
        >>> round(float(taken.force[2]), 1), round(float(taken.power), 2)  # [N], [W]
        (12.5, 6.25)
    """
    check_kind("contact", contact, Contact)
    turns = schedule_of("angle", angle, "rad", ())
    if axis is None and (is_schedule(angle) or np.any(np.asarray(angle) != 0)):
        raise ValueError("axis must be given with angle: the bodies turn about it")
    kind = jnp.result_type(float)
    centre = as_array("about", about, "m", [(3,)])
    place = Path(centre, schedule_of("displacement", displacement, "m", (3,)))
    turn = None
    if axis is not None:
        along = jnp.asarray(unit_vector("axis", axis), kind)
        turn = Turning(jnp.asarray(IDENTITY, kind), along, turns)
    if not remembers((contact,)):
        return MovingContact(contact, place, turn, centre)
    made = RememberingMovingContact(contact, place, turn, centre, kept=None)
    first = at_clock(made, clock_at(0.0, kind))
    seen = contact.seen_by(first.seen_configuration)
    return replace(made, contact=seen, kept=memory_of((seen,))[0])


def _unit_or_zero(way: Vec3) -> Vec3:
    """Unit vectors along a field, zero where it is zero."""
    square = vectors.dot(way, way)
    is_way = square > 0
    return vectors.scale(
        jnp.where(is_way, 1 / jnp.sqrt(jnp.where(is_way, square, 1)), 0), way
    )
