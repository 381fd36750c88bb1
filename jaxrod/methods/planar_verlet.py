r"""Position Verlet in a plane: one angle per element.

Everything that is zero in a plane is left out. With in-plane edge $\Delta x$, direction
$d$ and transverse vector $t = n \times d$ of an element, and $n$ the plane's normal,

$$\sigma_t = t\cdot\Delta x/\hat\ell, \quad \sigma_d = d\cdot\Delta x/\hat\ell - 1,
  \quad \kappa = (\theta_{k+1} - \theta_k)/\hat D.$$

Each law has its own planar step, in `planar_laws`. The planar steps equal the steps in
space to round-off, for a fraction of the arithmetic. Zero components out of the plane
stay exactly zero, for any number of calls; joint angles have no bound within a call.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    join_quaternion,
    multiply_quaternions,
    normalise,
    sine_ratio_and_cosine,
    split_quaternion,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import constrain, constrain_rates, dissipate, dissipates
from jaxrod.methods.verlet import Verlet
from jaxrod.rods.elasticity import joint_rotations
from jaxrod.rods.motion import Loads, Motion, Sections
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree, static

Vec2 = tuple[Array, Array]

PlaneName = Literal["xy", "yz", "zx"]
PLANES: dict[PlaneName, tuple[int, int, int]] = {
    "xy": (0, 1, 2),
    "yz": (1, 2, 0),
    "zx": (2, 0, 1),
}
"""Indices of the two axes and of the normal of each plane, right-handed."""


@pytree
class PlanarMotion:
    """A rod moving in a plane, as used inside a planar step."""

    position: Vec2
    """In-plane components of the node positions [m]."""
    turn: Array
    """Angle by which each element has rotated since the start of the run [rad]."""
    half: Vec2 | None
    """Cosine and sine of half that angle, carried along so that no step computes them.
    `None` where nothing looks at orientations in a run."""
    direction: Vec2
    """In-plane components of the unit vectors d3."""
    velocity: Vec2
    """In-plane components of the node velocities [m/s]."""
    spin: Array
    """Spin of the elements about the normal. Consistent law: angular momentum [kg
    m^2/s]. PyElastica's law: angular velocity [rad/s]."""
    remainder: Vec2 | None = None
    """Accumulated round-off of the positions (Kahan) [m]; `None` without
    compensation."""

    def turned(self, angle: Array) -> PlanarMotion:
        """Motion whose elements have rotated further about the normal [rad]."""
        turn = self.turn + angle
        if self.half is None:
            by = _cosine_and_sine(angle)
            return replace(self, turn=turn, direction=_turned(self.direction, by))
        by = _cosine_and_sine(0.5 * angle)
        return replace(
            self,
            turn=turn,
            half=_turned(self.half, by),
            # Its length is one to rounding already.
            direction=_turned(self.direction, _product(by, by)),
        )

    @property
    def edges(self) -> Vec2:
        """In-plane components of the vectors from each node to the next [m]."""
        (x, y) = self.position
        dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
        if self.remainder is None:
            return dx, dy
        x, y = self.remainder
        return dx - (x[1:] - x[:-1]), dy - (y[1:] - y[:-1])

    @property
    def lengths(self) -> Array:
        """Current element lengths [m]."""
        dx, dy = self.edges
        squared = dx * dx + dy * dy
        return jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))


