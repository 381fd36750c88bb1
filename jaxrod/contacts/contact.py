r"""Contact of a rod with fixed bodies: penalty, damping and Coulomb friction.

Points along the rod (`jaxrod.contacts.points`) are the centres of balls of radius $r$.
At each point a body's signed distance $\phi$ and normal $n$ give the penetration
$p = r - \phi$. With the point's velocity $v$ and $v_n = v\cdot n$ (positive when
leaving), the force per length of rod along the normal is that of
`jaxrod.contacts.contact_law`: a spring and a dashpot that never pull. The slope of the
force is continuous at $v_n = 0$, and its onset is smooth over a width $w$. Beyond
$p = w/2$ the spring is exactly linear; before $p = -w/2$ there is no force.

Friction acts where the section touches, at $-r n$ from its centre. This point moves at
$u = v - \omega\times r n$. With the component $u_t$ of $u$ along the surface,

$$F_t = -\frac{c_t u_t}{\sqrt{1 + (c_t |u_t| / \mu F_n)^2}},$$

which is sliding friction $\mu F_n$ at high speed and a drag of rate $c_t$ near rest. A
sticking contact under a load $f < \mu F_n$ along the surface creeps at the speed where
friction balances the load,

$$u_t = \frac{f}{c_t}\,\frac{1}{\sqrt{1 - (f/\mu F_n)^2}},$$

which is 2.3 times $f/c_t$ at 0.9 of the limit and 7.1 times at 0.99. The slope is at
most $c_t$ whatever the load, so a stable step exists. The couple $-r n\times F_t$ of
friction on the section makes rods roll. Friction may also differ between forward,
backward and sideways (`contact_law`).
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from jaxrod.contacts.bodies import Body
from jaxrod.contacts.contact_law import (
    along_surface,
    depth_from_onset,
    directional_friction_force,
    energy_density,
    friction_force,
    normal_force,
)
from jaxrod.contacts.default_law import (
    GRAVITY,
    OVERLAP,
    added_rates,
    left_out,
    softened_law,
    with_default_law,
)
from jaxrod.contacts.passages import passages
from jaxrod.contacts.points import Points, check_spacing, contact_points, fewer_points
from jaxrod.effects.base import Effect, Reach, StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import Quaternion, directors, to_material
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion, accumulate, motion_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_array, check_count, is_traced

See = Callable[[Vec3, Quaternion], tuple[Vec3, Quaternion]]
"""Function from positions and orientations to those seen from another frame."""


@pytree
class Contact(Effect):
    """Contact of a rod with one fixed body, or with several of one kind.

    See `contact`, and `near_contact` for contact with the nearest bodies only.
    """

    body: Body
    """Body or bodies; for several bodies its arrays have a leading axis."""
    stiffness: Float[Array, ""]
    """Force per length of rod and penetration [N/m^2]."""
    onset: Float[Array, ""]
    """Width of the smooth onset of contact, divided by the rod's radius [1]."""
    damping: Float[Array, ""] | None = None
    """Force per length of rod and normal speed [kg/(m s)]."""
    friction: Float[Array, ""] | Float[Array, "3"] | None = None
    """Coefficient of Coulomb friction, or one for each direction: forward along d3,
    backward and sideways [1]."""
    friction_drag: Float[Array, ""] | None = None
    """Largest friction per length of rod and slip speed [kg/(m s)]."""
    n_bodies: int | None = static(default=None)
    """Number of bodies along a leading axis; `None` for a single body."""
    near: tuple[Body, ...] | None = None
    """Nearest bodies of each point, for each entry of `contact_points`; `None` to test
    all bodies."""
    n_near: int | None = static(default=None)
    """Number of nearest bodies that are tested at each point; `None` for all."""
    points_per_element: int = static(default=1)
    """Contact points per element."""
    stick_ratio: Float[Array, ""] | None = None
    """Coefficient of sticking friction over that of sliding, for directional friction
    [1]; `None` for one."""
    free_ends: Float[Array, "2"] | None = None
    """Flags of the two ends: 1 if free, 0 if the rod continues in another rod. Both are
    free by default."""

    left_out: tuple[str, ...] = static(default=())
    """Names of the numbers that `make_scene` chooses; until then the stiffness is
    NaN."""

    reach: ClassVar[Reach] = "neighbours"

    @property
    def lacks_numbers(self) -> bool:
        """Whether its stiffness is left out."""
        return bool(self.left_out)

    def with_numbers(self, rod: Rod, step: Array) -> Contact:
        """Copy with the numbers that are left out, by `jaxrod.contacts.default_law`.

        Args:
            rod: The rod.
            step: Largest stable step of the scene without this contact [s].
        """

        def fastest(contact: Contact) -> tuple[Array, Array]:
            bound = contact.stability_bound(rod)
            return added_rates(bound, rod.node_masses, jnp.min(rod.inertias, axis=0))

        least = GRAVITY / OVERLAP * jnp.max(rod.linear_density / rod.radii)
        return with_default_law(self, step, least, fastest)

    @property
    def obstacle(self) -> tuple[Body, int | None]:
        """Body that the rod can touch; number of bodies, `None` for a single one."""
        return self.body, self.n_bodies

    @property
    def bearing(self) -> Array:
        """Force per length of rod and penetration [N/m^2]."""
        return self.stiffness

    @property
    def is_directional(self) -> bool:
        """Whether friction has coefficients for each direction."""
        return self.friction is not None and jnp.ndim(self.friction) == 1

    @property
    def twists(self) -> str | None:
        """Name of the cause of twist: friction, which makes rods roll; else `None`."""
        return None if self.friction is None else "friction"

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Contact forces on nodes, and friction couples on elements, material frame."""
        loads = Loads()
        for (points, bodies), grips in zip(
            self._in_view(rod), self._grips(rod, motion), strict=True
        ):
            loads = self._add_loads(loads, rod, motion, points, bodies, grips)
        if loads.couples is None:
            return loads
        frame = directors(motion.orientation)
        return Loads(loads.forces, to_material(frame, loads.couples))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bounds of stiffness and drag as if each point touched all its bodies."""
        count = self.n_near or self.n_bodies or 1
        stiff, at_nodes, at_elements = _lengths_in_bounds(self._points(rod))
        stiff, at_nodes, at_elements = (
            count * lengths for lengths in (stiff, at_nodes, at_elements)
        )
        stiffness = self.stiffness * stiff
        drag = self.damping
        if self.friction_drag is None:
            node_drag = None if drag is None else drag * at_nodes
            return StabilityBound(nodes=stiffness, node_drag=node_drag)
        squares = rod.radii**2
        around = vectors.pad(squares, 0, 1), vectors.pad(squares, 1, 0)
        largest = jnp.maximum(*around)
        lever = jnp.maximum(largest[1:], largest[:-1])
        return StabilityBound(
            nodes=stiffness,
            node_drag=None if drag is None else drag * at_nodes,
            slip_drag=self.friction_drag * at_nodes,
            slip_couple=self.friction_drag * lever * at_elements,
        )

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Energy of the springs [J]."""
        motion = motion_of(state)
        total = jnp.zeros((), state.positions.dtype)
        for (points, bodies), grips in zip(
            self._in_view(rod), self._grips(rod, motion), strict=True
        ):
            total = total + self._energy_at(rod, motion, points, bodies, grips)
        return total

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Deepest penetration of the centreline divided by the radius [1].

        It is one where the centreline reaches a surface. Contact of adequate stiffness
        never lets it get that deep. Points between the contact points count too, unless
        each point is tested against its nearest bodies only.
        """
        gaps = []
        for points, bodies in self._examined(rod):
            radii = points.of_elements(rod.radii)
            place = points.of_nodes(motion_of(state).position)
            gaps += [jnp.min(body.surface(place)[0] / radii) for body in bodies]
        return jnp.maximum(1 - functools.reduce(jnp.minimum, gaps), 0)

    def passages(self, rod: Rod, before: RodState, after: RodState) -> Array:
        """Number of points of the rod that went through a body between two states.

        Contact points and points halfway between them are examined, with all bodies.
        """
        points = _denser(rod, self.points_per_element)
        radii = jnp.concatenate([some.of_elements(rod.radii) for some in points])

        def joined(state: RodState) -> Vec3:
            place = motion_of(state).position
            x, y, z = zip(*(some.of_nodes(place) for some in points), strict=True)
            return jnp.concatenate(x), jnp.concatenate(y), jnp.concatenate(z)

        first, last = joined(before), joined(after)

        def through(body: Body) -> Array:
            return passages(body.surface, radii, first, last)

        if self.n_bodies is None:
            return through(self.body)
        return jnp.sum(lax.map(through, self.body))

    def check(self, rod: Rod) -> None:
        """Warns where a body is too thin for the contact points, or inaccurate."""
        self.body.check(rod)
        check_spacing(self.body.inradius, rod, self.points_per_element)

    def force_directions(self, rod: Rod, motion: Motion) -> Vec3:
        """Normals of the bodies at the nodes, whether the rod touches them or not.

        They are set to zero deep inside, where no node gets: there the nearest face of
        a short post is its top or its bottom.
        """
        deepest = jnp.max(rod.radii)

        def normals(body: Body) -> Vec3:
            distance, normal = body.surface(motion.position)
            return vectors.scale(jnp.where(distance > -deepest, 1, 0), normal)

        if self.n_bodies is None:
            return normals(self.body)
        return jax.vmap(normals)(self.body)

    def resampled(self, rod: Rod, new_rod: Rod) -> Contact:
        """The contact for `new_rod`, with all its points tested against all bodies."""
        return dataclasses.replace(self, near=None, n_near=None)

    def softened(self, share: ArrayLike) -> Contact:
        """Copy with a share of the stiffness that bounces as before."""
        return softened_law(self, share)

    def thinned(self, share: float) -> Contact:
        """Copy with a share of the contact points per element, at least one."""
        per = fewer_points(self.points_per_element, share)
        return dataclasses.replace(self, points_per_element=per)

    def with_free_ends(self, free: Float[Array, "2"]) -> Contact:
        """The contact with flags of free ends; only free ends have an end face."""
        return dataclasses.replace(self, free_ends=free)

    @property
    def without_slip(self) -> Contact:
        """The same contact, whose static friction holds if it has any."""
        return self

    def seen_by(self, see: See) -> Contact:
        """The same contact for bodies with a frame of their own; here itself.

        Contact with memory returns a copy whose memory is seen from there.

        Args:
            see: Function from positions and orientations in the world to those in the
                frame of the bodies.
        """
        return self

    def _grips(self, rod: Rod, motion: Motion) -> list[Sequence[Any]]:
        """Memory of friction at each group of points, one entry for each body.

        Contact of this class has no memory: its entries are `None`.
        """
        return [[None] * len(bodies) for _, bodies in self._in_view(rod)]

    def _points(self, rod: Rod) -> list[Points]:
        return contact_points(rod, self.points_per_element, self.free_ends)

    def _in_view(self, rod: Rod) -> list[tuple[Points, list[Body]]]:
        """Groups of contact points, each with a list of the bodies to test."""
        points = self._points(rod)
        if self.near is None:
            everything = _one_by_one(self.body, self.n_bodies)
            return [(some, everything) for some in points]
        return [
            (some, _one_by_one(bodies, self.n_near))
            for some, bodies in zip(points, self.near, strict=True)
        ]

    def _examined(self, rod: Rod) -> list[tuple[Points, list[Body]]]:
        """Groups of points where the depth is measured, each with its bodies."""
        if self.near is not None:
            return self._in_view(rod)
        everything = _one_by_one(self.body, self.n_bodies)
        return [(p, everything) for p in _denser(rod, self.points_per_element)]

    def _energy_at(
        self,
        rod: Rod,
        motion: Motion,
        points: Points,
        bodies: list[Body],
        grips: Sequence[Any],
    ) -> Array:
        """Energy of the springs of `bodies` at one group of contact points [J].

        `grips` is the memory of friction, one entry for each body.
        """
        radii = points.of_elements(rod.radii)
        place = points.of_nodes(motion.position)

        def of_body(pair: tuple[Body, Any]) -> Array:
            body, grip = pair
            distance, normal = body.surface(place)
            density = self._density(radii, distance)
            if grip is not None:
                push = self._still_push(points, body, place, distance, radii)
                density = density + grip.density(push, radii, normal)
            total = jnp.sum(points.lengths * density)
            if points.ends is None:
                return total
            ends = points.ends
            beside, _ = body.of_ends().surface(ends.beside(place))
            counted = ends.counted(
                ends.of_points(distance), beside, self._depth(ends.of_points(radii))
            )
            return total + jnp.sum(counted * ends.of_points(density))

        return _summed(of_body, list(zip(bodies, grips, strict=True)))

    def _add_loads(
        self,
        loads: Loads,
        rod: Rod,
        motion: Motion,
        points: Points,
        bodies: list[Body],
        grips: Sequence[Any],
    ) -> Loads:
        """Adds loads of `bodies` on one group of points, couples in the world frame.

        `grips` is the memory of friction, one entry for each body.
        """
        position = points.of_nodes(motion.position)
        velocity = points.of_nodes(motion.velocity)
        radii = points.of_elements(rod.radii)
        spin = None
        if self.friction is not None:
            x, y, z = (points.of_elements(c) for c in motion.angular_velocities(rod))
            spin = x, y, z
        axis = None
        if self.is_directional:
            d3 = directors(motion.orientation)[2]
            x, y, z = (points.of_elements(c) for c in d3)
            axis = x, y, z

        def of_body(pair: tuple[Body, Any]) -> _OfBody:
            body, grip = pair
            distance, normal = body.surface(position)
            leaving = vectors.dot(velocity, normal)
            push = normal_force(
                radii - distance,
                leaving,
                self.onset * radii,
                self.stiffness,
                self.damping,
            )
            # Per length: forces, and the friction and lever arm that turn the section.
            pressed, arm, drag = vectors.scale(push, normal), None, None
            if spin is not None:
                arm = vectors.scale(-radii, normal)
                slip = vectors.add(velocity, vectors.cross(spin, arm))
                along = vectors.subtract(slip, vectors.scale(leaving, normal))
                more = self._more_at_ends(points, body, position, distance, radii)
                drag = self._friction(push + more, along, normal, axis, arm, grip)
                pressed = vectors.add(pressed, drag)

            def counted(lengths: Array, at: Callable[[Array], Array]) -> _Pushed:
                """Forces and friction couples on lengths of rod.

                `at` takes the values at their points from a field on all points.
                """
                force = vectors.scale(lengths, _each(at, pressed))
                if drag is None or arm is None:
                    return _Pushed(force, None)
                rub = vectors.scale(lengths, _each(at, drag))
                return _Pushed(force, vectors.cross(_each(at, arm), rub))

            along_rod = counted(points.lengths, lambda field: field)
            if points.ends is None:
                return _OfBody(along_rod, None, None)
            ends = points.ends
            beside, outward = body.of_ends().surface(ends.beside(position))
            own, own_radii = ends.of_points(distance), ends.of_points(radii)
            density = self._density(own_radii, own)
            if grip is not None:
                still = self._still_push(points, body, position, distance, radii)
                held = grip.density(still, radii, normal)
                density = density + ends.of_points(held)
            lengths, change, pulls = ends.counted_and_changes(
                own, beside, self._depth(own_radii), density
            )
            at_ends = counted(lengths, ends.of_points)
            change_of_ends = vectors.scale(change, _each(ends.of_points, normal))
            at_ends = at_ends._replace(force=vectors.add(at_ends.force, change_of_ends))
            return _OfBody(along_rod, at_ends, vectors.scale(pulls, outward))

        # Forces on ends are spread over the points once, not for every body.
        found = _summed(of_body, list(zip(bodies, grips, strict=True)))
        force, couple = found.along_rod
        if found.at_ends is not None and points.ends is not None:
            ends = points.ends
            at_ends, turning = found.at_ends
            force = vectors.add(force, _each(ends.to_points, at_ends))
            force = vectors.add(force, _each(ends.from_beside, found.beside))
            if couple is not None:
                couple = vectors.add(couple, _each(ends.to_points, turning))
        forces = points.to_nodes(force)
        if loads.forces is not None:
            forces = accumulate(forces, loads.forces)
        if couple is None:
            return Loads(forces)
        x, y, z = (points.to_elements(c) for c in couple)
        return Loads(forces, accumulate((x, y, z), loads.couples))

    def _more_at_ends(
        self, points: Points, body: Body, place: Vec3, distance: Array, radii: Array
    ) -> Array | float:
        """Force per length by which ends press more than `normal_force` [N/m].

        It limits friction with the rest. Pairs of forces at an end and beside it do
        not: they cancel.
        """
        if points.ends is None:
            return 0.0
        ends = points.ends
        own, own_radii = ends.of_points(distance), ends.of_points(radii)
        beside, _ = body.of_ends().surface(ends.beside(place))
        grows = ends.deepened(own, beside, self._depth(own_radii))
        return ends.to_points(self._density(own_radii, own) * grows)

    def _still_push(
        self, points: Points, body: Body, place: Vec3, distance: Array, radii: Array
    ) -> Array:
        """Normal force per length that limits friction, at rest [N/m]."""
        still = jnp.zeros_like(distance)
        push = normal_force(radii - distance, still, self.onset * radii, self.stiffness)
        return push + self._more_at_ends(points, body, place, distance, radii)

    def _depth(self, radii: Array) -> Callable[[Array], Array]:
        """Function from the distance d of the centreline to r - d + w/2 [m].

        r is an entry of `radii`, and w the width of the onset. Without contact the
        value is w, because `Ends.counted` needs positive ones. It is a function because
        `Ends` differentiates lengths with respect to distances.
        """
        return lambda distance: depth_from_onset(radii - distance, self.onset * radii)

    def _density(self, radii: Array, distance: Array) -> Array:
        """Spring energy per length at a rod axis's `distance` from a body [J/m]."""
        return energy_density(radii - distance, self.onset * radii, self.stiffness)

    def _friction(
        self,
        push: Array,
        slip: Vec3,
        normal: Vec3,
        axis: Vec3 | None,
        arm: Vec3,
        grip: Any,
    ) -> Vec3:
        """Friction force per length [N/m], at a slip velocity and a normal force.

        Args:
            push: Normal force per length [N/m].
            slip: Slip velocity, along the surface [m/s].
            normal: Unit normal of the surface.
            axis: d3 for directional friction, `None` for isotropic friction.
            arm: From the centre of each section to the place that it touches [m].
            grip: Memory of friction; here `None`.
        """
        assert self.friction is not None and self.friction_drag is not None
        if axis is None:
            return friction_force(push, slip, self.friction, self.friction_drag)
        return directional_friction_force(
            push,
            slip,
            along_surface(axis, normal),
            self.friction,
            self.friction_drag,
            self.stick_ratio,
        )


