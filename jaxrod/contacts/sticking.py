r"""Contact of a rod with fixed bodies and static friction, without creep.

Friction of `jaxrod.contact` is a drag near rest, so a rod on a slope creeps. Here a
spring of stiffness $k_t$ per length joins each contact point of the rod's surface to
the place of the body that it touches. With its elongation $\xi$ along the surface and
the slip velocity $u_t$,

$$q = k_t\,\xi + c_t\,u_t, \qquad
  F_t = -q\,\min\Bigl(1, \frac{\mu F_n}{|q|}\Bigr).$$

A point sticks while the spring holds, for any time. Beyond $k_t|\xi| = \mu F_n$ it
slips: the spring keeps the elongation $\mu F_n/k_t$ along $\xi$, and its other end
follows. A point that leaves the body loses its spring.

$\xi$ changes with the displacement of the surface of the rod since the last step, of
its centre by $\Delta x$ and by its rotation $\theta$ about the axis:

$$\xi \to (1 - n n^T)\,(\xi + \Delta x - \theta\times r n).$$

It depends on configurations alone, so it is the same in explicit steps, implicit steps
and `equilibrium`, and a rod that rolls without slipping keeps its springs short.

Source: Cundall and Strack, A discrete numerical model for granular assemblies,
Géotechnique 29 (1979).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxrod.contacts.contact import Contact, See
from jaxrod.contacts.default_law import softened_law
from jaxrod.contacts.points import contact_points
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    conjugate,
    join_quaternion,
    multiply_quaternions,
    rotation_log,
    split_quaternion,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod, RodState, check_state
from jaxrod.structure import memory, pytree
from jaxrod.validation import Numbers, as_array, check_kind

STICKING = 0.5
"""Stiffness of the springs of static friction, by default, over that of contact [1]."""
_ENOUGH = 1e12
"""Coefficient of friction with which every point that touches holds [1]."""


class _Grip(NamedTuple):
    """Springs of a group of contact points on one body, and how the points moved."""

    contact: StickingContact
    """The contact, with its stiffnesses and its friction."""
    elongation: Vec3
    """Elongation of the spring at each point after the last step [m]."""
    displacement: Vec3
    """Displacement of each centre since then [m]."""
    rotation: Vec3
    """Rotation vector of each section since then, world frame [rad]."""

    def elongated(self, normal: Vec3, arm: Vec3) -> Vec3:
        """Elongation of springs that hold, along a surface with unit normals [m].

        `arm` leads from the centre of a section to the place that it touches [m].
        """
        moved = vectors.add(self.displacement, vectors.cross(self.rotation, arm))
        whole = vectors.add(self.elongation, moved)
        inwards = vectors.scale(vectors.dot(whole, normal), normal)
        return vectors.subtract(whole, inwards)

    def held(self, push: Array, radii: Array, normal: Vec3) -> Vec3:
        """Elongation of each spring after it has slipped as far as it must [m].

        Args:
            push: Normal force per length [N/m].
            radii: Radii of the rod [m].
            normal: Unit normal of the body's surface.
        """
        law = self.contact
        assert law.friction is not None
        most = law.friction * push / law.stick_stiffness
        arm = vectors.scale(-radii, normal)
        return _at_most(most, self.elongated(normal, arm))

    def density(self, push: Array, radii: Array, normal: Vec3) -> Array:
        """Energy of the springs per length [J/m]; arguments are those of `held`."""
        held = self.held(push, radii, normal)
        return 0.5 * self.contact.stick_stiffness * vectors.dot(held, held)


@pytree
class StickingContact(Contact):
    """Contact with static friction; see `sticking_contact`.

    Example:
        >>> floor = shapes.plane((0.0, 0.0, -0.019))
        >>> rough = jaxrod.contact(floor, stiffness=1e4, damping=2.0, friction=0.5)
        >>> holds = jaxrod.sticking_contact(rough, rod, state)
        >>> float(holds.stick_stiffness), holds.elongations[0].shape
        (5000.0, (1, 3, 11))
    """

    stick_stiffness: Float[Array, ""] = dataclasses.field(kw_only=True)
    """Friction per length of rod and elongation of its spring [N/m^2]."""
    hold: Float[Array, ""] = dataclasses.field(kw_only=True)
    """Number that is added to the coefficient of friction for the limit of the springs
    [1]: zero, and after `without_slip` enough that every point that touches holds."""
    positions: Float[Array, "3 n+1"] = memory(kw_only=True)
    """Positions of the nodes after the last step [m]."""
    orientations: Float[Array, "4 n"] = memory(kw_only=True)
    """Orientations of the elements after the last step."""
    elongations: tuple[Array, ...] = memory(kw_only=True)
    """Elongations of springs after the last step `(bodies, 3, points)`, for each group
    of contact points [m]."""

    def with_numbers(self, rod: Rod, step: Array) -> StickingContact:
        """Copy with the numbers that are left out, see `Contact.with_numbers`."""
        if not self.lacks_numbers:
            return self
        # The springs grow with the stiffness that is looked for, so that the step
        # which the contact allows counts them.
        share = jnp.full_like(self.stiffness, STICKING)
        unit = dataclasses.replace(self, stick_stiffness=share)
        chosen: Any = Contact.with_numbers(unit, rod, step)
        stiffness = chosen.stiffness * share
        if "stick_stiffness" not in self.left_out:
            stiffness = self.stick_stiffness
        found: StickingContact = dataclasses.replace(chosen, stick_stiffness=stiffness)
        return found

    def softened(self, share: ArrayLike) -> StickingContact:
        """Copy with a share of both stiffnesses, see `Contact.softened`."""
        stick = self.stick_stiffness
        softer = (stick * jnp.asarray(share)).astype(stick.dtype)
        return softened_law(dataclasses.replace(self, stick_stiffness=softer), share)

    def thinned(self, share: float) -> StickingContact:
        """The contact itself: each of its points has a spring."""
        return self

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bounds of contact with the springs of friction, as if all points stuck.

        A spring acts on the sum of a displacement and a rotation times the radius; its
        energy is at most twice the sum of both alone.
        """
        bound = super().stability_bound(rod)
        # Springs act where the drag of friction does, with twice their stiffness.
        as_drag = dataclasses.replace(self, friction_drag=2 * self.stick_stiffness)
        springs = Contact.stability_bound(as_drag, rod)
        nodes, along = bound.nodes, springs.slip_drag
        assert nodes is not None and along is not None
        # Friction acts across the normal, so nodes have the larger of both springs.
        return dataclasses.replace(
            bound, nodes=jnp.maximum(nodes, along), elements=springs.slip_couple
        )

    def after_step(self, rod: Rod, motion: Motion, dt: Array) -> StickingContact:
        """The contact with its springs as they are at the configuration of `motion`."""
        kept = []
        for (points, bodies), grips in zip(
            self._in_view(rod), self._grips(rod, motion), strict=True
        ):
            place = points.of_nodes(motion.position)
            radii = points.of_elements(rod.radii)
            held = []
            for body, grip in zip(bodies, grips, strict=True):
                distance, normal = body.surface(place)
                push = self._still_push(points, body, place, distance, radii)
                held.append(vectors.join(grip.held(push, radii, normal)))
            kept.append(jnp.stack(held))
        return dataclasses.replace(
            self,
            positions=vectors.join(motion.position),
            orientations=join_quaternion(motion.orientation),
            elongations=tuple(kept),
        )

    @property
    def stirred(self) -> StickingContact:
        """The contact itself: its springs lie in the plane of the motion."""
        return self

    @property
    def without_slip(self) -> StickingContact:
        """Contact whose points hold while they touch, for small motions about rest.

        At rest many springs are at their limit. They slip in one direction only, and
        hold in all others.
        """
        # A number, so that what holds and what slips are one program.
        return dataclasses.replace(self, hold=jnp.full_like(self.hold, _ENOUGH))

    def seen_by(self, see: See) -> StickingContact:
        """The contact whose last configuration is seen from a frame of the bodies."""
        place, frame = see(
            vectors.split(self.positions), split_quaternion(self.orientations)
        )
        return dataclasses.replace(
            self, positions=vectors.join(place), orientations=join_quaternion(frame)
        )

    def check(self, rod: Rod) -> None:
        """Raises ValueError if the springs are not those of these points and bodies."""
        super().check(rod)
        if self.near is not None:
            raise ValueError(
                "static friction remembers each body: `near_contact`, whose bodies "
                "change, cannot have it; use a contact of all bodies"
            )
        if self.positions.shape[-1] != rod.n_elements + 1:
            raise ValueError(
                f"sticking_contact was made for {self.positions.shape[-1] - 1} "
                f"elements, got a rod of {rod.n_elements}: make it for this rod"
            )

    def _grips(self, rod: Rod, motion: Motion) -> list[Sequence[_Grip]]:
        moved = vectors.subtract(motion.position, vectors.split(self.positions))
        before = split_quaternion(self.orientations)
        turned = rotation_log(
            multiply_quaternions(motion.orientation, conjugate(before))
        )
        grips: list[Sequence[_Grip]] = []
        for points, elongations in zip(
            self._points(rod), self.elongations, strict=True
        ):
            x, y, z = (points.of_elements(component) for component in turned)
            way = points.of_nodes(moved)
            grips.append(
                [_Grip(self, vectors.split(one), way, (x, y, z)) for one in elongations]
            )
        return grips

    def _friction(
        self,
        push: Array,
        slip: Vec3,
        normal: Vec3,
        axis: Vec3 | None,
        arm: Vec3,
        grip: _Grip,
    ) -> Vec3:
        assert self.friction is not None and self.friction_drag is not None
        pull = vectors.scale(self.stick_stiffness, grip.elongated(normal, arm))
        pull = vectors.add(pull, vectors.scale(self.friction_drag, slip))
        most = (self.friction + self.hold) * push
        return vectors.scale(-1, _at_most(most, pull))