@pytree
class PlanarRod:
    """Constants of a rod in a plane, computed from the first state of a run."""

    normal: Vec2
    """Components of the plane's normal along d1 and d2 of every element."""
    inverse_lengths: Array
    """Inverse rest lengths of the elements [1/m]."""
    stiffness: Vec2
    """Transverse shear and axial stiffness [N]."""
    rest_strains: Vec2
    """Transverse and axial strain at rest [1]."""
    joint: Array
    """Bending stiffness about the normal over joint length [N m]."""
    joint_offsets: Array
    """Joint angle at the start of the run minus that at rest [rad]."""
    joint_angles: Array
    """Joint angle at the start of the run [rad]."""

    @staticmethod
    def create(rod: Rod, state: RodState, plane: PlaneName) -> PlanarRod:
        """Computes the constants from the rod, the first state and the plane."""
        _, _, out = PLANES[plane]
        orientation = split_quaternion(state.orientations)
        d1, d2, _ = directors(orientation)
        n1, n2 = d1[out], d2[out]
        shear1, shear2, axial = vectors.split(rod.shear_stretch_stiffness)
        strain1, strain2, stretch = vectors.split(rod.rest_strains)
        bend1, bend2, _ = vectors.split(rod.joint_stiffness)
        rest1, rest2, _ = vectors.split(rod.rest_curvatures)
        # A joint lies between two elements, whose normals agree.
        m1, m2 = n1[1:], n2[1:]
        angles, _ = joint_rotations(orientation)
        turned = m1 * angles[0] + m2 * angles[1]
        return PlanarRod(
            normal=(n1, n2),
            inverse_lengths=1 / rod.rest_lengths,
            stiffness=(n2 * n2 * shear1 + n1 * n1 * shear2, axial),
            rest_strains=(n2 * strain1 - n1 * strain2, stretch),
            joint=(m1 * m1 * bend1 + m2 * m2 * bend2) / rod.joint_lengths,
            joint_angles=turned,
            joint_offsets=turned - (m1 * rest1 + m2 * rest2) * rod.joint_lengths,
        )

    def stresses(self, across: Array, along: Array) -> Vec2:
        """Shear and axial forces in the elements [N].

        The edges are given by their components across and along the elements [m].
        """
        inverse = self.inverse_lengths
        shear = self.stiffness[0] * (across * inverse - self.rest_strains[0])
        axial = self.stiffness[1] * (along * inverse - 1 - self.rest_strains[1])
        return shear, axial

    def moments(self, turn: Array) -> Array:
        """Bending moments of the joints about the normal [N m].

        They are B/D times the change of the joint angle from rest; `turn` is the
        rotation of each element since the start of the run [rad].
        """
        return self.joint * (turn[1:] - turn[:-1] + self.joint_offsets)


def inertia_about_normal(rod: Rod, constants: PlanarRod) -> Array:
    """Rotary inertia of the elements about the plane's normal [kg m^2]."""
    if rod.is_round:
        return rod.inertias[0]
    one, two, _ = rod.principal_inertias
    n1, n2 = constants.normal
    return n1 * n1 * one + n2 * n2 * two