class _Pushed(NamedTuple):
    """Forces on contact points or ends [N], and couples there, world frame [N m]."""

    force: Vec3
    couple: Vec3 | None


class _OfBody(NamedTuple):
    """Loads of one body on a group of contact points and on the ends of the rod."""

    along_rod: _Pushed
    """Loads on the contact points other than the ends."""
    at_ends: _Pushed | None
    """Loads on the ends; `None` if they are not among the points."""
    beside: Vec3 | None
    """Forces at the points beside the ends, where `Ends` measures slopes [N]."""


def _each(change: Callable[[Array], Array], vector: Vec3) -> Vec3:
    """Applies a function to each component of a vector."""
    x, y, z = (change(component) for component in vector)
    return x, y, z


def _denser(rod: Rod, per_element: int) -> list[Points]:
    """Contact points, and those halfway between."""
    return contact_points(rod, 2 * per_element)


def _lengths_in_bounds(points: list[Points]) -> tuple[Array, Array, Array]:
    """Lengths that bound stiffness and drag of nodes, and drag of elements [m].

    Each bound is a length times the stiffness or drag per length. `points` are the
    groups of contact points.
    """
    stiff, slow, turning = [], [], []
    for some in points:
        bound = longest = some.lengths
        if some.ends is not None:
            bound = bound + some.ends.bound()
            longest = longest + some.ends.longest()
        stiff.append(some.to_nodes((bound, bound, bound))[0])
        slow.append(some.to_nodes((longest, longest, longest))[0])
        turning.append(some.to_elements(longest))
    first, second, third = (
        functools.reduce(jnp.add, each) for each in (stiff, slow, turning)
    )
    return first, second, third