def _at_most(limit: Array, vector: Vec3) -> Vec3:
    """The vector, shortened to the length `limit` where it is longer."""
    square = vectors.dot(vector, vector)
    longer = square > limit * limit
    length = jnp.sqrt(jnp.where(longer, square, 1))
    return vectors.scale(jnp.where(longer, limit / length, 1), vector)


def sticking_contact(
    contact: Contact,
    rod: Rod,
    state: RodState,
    *,
    stick_stiffness: Numbers | None = None,
) -> StickingContact:
    r"""The same contact with static friction, so that rods that stick do not creep.

    A spring joins each contact point of the rod's surface to the place of a body that
    it touches, and slips where friction is at its limit. `friction_drag` damps it. Up
    to the limit the rod moves by the elongation of the springs, (tangential load per
    length) / `stick_stiffness`, and stays there. `equilibrium` finds how a rod rests
    with friction, from the springs of the state that it is given.

    Args:
        contact: Contact with isotropic friction and all bodies.
        rod: The rod.
        state: State of the rod in which the springs have no elongation.
        stick_stiffness: Friction per length of rod and elongation [N/m^2]; by default
            half the stiffness of the contact, so that nodes become no stiffer.
            `make_scene` chooses it too if the contact has no stiffness.

    Returns:
        An effect to list in a scene in place of `contact`, for this rod.

    Raises:
        ValueError: If the contact has no friction, friction with directions, or
            nearest bodies, or if a number is out of range.
        TypeError: If `contact`, `rod` or `state` has the wrong type.

    Source: Cundall and Strack, A discrete numerical model for granular assemblies,
    Géotechnique 29 (1979).

    Example:
        >>> slope = shapes.plane((0.0, 0.0, -0.0199), normal=(0.3, 0.0, 1.0))
        >>> rough = jaxrod.contact(slope, stiffness=1e4, damping=2.0, friction=0.5)
        >>> holds = jaxrod.sticking_contact(rough, rod, state)
        >>> scene = jaxrod.make_scene(rod, jaxrod.gravity(), holds)
        >>> after = jaxrod.advance(scene, state, 1e-4, 20)
        >>> after.memory[1]["elongations"][0].shape
        (1, 3, 11)
    """
    check_kind("contact", contact, Contact)
    check_state(rod, state)
    if contact.friction is None or contact.is_directional:
        kind = "none" if contact.friction is None else "friction with directions"
        raise ValueError(f"static friction needs a contact with friction, got {kind}")
    if contact.near is not None:
        raise ValueError("static friction needs all bodies, got a near_contact")
    dtype = contact.stiffness.dtype
    stiffness = (
        STICKING * contact.stiffness
        if stick_stiffness is None
        else as_array(
            "stick_stiffness", stick_stiffness, "N/m^2", positive=True, dtype=dtype
        )
    )
    own = {f.name: getattr(contact, f.name) for f in dataclasses.fields(Contact)}
    if contact.lacks_numbers and stick_stiffness is None:
        own["left_out"] = (*contact.left_out, "stick_stiffness")
    zeros = [
        jnp.zeros(
            (
                contact.n_bodies or 1,
                3,
                len(points.of_nodes(vectors.split(state.positions))[0]),
            ),
            state.positions.dtype,
        )
        for points in contact_points(rod, contact.points_per_element)
    ]
    return StickingContact(
        **own,
        stick_stiffness=stiffness,
        hold=jnp.zeros_like(contact.friction),
        positions=state.positions,
        orientations=state.orientations,
        elongations=tuple(zeros),
    )
