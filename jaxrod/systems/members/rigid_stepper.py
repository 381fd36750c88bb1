"""State and steps of rigid bodies: free flight and free rotation between kicks.

Nodes of rods that are attached to a body move with it. The body carries their masses:
its centre of mass and its inertia are those of body and nodes together. Outside of this
file, forces and positions refer to the origin of the body's own frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import matrices, vectors
from jaxrod.geometry.matrices import Matrix
from jaxrod.geometry.rotations import (
    Quaternion,
    directors,
    directors_from_orientations,
    freely_turned,
    join_quaternion,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.methods.verlet import Kick
from jaxrod.rods.motion import Loads, Motion, accumulate
from jaxrod.rods.rod import Layout
from jaxrod.structure import pytree
from jaxrod.systems.coupling import Carried, Parts, Seen


@pytree
class BodyState:
    """State of one or more rigid bodies.

    Example:
        >>> shape = shapes.sphere((0.0, 0.0, 0.5), radius=0.1)
        >>> ball, there = systems.rigid_body(shape, mass=1.0, velocity=(1.0, 0.0, 0.0))
        >>> there.positions.shape, there.orientations.shape  # one body
        ((3, 1), (4, 1))
        >>> twice = replace(there, velocities=2.0 * there.velocities)
        >>> twice.velocities[:, 0].tolist()  # [m/s]
        [2.0, 0.0, 0.0]
    """

    positions: Float[Array, "3 k"]
    """Centres of mass, world frame [m]."""
    orientations: Float[Array, "4 k"]
    """Unit quaternions (w, x, y, z), body to world."""
    velocities: Float[Array, "3 k"]
    """Velocities of the centres of mass, world frame [m/s]."""
    angular_velocities: Float[Array, "3 k"]
    """Angular velocities, world frame [rad/s]."""

    @property
    def layout(self) -> Layout:
        """Layout of the state: the number of bodies, each one node and one element."""
        return Layout(self.positions.shape[-1])

    @property
    def rates(self) -> tuple[Array, Array]:
        """Velocities [m/s] and angular velocities [rad/s], world frame."""
        return self.velocities, self.angular_velocities

    def with_rates(self, velocities: Array, spins: Array) -> BodyState:
        """Copy with the given velocities [m/s] and angular velocities [rad/s]."""
        return replace(self, velocities=velocities, angular_velocities=spins)

    @property
    def directors(self) -> Float[Array, "3 3 k"]:
        """Body axes: `[i, j]` is world component j of axis i."""
        return directors_from_orientations(self.orientations)


@pytree
class RigidStepper:
    """Integrator of rigid bodies, with constants computed once per run."""

    bodies: Any
    """The bodies, as `RigidBodies`."""
    dt: Array
    """Step size [s]."""
    parts: Parts
    """Constants of the bodies, without carried masses."""
    mass: Array
    """Mass of each body with the masses it carries [kg]."""
    centre: Vec3 | None
    """Centres of mass of bodies with carried masses, in the bodies' frames [m]; `None`
    without carried masses."""
    inertia: Matrix | None
    """Inertia about `centre`, in the bodies' frames [kg m^2]; `None` without carried
    masses."""
    inverse_inertia: Matrix | None
    """Inverse of `inertia` [1/(kg m^2)]; `None` without carried masses."""
    velocity_kick: Kick
    """Change of velocities by forces and damping over one step; of the momenta of the
    bodies alone if they carry masses."""
    spin_kick: Kick
    """Change of angular momenta by couples and damping over one step; of those of the
    bodies alone if they carry masses."""

    @staticmethod
    def create(bodies: Any, carried: Carried | None, dt: Array) -> RigidStepper:
        """Computes constants for steps of `dt` [s] and `carried` masses (or `None`)."""
        parts = bodies.parts()
        mass, centre, inertia, inverse = bodies.masses, None, None, None
        if carried is not None:
            mass = mass + carried.mass
            centre = vectors.scale(1 / mass, carried.moment)
            inertia = _together(bodies.principal_inertias, carried, mass, centre)
            inverse = _inverse(inertia)
        rates = _damping(bodies)
        return RigidStepper(
            bodies=bodies,
            dt=dt,
            parts=parts,
            mass=mass,
            centre=centre,
            inertia=inertia,
            inverse_inertia=inverse,
            velocity_kick=Kick.create(
                1 / mass if carried is None else None, rates[0], dt
            ),
            spin_kick=Kick.create(None, rates[1], dt),
        )

    def enter(self, state: BodyState) -> Motion:
        """Motion of the centres of mass, from a state that refers to the origins.

        Carried masses are included. The spin is the angular momentum about the centre
        of mass.
        """
        orientation = split_quaternion(state.orientations)
        rate = vectors.split(state.angular_velocities)
        position, velocity = (
            vectors.split(state.positions),
            vectors.split(state.velocities),
        )
        frame = directors(orientation)
        own = to_material(frame, rate)
        if self.inertia is None:
            moments = vectors.split(self.bodies.principal_inertias)
            momentum = vectors.multiply(moments, own)
        else:
            momentum = _product(self.inertia, own)
        if self.centre is not None:
            arm = to_world(frame, self.centre)
            position = vectors.add(position, arm)
            velocity = vectors.add(velocity, vectors.cross(rate, arm))
        return Motion(position, orientation, velocity, to_world(frame, momentum))

    def leave(self, motion: Motion) -> BodyState:
        """State of the bodies' origins, from the motion of the centres of mass."""
        seen = self.seen(motion)
        return BodyState(
            positions=vectors.join(seen.motion.position),
            orientations=join_quaternion(motion.orientation),
            velocities=vectors.join(seen.motion.velocity),
            angular_velocities=vectors.join(seen.angular_velocities),
        )

    def seen(self, motion: Motion) -> Seen:
        """Constants and motion of the bodies' origins, as couplings read them."""
        seen = Seen(self.parts, motion, self.inverse_inertia)
        if self.centre is None:
            return seen
        arm = to_world(directors(motion.orientation), self.centre)
        swing = vectors.cross(seen.angular_velocities, arm)
        at_origin = replace(
            motion,
            position=vectors.subtract(motion.position, arm),
            velocity=vectors.subtract(motion.velocity, swing),
        )
        return replace(seen, motion=at_origin)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Motion after a time `dt` [s] of free flight and free rotation."""
        return replace(motion, orientation=self._turned(motion, dt)).moved(dt)

    def _turned(self, motion: Motion, dt: Array) -> Quaternion:
        if self.inverse_inertia is None:
            first, second, third = 1 / vectors.join(
                vectors.split(self.bodies.principal_inertias)
            )
            one, none = jnp.ones_like(first), jnp.zeros_like(first)
            others = (
                (second - first, (none, one, none)),
                (third - first, (none, none, one)),
            )
            return freely_turned(motion.orientation, motion.spin, first, others, dt)
        columns = _cholesky(self.inverse_inertia)
        parts = [(1.0, column) for column in columns]
        return freely_turned(motion.orientation, motion.spin, None, parts, dt)

    def kick(self, motion: Motion, loads: Loads) -> Motion:
        """Motion after loads have acted for one step, at unchanged positions.

        Args:
            motion: Motion of the centres of mass, as `enter` returns it.
            loads: Loads of couplings, added to those of effects: forces at the bodies'
                origins, world frame [N], and couples in the bodies' frames [N m].
        """
        forces, couples = loads.forces, loads.couples
        own = self._alone(motion)
        for effect in self.bodies.effects:
            more = effect.loads(self.bodies, own)
            forces = more.forces if forces is None else accumulate(forces, more.forces)
            if more.couples is not None:
                couples = (
                    more.couples
                    if couples is None
                    else vectors.add(couples, more.couples)
                )
        none = mapped_zero(motion.position)
        force = none if forces is None else forces
        frame = directors(motion.orientation)
        couple = none if couples is None else to_world(frame, couples)
        if self.centre is None:
            return replace(
                motion,
                velocity=vectors.apply(self.velocity_kick, motion.velocity, force),
                spin=vectors.apply(self.spin_kick, motion.spin, couple),
            )
        # As for attached nodes: the body alone is kicked and damped, and what it gains
        # acts on the whole.
        momentum = vectors.scale(self.bodies.masses, own.velocity)
        gained = Loads(
            vectors.apply(self.velocity_kick.change, momentum, force),
            vectors.apply(self.spin_kick.change, own.spin, couple),
        )
        return self.pushed(motion, gained)

    def rates_of_change(self, motion: Motion, push: Loads) -> Motion:
        """Accelerations of the bodies' origins and angular accelerations.

        Args:
            motion: Motion of the centres of mass, as `enter` returns it.
            push: Loads of couplings and of the carried nodes: forces [N], and couples
                about the bodies' origins [N m], both in the world frame.

        Returns:
            A motion whose velocities are accelerations [m/s^2], and whose spins are
            angular accelerations [rad/s^2], in the world frame.
        """
        own, frame = self._alone(motion), directors(motion.orientation)
        none = mapped_zero(motion.position)
        force, couple = accumulate(none, push.forces), accumulate(none, push.couples)
        for effect in self.bodies.effects:
            more = effect.loads(self.bodies, own)
            force = accumulate(force, more.forces)
            if more.couples is not None:
                couple = vectors.add(couple, to_world(frame, more.couples))
        slowing, braking = _damping(self.bodies)
        if slowing is not None and braking is not None:
            drag = vectors.scale(-slowing * self.bodies.masses, own.velocity)
            force = vectors.add(force, drag)
            couple = vectors.subtract(couple, vectors.scale(braking, own.spin))
        turn = self._about_centre(frame, force, couple)
        spin = self.seen(motion).angular_velocities
        turn = vectors.subtract(turn, vectors.cross(spin, motion.spin))
        turning = replace(motion, spin=turn)
        faster = Seen(self.parts, turning, self.inverse_inertia).angular_velocities
        moved = vectors.scale(1 / self.mass, force)
        if self.centre is not None:
            arm = to_world(frame, self.centre)
            swing = vectors.add(
                vectors.cross(faster, arm),
                vectors.cross(spin, vectors.cross(spin, arm)),
            )
            moved = vectors.subtract(moved, swing)
        return replace(own, velocity=moved, spin=faster)

    def _alone(self, motion: Motion) -> Motion:
        """Motion of the bodies' origins, with the spin of the bodies alone."""
        seen = self.seen(motion)
        if self.centre is None:
            return seen.motion
        frame = directors(motion.orientation)
        own = to_material(frame, seen.angular_velocities)
        moments = vectors.split(self.bodies.principal_inertias)
        spin = to_world(frame, vectors.multiply(moments, own))
        return replace(seen.motion, spin=spin)

    def pushed(self, motion: Motion, impulses: Loads) -> Motion:
        """Motion after impulses have changed velocities and angular momenta.

        The impulses are forces times time at the bodies' origins [N s] and couples
        times time [N m s], both in the world frame.
        """
        none = mapped_zero(motion.position)
        push = none if impulses.forces is None else impulses.forces
        turn = none if impulses.couples is None else impulses.couples
        turn = self._about_centre(directors(motion.orientation), push, turn)
        gain = vectors.scale(1 / self.mass, push)
        return replace(
            motion,
            velocity=vectors.add(motion.velocity, gain),
            spin=vectors.add(motion.spin, turn),
        )

    def _about_centre(
        self, frame: tuple[Vec3, Vec3, Vec3], force: Vec3, couple: Vec3
    ) -> Vec3:
        """Couple about the centre of mass, from a force and a couple at the origin."""
        if self.centre is None:
            return couple
        arm = to_world(frame, self.centre)
        return vectors.subtract(couple, vectors.cross(arm, force))