def _one_by_one(body: Body, count: int | None) -> list[Body]:
    """Splits bodies with a leading axis into a list; `count` is `None` for one body."""
    if count is None:
        return [body]
    return [jax.tree.map(operator.itemgetter(k), body) for k in range(count)]


def _summed(of_body: Callable[[Any], Any], bodies: Sequence[Any]) -> Any:
    """Sum of a function's values over all bodies.

    The program computes body by body, not along an axis of the arrays: that takes two
    thirds of the time on CPUs.
    """
    first, *others = [of_body(body) for body in bodies]
    return functools.reduce(partial(jax.tree.map, jnp.add), others, first)


MOST_POINTS = 1000
"""Largest number of contact points per element. Each of them is in the compiled
program, so a larger number must be a mistake."""


def contact(
    bodies: Body | Sequence[Body],
    *,
    stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    friction: Numbers = 0.0,
    friction_drag: Numbers | None = None,
    stick_ratio: Numbers = 1.0,
    onset: Numbers = 0.01,
    points_per_element: int = 1,
) -> Contact:
    """Contact of the rod with a fixed body, or with several of one kind.

    All loads are per length of rod: a rod of weight `W` and length `L` rests on a
    plane at a penetration of `W / (stiffness L)`, however many elements it has. The
    face of an end that meets a surface at an angle counts as much length as the rod is
    thick, times the square of the angle's sine: a rod that stands on an end sinks in by
    about `W / (2 stiffness radius)` (`jaxrod.contacts.ends`).
    `stable_dt` counts stiffness, damping and friction drag as if all of the rod
    touched: a stiffness well below `linear_density * frequency^2` of the rod's fastest
    motion costs next to nothing. The stiffness that prevents tunnelling grows with the
    square of the impact speed.

    Args:
        bodies: A body from `jaxrod.shapes.sphere`, `capsule`, `cylinder`, `plane`,
            `box` or `signed_distance`. Several of the same kind are given as a
            sequence, or as one body whose numbers have a leading axis (from `jax.vmap`
            of a factory). Each adds to the compiled program; a dozen bodies cost more
            than the rod itself, and then `jaxrod.near_contact` helps.
        stiffness: Force per length of rod and penetration [N/m^2]. If it is left out,
            `make_scene` chooses it so that this contact halves `stable_dt`
            (`jaxrod.contacts.default_law`). It then also chooses damping and friction
            drag, unless they are given.
        damping: Force per length of rod and normal speed [kg/(m s)]; zero by default if
            the stiffness is given.
        friction: Coefficient of Coulomb friction, or three coefficients, such as those
            of scales and bristles: for slip forward (along d3, from the first node to
            the last), backward and sideways [1].
        friction_drag: Largest friction per length of rod and slip speed [kg/(m s)]; by
            default equal to `damping`. It is chosen with the stiffness if both that and
            the damping are left out. A sticking contact creeps at (tangential load
            per length) / friction_drag, divided by the square root of
            $1 - (T / (f N))^2$ with the tangential load $T$, `friction` $f$ and the
            normal force $N$: the closer to slipping, the faster. With
            `sticking_contact` it does not creep.
        stick_ratio: Factor by which friction grows as slip vanishes, at least 1;
            `friction` is that of sliding. Because friction sets in smoothly, a rod
            withstands less than this factor times sliding friction: at most 1.18, 1.49
            or 2 times with a ratio of 1.5, 2 or 2.8. With a ratio above 1, friction
            falls with speed once a rod slips faster than it creeps; this makes rods
            stick and slip [1].
        onset: Width of the smooth onset of contact, divided by the rod's radius [1].
            The force starts half a width before rod and body touch and is linear beyond
            half a width of penetration.
        points_per_element: Contact points per element: 1 for the nodes alone, 2 for
            nodes and middles, and so on. Neighbouring points should be nearer to each
            other than the sum of the radii of rod and body; from one and a half times
            this sum on, bodies slip through between the points. `make_scene` warns
            where the points are too far apart.

    Returns:
        An effect to list in a scene.

    Raises:
        ValueError: If a number is out of range, or friction is given without drag.
        TypeError: If the bodies are not bodies, or not all of one kind.

    Example:
        >>> floor = shapes.plane((0.0, 0.0, -0.019))  # 1 mm into the rod
        >>> ground = jaxrod.contact(floor, stiffness=1e4)
        >>> scene, dt = jaxrod.make_scene(rod, ground), 1e-4
        >>> pushed = jaxrod.step(scene, state, dt)
        >>> round(float(scene.momentum(pushed)[2] / dt), 1)  # 1e4 * 0.001 m * 1 m [N]
        10.0
    """
    body, n_bodies = _gathered(bodies)
    damps = None if damping is None else _or_none("damping", damping, "kg/(m s)")
    rubs = _or_none("friction", friction, "", [(), (3,)])
    sticks = None
    if is_traced(stick_ratio) or np.any(np.asarray(stick_ratio) != 1.0):
        sticks = as_array("stick_ratio", stick_ratio, "", non_negative=True)
        if not is_traced(sticks) and float(sticks) < 1:
            raise ValueError(f"stick_ratio must be at least 1, got {float(sticks):g}")
        if rubs is not None and rubs.ndim == 0:
            rubs = jnp.stack([rubs, rubs, rubs])
    drag = damping if friction_drag is None else friction_drag
    drags = None if drag is None else _or_none("friction_drag", drag, "kg/(m s)")
    missing = left_out(stiffness, damping, rubs, friction_drag)
    if rubs is not None and drags is None and "friction_drag" not in missing:
        raise ValueError(
            "friction needs friction_drag > 0 kg/(m s), its resistance per length and "
            "speed at the onset of slip (by default the damping), got 0"
        )
    return Contact(
        body=body,
        stiffness=(
            jnp.asarray(jnp.nan, jnp.result_type(float))
            if stiffness is None
            else as_array("stiffness", stiffness, "N/m^2", positive=True)
        ),
        left_out=missing,
        onset=as_array("onset", onset, "", positive=True),
        damping=damps,
        friction=rubs,
        friction_drag=None if rubs is None else drags,
        stick_ratio=None if rubs is None else sticks,
        n_bodies=n_bodies,
        points_per_element=check_count(
            "points_per_element", points_per_element, 1, MOST_POINTS
        ),
    )


