r"""Consistent mode: a symplectic, second-order, momentum-conserving step.

The state's angular momentum $P$ is a world vector. Between kicks every element rotates
as a free symmetric top, exactly: with transverse and polar inertia $J_1, J_3$,

$$R(t+s) = \exp\!\left(\frac{s P}{J_1}\right) R(t)\,
   \exp\!\left(s \left(\frac1{J_3} - \frac1{J_1}\right) (d_3\cdot P)\, e_3\right).$$

Kicks change $v$ and $P$ at fixed configuration, exactly, too. Without damping
$v \mathrel{+}= s f/m$ and $P \mathrel{+}= s R c$; with decay rate $g$, it is the
solution of $\dot v = f/m - g v$ after a time $s$, and the same for $P$. Drift, kick,
drift is position Verlet: symmetric in time, hence of second order. Drag, with different
rates along the rod and across it, is solved together with the loads (`drag_kick`).

Elements whose second moments about d1 and d2 differ rotate freely as follows. With the
angular momentum $P$ constant in the world frame and $P_i = d_i\cdot P$,

$$H = \frac{|P|^2}{2 J_3} + \frac{c_1 P_1^2}{2} + \frac{c_2 P_2^2}{2},
  \qquad c_i = \frac1{J_i} - \frac1{J_3}.$$

The first term rotates everything about $P$, exactly, and commutes with the others. Each
of the others rotates the element about its own $d_i$ at the rate $c_i P_i$. That leaves
$P_i$ constant, so it is exact, too. Half of the second term, the third, and half of the
second give a splitting that is symmetric in time, symplectic and of second order, with
$|P|$ untouched. For a thin strip one of the two is small, and the splitting is nearly
exact.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    directors,
    freely_turned,
    multiply_quaternions,
    normalise,
    rotation_exp,
    sine_ratio_and_cosine,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import (
    LoadedRod,
    MassCoupling,
    Method,
    constrain,
    constrain_rates,
    damping_rates,
    dissipate,
    external_loads,
)
from jaxrod.methods.drag_kick import drag_kick, without_drag
from jaxrod.methods.verlet import Kick, Verlet
from jaxrod.rods.elasticity import ElasticLaw, elastic_law, internal_loads
from jaxrod.rods.motion import Loads, Motion, accumulate, motion_of, state_of
from jaxrod.rods.rod import RodState
from jaxrod.structure import pytree


def asymmetric_drift(
    q: Quaternion,
    momentum: Vec3,
    inverse_polar: Array,
    contrasts: tuple[Array, Array],
    dt: Array,
) -> Quaternion:
    """Orientations after free rotation for a time; inertias about d1 and d2 may differ.

    Args:
        q: Orientations.
        momentum: Angular momentum, world frame [kg m^2/s].
        inverse_polar: Inverse of the inertia about d3 [1/(kg m^2)].
        contrasts: Inverse of the inertia about d1, and about d2, minus `inverse_polar`
            [1/(kg m^2)].
        dt: Time [s].
    """
    zero, one = (jnp.full((), x, q[0].dtype) for x in (0, 1))
    parts = ((contrasts[0], (one, zero, zero)), (contrasts[1], (zero, one, zero)))
    return freely_turned(q, momentum, inverse_polar, parts, dt)


@pytree
class ConsistentStepper(Verlet):
    """Constants of the consistent step for one scene and one step size."""

    scene: LoadedRod
    """Scene that is stepped."""
    dt: Array
    """Step size [s]."""
    law: ElasticLaw
    """Constants of the elastic law."""
    velocity_kick: Kick
    """Kick of the velocities by forces."""
    spin_kick: Kick
    """Kick of the angular momenta by couples."""
    inverse_inertia: Array
    """Inverse of transverse inertia; polar if sections are not round [1/(kg m^2)]."""
    mass_coupling: MassCoupling | None
    """Coupling of the nodes by a mass matrix that is not lumped."""
    inertia_contrast: Array | tuple[Array, Array]
    """Inverse of polar minus inverse of transverse inertia [1/(kg m^2)]. For sections
    that are not round, inverses about d1 and d2 minus inverse of polar inertia."""

    @staticmethod
    def create(scene: LoadedRod, dt: Array) -> ConsistentStepper:
        """Computes the constants for a scene and a step size `dt` [s]."""
        contrast: Array | tuple[Array, Array]
        if scene.rod.is_round:
            transverse, polar = scene.rod.inertias
            inverse, contrast = 1 / transverse, 1 / polar - 1 / transverse
        else:
            one, two, three = scene.rod.principal_inertias
            inverse, contrast = 1 / three, (1 / one - 1 / three, 1 / two - 1 / three)
        rates = damping_rates(scene) or (None, None)
        return ConsistentStepper(
            scene=scene,
            dt=dt,
            law=elastic_law(scene.rod),
            velocity_kick=Kick.create(1 / scene.rod.node_masses, rates[0], dt),
            spin_kick=Kick.create(None, rates[1], dt),
            mass_coupling=MassCoupling.of(scene.rod),
            inverse_inertia=inverse,
            inertia_contrast=contrast,
        )

    def enter(self, state: RodState) -> Motion:
        """Unpacks a state and makes it satisfy the scene's constraints."""
        return constrain_rates(self.scene, constrain(self.scene, motion_of(state)))

    def leave(self, motion: Motion) -> RodState:
        """Packs a motion into a state."""
        return state_of(motion)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Moves nodes and rotates elements freely for a time `dt` [s]."""
        q, momentum = motion.orientation, motion.spin
        if isinstance(self.inertia_contrast, tuple):
            orientation = asymmetric_drift(
                q, momentum, self.inverse_inertia, self.inertia_contrast, dt
            )
            turned = replace(motion, orientation=orientation)
            return constrain(self.scene, turned.moved(dt))
        axial = vectors.dot(directors(q)[2], momentum)
        half_twist = 0.5 * dt * self.inertia_contrast * axial
        sine_ratio, cosine = sine_ratio_and_cosine(half_twist * half_twist)
        sine = half_twist * sine_ratio
        w, x, y, z = multiply_quaternions(
            rotation_exp(vectors.scale(dt * self.inverse_inertia, momentum)), q
        )
        twisted = (
            w * cosine - z * sine,
            x * cosine + y * sine,
            y * cosine - x * sine,
            z * cosine + w * sine,
        )
        turned = replace(motion, orientation=normalise(twisted))
        return constrain(self.scene, turned.moved(dt))

    def kick(self, motion: Motion, others: Loads | None = None) -> Motion:
        """Changes velocities and angular momenta by all loads over one step.

        Args:
            motion: The motion in the middle of the step.
            others: Loads from outside the scene, if any.
        """
        internal = internal_loads(self.law, motion)
        assert internal.forces is not None and internal.couples is not None
        forces, couples = internal.forces, internal.couples
        if others is not None:
            forces = accumulate(forces, others.forces)
            couples = accumulate(couples, others.couples)
        loads = external_loads(without_drag(self.scene), motion, forces, couples)
        assert loads.forces is not None and loads.couples is not None
        couples = to_world(directors(motion.orientation), loads.couples)
        forces = loads.forces
        if self.mass_coupling is not None:
            forces = self.mass_coupling.forces(self.scene, motion, forces)
        rates = drag_kick(self.scene, motion, forces, couples, self.dt)
        if rates is None:
            rates = (
                vectors.apply(self.velocity_kick, motion.velocity, forces),
                vectors.apply(self.spin_kick, motion.spin, couples),
            )
        kicked = replace(motion, velocity=rates[0], spin=rates[1])
        slowed = dissipate(self.scene, kicked, self.dt)
        return constrain_rates(self.scene, slowed)


@pytree
class Consistent(Method):
    """The consistent law in three dimensions, stepped by position Verlet."""

    steps_in_systems = True

    @property
    def couples_masses(self) -> bool:
        """True: forces are passed on along elements before the kick."""
        return True

    @property
    def solves_drag(self) -> bool:
        """True: drag is solved together with the loads of every kick."""
        return True

    def stepper(
        self, scene: LoadedRod, state: RodState, dt: Array
    ) -> ConsistentStepper:
        """Stepper with the constants for a scene and a step size `dt` [s]."""
        return ConsistentStepper.create(scene, dt)


def consistent() -> Consistent:
    """The default method: loads are gradients of an energy, steps of second order.

    Returns:
        The method, for `make_scene(..., method=...)`.

    Example:
        >>> jaxrod.make_scene(rod, method=jaxrod.consistent())
        Scene(Rod(...), Consistent)
        >>> jaxrod.make_scene(rod).method
        Consistent()
    """
    return Consistent()