@pytree
class PlanarVerlet(Verlet):
    """Position Verlet of a rod in a plane, for either law."""

    plane: PlaneName = static()
    """The plane of motion."""
    start: RodState
    """State at the start of the run; its components out of the plane are kept."""
    constants: PlanarRod
    """Constants of the rod in the plane."""
    inverse_inertia: Array
    """Inverse rotary inertia of the elements about the normal [1/(kg m^2)]."""
    seen: bool = static()
    """Whether effects, or the couplings of a system, look at the motion in space."""

    @abstractmethod
    def angle_turned(self, spin: Array, dt: Array) -> Array:
        """Angle about the normal by which elements rotate in a time `dt` [rad]."""

    @abstractmethod
    def spin_from_momentum(self, momentum: Array) -> Array:
        """Converts angular momentum about the normal to `PlanarMotion.spin`."""

    @abstractmethod
    def momentum_from_spin(self, spin: Array) -> Array:
        """Converts `PlanarMotion.spin` to angular momentum about the normal."""

    @abstractmethod
    def spin_in_space(self, spin: Array) -> tuple[Vec3, bool]:
        """Converts `PlanarMotion.spin` to `Motion.spin` and `spin_is_velocity`."""

    @abstractmethod
    def spin_in_plane(self, spin: Vec3) -> Array:
        """Converts `Motion.spin` to `PlanarMotion.spin`."""

    def enter(self, state: RodState) -> PlanarMotion:
        """Unpacks the in-plane part of a state."""
        a, b, out = PLANES[self.plane]
        _, _, d3 = directors(split_quaternion(state.orientations))
        remainders = state.remainders
        motion = PlanarMotion(
            position=(state.positions[a], state.positions[b]),
            turn=jnp.zeros_like(d3[a]),
            half=(jnp.ones_like(d3[a]), jnp.zeros_like(d3[a])) if self.seen else None,
            direction=(d3[a], d3[b]),
            velocity=(state.velocities[a], state.velocities[b]),
            spin=self.spin_from_momentum(state.angular_momenta[out]),
            remainder=None if remainders is None else (remainders[a], remainders[b]),
        )
        return self.constrain_rates(self.constrain(motion))

    def leave(self, motion: PlanarMotion) -> RodState:
        """Packs a planar motion into a state in three dimensions."""
        _, _, out = PLANES[self.plane]
        start = self.start
        return RodState(
            positions=jnp.stack(self._in_space(motion.position, start.positions)),
            orientations=join_quaternion(
                _in_plane(self._orientation(motion), self.constants.normal, out)
            ),
            velocities=jnp.stack(self._in_space(motion.velocity, start.velocities)),
            angular_momenta=jnp.zeros_like(start.angular_momenta)
            .at[out]
            .set(self.momentum_from_spin(motion.spin)),
            remainders=vectors.join_optional(self._remainder(motion)),
        )

    def drift(self, motion: PlanarMotion, dt: Array) -> PlanarMotion:
        """Moves nodes and rotates elements at unchanged rates for `dt` [s]."""
        moved = motion.turned(self.angle_turned(motion.spin, dt))
        step = dt * motion.velocity[0], dt * motion.velocity[1]
        if motion.remainder is None:
            return self.constrain(replace(moved, position=_add(motion.position, step)))
        step = _subtract(step, motion.remainder)
        position = _add(motion.position, step)
        remainder = _subtract(_subtract(position, motion.position), step)
        return self.constrain(replace(moved, position=position, remainder=remainder))

    def add_loads(
        self, motion: PlanarMotion, forces: Vec2, couple: Array, others: Loads | None
    ) -> tuple[Vec2, Array]:
        """Adds in-plane forces and normal couples of all loads to the given ones.

        The loads are those of effects, and `others` from outside the scene.
        """
        a, b, _ = PLANES[self.plane]
        n1, n2 = self.constants.normal
        in_space = self.view(motion)
        sections = self._sections(motion, in_space.orientation)
        in_space = replace(in_space, known=sections)
        none = jnp.zeros_like(motion.position[0])

        def added(forces: Vec2, couple: Array, loads: Loads) -> tuple[Vec2, Array]:
            if loads.forces is not None:
                forces = forces[0] + loads.forces[a], forces[1] + loads.forces[b]
            if loads.couples is not None:
                couple = couple + n1 * loads.couples[0] + n2 * loads.couples[1]
            return forces, couple

        if others is not None:
            forces, couple = added(forces, couple, others)
        for effect in self.scene.effects:
            before = Loads(
                forces=self._in_space(forces, jnp.stack([none] * 3)),
                couples=(n1 * couple, n2 * couple, jnp.zeros_like(couple)),
            )
            loads = effect.loads_after(self.scene.rod, in_space, before)
            forces, couple = added(forces, couple, loads)
        return forces, couple

    def constrain(self, motion: PlanarMotion) -> PlanarMotion:
        """Applies the constraints of all effects on positions and orientations."""
        a, b, out = PLANES[self.plane]
        free = self.view(motion)
        held = constrain(self.scene, free)
        if held is free:
            return motion
        rest = held.remainder
        motion = replace(
            motion,
            position=(held.position[a], held.position[b]),
            remainder=None if rest is None else (rest[a], rest[b]),
        )
        if held.orientation is free.orientation:
            return motion
        # Angle by which constraints rotate elements, the short way around.
        turned = multiply_quaternions(held.orientation, conjugate(free.orientation))
        way = jnp.where(turned[0] < 0, -1, 1)
        half = way * turned[0], way * turned[1 + out]
        back = 2 * jnp.arctan2(half[1], half[0])
        pairs = zip(held.orientation, free.orientation, strict=True)
        is_held = jnp.any(jnp.stack([one != other for one, other in pairs]), axis=0)
        d3 = directors(held.orientation)[2]

        def chosen(held: Vec2, free: Vec2) -> Vec2:
            (x, y), (u, v) = held, free
            return jnp.where(is_held, x, u), jnp.where(is_held, y, v)

        return replace(
            motion,
            turn=jnp.where(is_held, motion.turn + back, motion.turn),
            half=motion.half and chosen(_turned(motion.half, half), motion.half),
            direction=chosen((d3[a], d3[b]), motion.direction),
        )

    def constrain_rates(self, motion: PlanarMotion) -> PlanarMotion:
        """Applies the constraints of all effects on velocities and spins."""
        a, b, _ = PLANES[self.plane]
        held = constrain_rates(self.scene, self.view(motion))
        velocity = held.velocity[a], held.velocity[b]
        return replace(motion, velocity=velocity, spin=self.spin_in_plane(held.spin))

    def dissipate(self, motion: PlanarMotion) -> PlanarMotion:
        """Applies the hook `dissipate` of all effects, for one step."""
        if not dissipates(self.scene):
            return motion
        a, b, _ = PLANES[self.plane]
        slowed = dissipate(self.scene, self.view(motion), self.dt)
        velocity = slowed.velocity[a], slowed.velocity[b]
        return replace(motion, velocity=velocity, spin=self.spin_in_plane(slowed.spin))

    def view(self, motion: PlanarMotion) -> Motion:
        """Motion in three dimensions, in the form that effects take.

        The compiler drops fields that no effect reads.
        """
        start = self.start
        spin, is_velocity = self.spin_in_space(motion.spin)
        return Motion(
            position=self._in_space(motion.position, start.positions),
            orientation=self._orientation(motion),
            velocity=self._in_space(motion.velocity, jnp.zeros_like(start.velocities)),
            spin=spin,
            remainder=self._remainder(motion),
            spin_is_velocity=is_velocity,
        )

    def moved_as(self, motion: PlanarMotion, seen: Motion) -> PlanarMotion:
        """Motion whose nodes have the in-plane positions and velocities of `seen`."""
        a, b, _ = PLANES[self.plane]
        rest = seen.remainder
        return replace(
            motion,
            position=(seen.position[a], seen.position[b]),
            velocity=(seen.velocity[a], seen.velocity[b]),
            remainder=None if rest is None else (rest[a], rest[b]),
        )

    def _remainder(self, motion: PlanarMotion) -> Vec3 | None:
        """Round-off of positions: two parts in the plane; the normal one of `start`."""
        if motion.remainder is None or self.start.remainders is None:
            return None
        return self._in_space(motion.remainder, self.start.remainders)

    def _in_space(self, inside: Vec2, outside: Array) -> Vec3:
        """World components of a vector, two of them `inside` the plane.

        The normal one is taken from `outside`, three world components `(3, n)`.
        """
        a, b, _ = PLANES[self.plane]
        components = [outside[0], outside[1], outside[2]]
        components[a], components[b] = inside
        return components[0], components[1], components[2]

    def _sections(self, motion: PlanarMotion, of: Quaternion) -> Sections:
        """Frames and strains without quaternions, from directions and angles.

        With the normal e and t = e x d3, d1 is n1 e + n2 t, and d2 is n2 e - n1 t.
        """
        none = jnp.zeros_like(motion.turn)
        n1, n2 = self.constants.normal
        x, y = motion.direction
        along = self._in_space((x, y), jnp.stack([none] * 3))
        frame = (
            self._in_space((-n2 * y, n2 * x), jnp.stack([n1] * 3)),
            self._in_space((n1 * y, -n1 * x), jnp.stack([n2] * 3)),
            along,
        )
        dx, dy = motion.edges
        across, forwards = x * dy - y * dx, x * dx + y * dy
        angle = motion.turn[1:] - motion.turn[:-1] + self.constants.joint_angles
        return Sections(
            of=of,
            frame=frame,
            edges=(n2 * across, -n1 * across, forwards),
            rotations=(n1[1:] * angle, n2[1:] * angle, jnp.zeros_like(angle)),
        )

    def _orientation(self, motion: PlanarMotion) -> Quaternion:
        """Orientations of the first state, rotated about the normal by `turn`."""
        zero = jnp.zeros_like(motion.turn)
        turn = [zero, zero, zero]
        half = 0.5 * motion.turn
        cosine, sine = motion.half or (jnp.cos(half), jnp.sin(half))
        turn[PLANES[self.plane][2]] = sine
        turned = (cosine, turn[0], turn[1], turn[2])
        start = split_quaternion(self.start.orientations)
        return normalise(multiply_quaternions(turned, start))