def mapped_zero(vector: Vec3) -> Vec3:
    """Vector field of zeros, with the shape of the given field."""
    zero = jnp.zeros_like(vector[0])
    return zero, zero, zero


def _damping(bodies: Any) -> tuple[Array | None, Array | None]:
    total: tuple[Array, Array] | None = None
    for effect in bodies.effects:
        rates = effect.damping_rates(bodies)
        if rates is not None:
            total = (
                rates if total is None else (total[0] + rates[0], total[1] + rates[1])
            )
    return (None, None) if total is None else total


def _together(principal: Array, carried: Carried, mass: Array, centre: Vec3) -> Matrix:
    """Inertia of bodies and carried masses about their common centre of mass.

    It is `I + tr(S) 1 - S`, with the inertia `I` of a body and `S` the second moment of
    the carried masses minus `m c c^T`, for the total mass `m` and the common centre
    `c`, all in the frame of the body [kg m^2].
    """
    a, b, c = principal
    zero = jnp.zeros_like(a)
    own = ((a, zero, zero), (zero, b, zero), (zero, zero, c))
    second = matrices.subtract(
        carried.second, matrices.scale(mass, matrices.outer(centre, centre))
    )
    trace = second[0][0] + second[1][1] + second[2][2]
    return matrices.add(own, matrices.subtract(matrices.scaled_identity(trace), second))


def _product(matrix: Matrix, vector: Vec3) -> Vec3:
    return (
        vectors.dot(matrix[0], vector),
        vectors.dot(matrix[1], vector),
        vectors.dot(matrix[2], vector),
    )


def _inverse(matrix: Matrix) -> Matrix:
    """Inverse of symmetric matrices, by cofactors."""
    a, b, c = matrix
    rows = vectors.cross(b, c), vectors.cross(c, a), vectors.cross(a, b)
    determinant = vectors.dot(a, rows[0])
    return matrices.transpose(matrices.scale(1 / determinant, rows))


def _cholesky(matrix: Matrix) -> Matrix:
    """Columns of the Cholesky factor: the sum of their outer products is the matrix."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = matrix
    zero = jnp.zeros_like(xx)
    a = jnp.sqrt(xx)
    b, c = xy / a, xz / a
    d = jnp.sqrt(yy - b * b)
    e = (yz - b * c) / d
    f = jnp.sqrt(zz - c * c - e * e)
    return (a, b, c), (zero, d, e), (zero, zero, f)