def _or_none(
    name: str, value: Numbers, unit: str, shapes: Sequence[tuple[int, ...]] = ((),)
) -> Array | None:
    """One or several numbers as an array, or `None` if they are known to be zero.

    `name` and `unit` are for error messages; `shapes` are the allowed shapes.
    """
    dtype = jnp.result_type(float)
    checked = check_array(name, value, shapes, unit, non_negative=True, dtype=dtype)
    known_zero = not is_traced(checked) and not np.any(checked)
    return None if known_zero else jnp.asarray(checked, dtype)


def _gathered(bodies: Body | Sequence[Body]) -> tuple[Body, int | None]:
    """Bodies merged into one, with a leading axis if several; and their number."""
    if isinstance(bodies, Body):
        return bodies, bodies.count
    if not isinstance(bodies, Sequence):
        raise TypeError(
            "bodies must be a jaxrod body or a sequence of them, got "
            f"{type(bodies).__name__}"
        )
    listed = list(bodies)
    if not listed:
        raise ValueError("bodies must contain at least one body, got none")
    kinds: list[Any] = [jax.tree.structure(body) for body in listed]
    for body, kind in zip(listed, kinds, strict=True):
        if not isinstance(body, Body):
            raise TypeError(f"bodies must be jaxrod bodies, got {type(body).__name__}")
        if kind != kinds[0]:
            raise TypeError(
                "bodies of one contact must be of one kind, got "
                f"{type(listed[0]).__name__} and {type(body).__name__}; list a "
                "contact for each kind in the scene"
            )
        if body.count is not None:
            raise TypeError("each entry of a sequence of bodies must be a single body")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *listed), len(listed)