def spread(a: Array) -> Array:
    """Differences a[k] - a[k-1], with zeros beyond the ends: one entry more than `a`.

    For internal forces of elements it is the sum of forces on every node.
    """
    return vectors.pad(a, 0, 1) - vectors.pad(a, 1, 0)


def _cosine_and_sine(angle: Array) -> Vec2:
    """Cosine and sine of an angle [rad], the sine to full relative accuracy."""
    sine_ratio, cosine = sine_ratio_and_cosine(angle * angle)
    return cosine, angle * sine_ratio


def _product(vector: Vec2, by: Vec2) -> Vec2:
    """Product of complex numbers: unit vectors rotated by angles."""
    (x, y), (c, s) = vector, by
    return x * c - y * s, y * c + x * s


def _turned(vector: Vec2, by: Vec2) -> Vec2:
    """Unit vectors rotated by angles, given by cosine and sine; of length one."""
    x, y = _product(vector, by)
    # One step of Newton's method towards unit length.
    length = 1.5 - 0.5 * (x * x + y * y)
    return x * length, y * length


def _in_plane(orientation: Quaternion, normal: Vec2, out: int) -> Quaternion:
    """Nearest orientation to a given one whose elements lie exactly in the plane.

    Quaternions q that rotate the material vector m into the plane's normal e satisfy
    e q = q m; (q - e q m)/2 is the nearest. All elements share one m, because they are
    not twisted. Without this, round-off would tilt and twist them a little more in
    every call. `normal` has m's components along d1 and d2; `out` is the axis of e.
    """
    n1, n2 = _but_for_rounding(normal[0]), _but_for_rounding(normal[1])
    length = jnp.sqrt(n1 * n1 + n2 * n2)
    m1, m2 = n1 / length, n2 / length
    # e q: one component is minus a component of q, the others are permuted.
    scalar, vector = orientation[0], orientation[1:]
    a, b, c = vector[out], scalar, vector
    turned = [c[0], c[1], c[2]]
    turned[out] = b
    turned[(out + 1) % 3], turned[(out + 2) % 3] = -c[(out + 2) % 3], c[(out + 1) % 3]
    w, (x, y, z) = -a, turned
    return normalise(
        (
            orientation[0] + (x * m1 + y * m2),
            orientation[1] - (w * m1 - z * m2),
            orientation[2] - (w * m2 + z * m1),
            orientation[3] - (x * m2 - y * m1),
        )
    )


def _but_for_rounding(component: Array) -> Array:
    """Mean over the elements of a component of the plane's normal along d1 or d2.

    It is exactly zero if it is only round-off: most normals are along d1 or d2.
    """
    mean = jnp.mean(component)
    return jnp.where(jnp.abs(mean) < 64 * jnp.finfo(mean.dtype).eps, 0, mean)


def _add(a: Vec2, b: Vec2) -> Vec2:
    return a[0] + b[0], a[1] + b[1]


def _subtract(a: Vec2, b: Vec2) -> Vec2:
    return a[0] - b[0], a[1] - b[1]
