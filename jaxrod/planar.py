r"""Planar scenes: motion in a plane, one angle per element.

The consistent law and step of `jaxrod.consistent` with everything left out that is
zero in a plane: with in-plane edge $\Delta x$, direction $d$ and transverse
$t = n \times d$ of an element, $n$ the plane's normal,

$$\sigma_t = t\cdot\Delta x/\hat\ell, \quad \sigma_d = d\cdot\Delta x/\hat\ell - 1,
  \quad \kappa = (\theta_{k+1} - \theta_k)/\hat D,$$

and elements turn at $\dot\theta = P/J$ between kicks. Equal to the three-dimensional
result to round-off, for a third of its arithmetic or less. Joint angles have no bound
here.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod import vectors
from jaxrod._pytree import pytree
from jaxrod.elasticity import joint_rotations
from jaxrod.kick import Kick
from jaxrod.motion import Motion
from jaxrod.rod import RodState
from jaxrod.rotations import (
    Quaternion,
    conjugate,
    directors,
    join_quaternion,
    multiply_quaternions,
    normalise,
    sine_ratio_and_cosine,
    split_quaternion,
)
from jaxrod.scene import PLANES, Scene, damping_rates, hold, hold_rates
from jaxrod.vectors import Vec3
from jaxrod.verlet import Verlet

Vec2 = tuple[Array, Array]


@pytree
class PlanarMotion:
    """A rod moving in a plane, as the inside of a planar step sees it."""

    position: Vec2
    """In-plane components of the node positions [m]."""
    turn: Array
    """Angle each element has turned since the start of the call [rad]."""
    direction: Vec2
    """In-plane components of the unit vectors d3."""
    velocity: Vec2
    """In-plane components of the node velocities [m/s]."""
    spin: Array
    """Angular momentum of the elements about the normal [kg m^2/s]."""
    remainder: Vec2 | None = None
    """What rounding has added to the positions [m], where that is kept count of."""


@pytree
class PlanarStepper(Verlet):
    """Constants of the planar step for one scene, one step size, one plane."""

    scene: Scene
    dt: Array
    """Step size [s]."""
    start: RodState
    """The state at the start of the call: what lies out of the plane stays so."""
    normal: Vec2
    """The plane's normal along d1 and d2 of every element."""
    inverse_lengths: Array
    """[1/m]"""
    stiffness: Vec2
    """Transverse shear and axial stiffness [N]."""
    rest_strains: Vec2
    """Transverse and axial [1]."""
    joint: Array
    """Bending stiffness over joint length [N m]."""
    joint_offsets: Array
    """Joint angle at the start of the call less that at rest [rad]."""
    inverse_inertia: Array
    """[1/(kg m^2)]"""
    velocity_kick: Kick
    spin_kick: Kick

    @staticmethod
    def create(scene: Scene, state: RodState, dt: Array) -> PlanarStepper:
        """Works out the constants once, outside the loop."""
        rod = scene.rod
        _, _, out = _axes(scene)
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
        transverse, _ = rod.inertias
        rates = damping_rates(scene) or (None, None)
        return PlanarStepper(
            scene=scene,
            dt=dt,
            start=state,
            normal=(n1, n2),
            inverse_lengths=1 / rod.rest_lengths,
            stiffness=(n2 * n2 * shear1 + n1 * n1 * shear2, axial),
            rest_strains=(n2 * strain1 - n1 * strain2, stretch),
            joint=(m1 * m1 * bend1 + m2 * m2 * bend2) / rod.joint_lengths,
            joint_offsets=turned - (m1 * rest1 + m2 * rest2) * rod.joint_lengths,
            inverse_inertia=1 / transverse,
            velocity_kick=Kick.create(1 / rod.node_masses, rates[0], dt),
            spin_kick=Kick.create(None, rates[1], dt),
        )

    def enter(self, state: RodState) -> PlanarMotion:
        """Takes the in-plane part of a state apart."""
        a, b, out = _axes(self.scene)
        _, _, d3 = directors(split_quaternion(state.orientations))
        remainders = state.remainders
        motion = PlanarMotion(
            position=(state.positions[a], state.positions[b]),
            turn=jnp.zeros_like(d3[a]),
            direction=(d3[a], d3[b]),
            velocity=(state.velocities[a], state.velocities[b]),
            spin=state.angular_momenta[out],
            remainder=None if remainders is None else (remainders[a], remainders[b]),
        )
        return self.hold_rates(self.hold(motion))

    def leave(self, motion: PlanarMotion) -> RodState:
        """Puts the state together again."""
        out = _axes(self.scene)[2]
        start = self.start
        return RodState(
            positions=jnp.stack(self._in_space(motion.position, start.positions)),
            orientations=join_quaternion(self._orientation(motion)),
            velocities=jnp.stack(self._in_space(motion.velocity, start.velocities)),
            angular_momenta=jnp.zeros_like(start.angular_momenta)
            .at[out]
            .set(motion.spin),
            remainders=vectors.join_optional(self._remainder(motion)),
        )

    def drift(self, motion: PlanarMotion, dt: Array) -> PlanarMotion:
        """Moves nodes and turns elements at unchanged rates for `dt` [s]."""
        turn = dt * self.inverse_inertia * motion.spin
        sine_ratio, c = sine_ratio_and_cosine(turn * turn)
        s = turn * sine_ratio
        x, y = motion.direction
        x, y = x * c - y * s, y * c + x * s
        # One step of Newton's method towards unit length.
        length = 1.5 - 0.5 * (x * x + y * y)
        moved = replace(
            motion, turn=motion.turn + turn, direction=(x * length, y * length)
        )
        step = dt * motion.velocity[0], dt * motion.velocity[1]
        if motion.remainder is None:
            return self.hold(replace(moved, position=_add(motion.position, step)))
        step = _subtract(step, motion.remainder)
        position = _add(motion.position, step)
        remainder = _subtract(_subtract(position, motion.position), step)
        return self.hold(replace(moved, position=position, remainder=remainder))

    def kick(self, motion: PlanarMotion) -> PlanarMotion:
        """Changes velocities and angular momenta by all loads over one step."""
        (x, y), (c, s) = motion.position, motion.direction
        dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
        if motion.remainder is not None:
            x, y = motion.remainder
            dx, dy = dx - (x[1:] - x[:-1]), dy - (y[1:] - y[:-1])
        across, along = c * dy - s * dx, c * dx + s * dy
        inverse = self.inverse_lengths
        shear = self.stiffness[0] * (across * inverse - self.rest_strains[0])
        axial = self.stiffness[1] * (along * inverse - 1 - self.rest_strains[1])
        fx, fy = axial * c - shear * s, axial * s + shear * c
        turn = motion.turn
        moment = self.joint * (turn[1:] - turn[:-1] + self.joint_offsets)
        couple = (
            vectors.pad(moment, 0, 1)
            - vectors.pad(moment, 1, 0)
            + (along * shear - across * axial)
        )
        forces, couple = self.add_loads(motion, (_spread(fx), _spread(fy)), couple)
        u, v = motion.velocity
        kicked = replace(
            motion,
            velocity=(
                self.velocity_kick(u, forces[0]),
                self.velocity_kick(v, forces[1]),
            ),
            spin=self.spin_kick(motion.spin, couple),
        )
        return self.hold_rates(kicked)

    def add_loads(
        self, motion: PlanarMotion, forces: Vec2, couple: Array
    ) -> tuple[Vec2, Array]:
        """Adds the in-plane part of the loads of all effects."""
        a, b, _ = _axes(self.scene)
        in_space = self.in_space(motion)
        for effect in self.scene.effects:
            loads = effect.loads(self.scene.rod, in_space)
            if loads.forces is not None:
                forces = forces[0] + loads.forces[a], forces[1] + loads.forces[b]
            if loads.couples is not None:
                n1, n2 = self.normal
                couple = couple + n1 * loads.couples[0] + n2 * loads.couples[1]
        return forces, couple

    def hold(self, motion: PlanarMotion) -> PlanarMotion:
        """Applies all constraints on configuration."""
        a, b, out = _axes(self.scene)
        free = self.in_space(motion)
        held = hold(self.scene, free)
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
        # By how much elements are turned back, the short way around.
        turned = multiply_quaternions(held.orientation, conjugate(free.orientation))
        way = jnp.where(turned[0] < 0, -1, 1)
        back = 2 * jnp.arctan2(way * turned[1 + out], way * turned[0])
        pairs = zip(held.orientation, free.orientation, strict=True)
        is_held = jnp.any(jnp.stack([one != other for one, other in pairs]), axis=0)
        d3 = directors(held.orientation)[2]
        x, y = motion.direction
        return replace(
            motion,
            turn=jnp.where(is_held, motion.turn + back, motion.turn),
            direction=(jnp.where(is_held, d3[a], x), jnp.where(is_held, d3[b], y)),
        )

    def hold_rates(self, motion: PlanarMotion) -> PlanarMotion:
        """Applies all constraints on rates."""
        a, b, out = _axes(self.scene)
        held = hold_rates(self.scene, self.in_space(motion))
        velocity = held.velocity[a], held.velocity[b]
        return replace(motion, velocity=velocity, spin=held.spin[out])

    def in_space(self, motion: PlanarMotion) -> Motion:
        """The motion as effects see it. What they do not look at costs nothing."""
        start = self.start
        zero = jnp.zeros_like(motion.spin)
        return Motion(
            position=self._in_space(motion.position, start.positions),
            orientation=self._orientation(motion),
            velocity=self._in_space(motion.velocity, jnp.zeros_like(start.velocities)),
            spin=self._in_space((zero, zero), jnp.stack([motion.spin] * 3)),
            remainder=self._remainder(motion),
        )

    def _remainder(self, motion: PlanarMotion) -> Vec3 | None:
        """With that out of the plane, which stays as it is."""
        if motion.remainder is None or self.start.remainders is None:
            return None
        return self._in_space(motion.remainder, self.start.remainders)

    def _in_space(self, inside: Vec2, outside: Array) -> Vec3:
        """Three components from the two in the plane and the one out of it."""
        a, b, _ = _axes(self.scene)
        components = [outside[0], outside[1], outside[2]]
        components[a], components[b] = inside
        return components[0], components[1], components[2]

    def _orientation(self, motion: PlanarMotion) -> Quaternion:
        """The orientation at the start, turned about the normal."""
        zero = jnp.zeros_like(motion.turn)
        turn = [zero, zero, zero]
        turn[_axes(self.scene)[2]] = jnp.sin(0.5 * motion.turn)
        turned = (jnp.cos(0.5 * motion.turn), turn[0], turn[1], turn[2])
        start = split_quaternion(self.start.orientations)
        return normalise(multiply_quaternions(turned, start))


def _axes(scene: Scene) -> tuple[int, int, int]:
    """Indices of the two axes of the plane and of its normal, right-handed."""
    assert scene.plane is not None
    return PLANES[scene.plane]


def _add(a: Vec2, b: Vec2) -> Vec2:
    return a[0] + b[0], a[1] + b[1]


def _subtract(a: Vec2, b: Vec2) -> Vec2:
    return a[0] - b[0], a[1] - b[1]


def _spread(a: Array) -> Array:
    """Difference to the surrounding grid: internal forces on nodes."""
    return vectors.pad(a, 0, 1) - vectors.pad(a, 1, 0)
