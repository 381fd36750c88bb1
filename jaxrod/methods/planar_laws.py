r"""Steps of both elastic laws in a plane; see also `planar_verlet`.

With the consistent law (`consistent`) elements rotate at the rate P/J about the normal
between kicks.

With PyElastica's law (`pyelastica`), $e = \ell/\hat\ell$ the stretch of an element,
$\varepsilon$ that of a joint and $\omega$ the angular velocity about the normal:

- forces: $\Delta^h ((n_d\, d + n_t\, t)/e)$, with $n$ the stresses;
- couples about the normal: $\Delta^h(\tau/\varepsilon^3)
  + (\Delta x_d\, n_t - \Delta x_t\, n_d)/e + J \omega\, \dot e/e^2$;
- $\dot\omega = e\, c/J$.

The gyroscopic couples and those of bending with twist are zero in a plane.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod, MassCoupling, damping_rates, dissipates
from jaxrod.methods.drag_kick import drag_kick, without_drag
from jaxrod.methods.planar_verlet import (
    PLANES,
    PlanarMotion,
    PlanarRod,
    PlanarVerlet,
    PlaneName,
    Vec2,
    inertia_about_normal,
    spread,
)
from jaxrod.methods.verlet import Kick
from jaxrod.rods.motion import Loads
from jaxrod.rods.rod import RodState
from jaxrod.structure import pytree


@pytree
class PlanarPyElasticaStepper(PlanarVerlet):
    """Constants of PyElastica's step for one scene, one step size and one plane."""

    decay: tuple[Array, Array] | None
    """Fractions of velocities and spins left by damping after one step [1]; `None`
    without damping."""
    inverse_masses: Array
    """Inverse masses of the nodes [1/kg]."""
    inertia: Array
    """Rotary inertia of the elements about the normal [kg m^2]."""
    inverse_joint_lengths: Array
    """Inverse rest lengths of the joints [1/m]."""

    @staticmethod
    def create(
        scene: LoadedRod, plane: PlaneName, state: RodState, dt: Array, *, seen: bool
    ) -> PlanarPyElasticaStepper:
        """Computes the constants for a scene, plane, first state and step `dt` [s].

        `seen`: whether effects or couplings look at the motion in space.
        """
        rod = scene.rod
        constants = PlanarRod.create(rod, state, plane)
        transverse = inertia_about_normal(rod, constants)
        rates = damping_rates(scene)
        return PlanarPyElasticaStepper(
            scene=scene,
            plane=plane,
            seen=seen,
            dt=dt,
            start=state,
            constants=constants,
            inverse_inertia=1 / transverse,
            decay=rates and (jnp.exp(-rates[0] * dt), jnp.exp(-rates[1] * dt)),
            inverse_masses=1 / rod.node_masses,
            inertia=transverse,
            inverse_joint_lengths=1 / rod.joint_lengths,
        )

    def angle_turned(self, spin: Array, dt: Array) -> Array:
        """Angle of rotation at the angular velocity `spin` in a time `dt` [rad]."""
        return dt * spin

    def spin_from_momentum(self, momentum: Array) -> Array:
        """Angular velocity: angular momentum over inertia [rad/s]."""
        return self.inverse_inertia * momentum

    def momentum_from_spin(self, spin: Array) -> Array:
        """Angular momentum: angular velocity times inertia [kg m^2/s]."""
        return self.inertia * spin

    def spin_in_space(self, spin: Array) -> tuple[Vec3, bool]:
        """Angular velocity in the material frame [rad/s]; True: it is a velocity."""
        n1, n2 = self.constants.normal
        return (n1 * spin, n2 * spin, jnp.zeros_like(spin)), True

    def spin_in_plane(self, spin: Vec3) -> Array:
        """Component of the angular velocity along the normal [rad/s]."""
        n1, n2 = self.constants.normal
        return n1 * spin[0] + n2 * spin[1]

    def kick(self, motion: PlanarMotion, others: Loads | None = None) -> PlanarMotion:
        """Changes velocities and angular velocities by all loads over one step.

        `others` are loads from outside the scene, if any.
        """
        rod, (c, s) = self.constants, motion.direction
        dx, dy = motion.edges
        lengths = motion.lengths
        stretch = lengths * rod.inverse_lengths
        inverse_stretch = 1 / stretch
        across, along = c * dy - s * dx, c * dx + s * dy
        shear, axial = rod.stresses(across, along)
        shear, axial = inverse_stretch * shear, inverse_stretch * axial
        forces = spread(axial * c - shear * s), spread(axial * s + shear * c)
        joint_stretch = 0.5 * (lengths[1:] + lengths[:-1]) * self.inverse_joint_lengths
        cubed = joint_stretch * joint_stretch * joint_stretch
        u, v = motion.velocity
        closing = dx * (u[1:] - u[:-1]) + dy * (v[1:] - v[:-1])
        stretch_rate = closing / lengths * rod.inverse_lengths
        couple = (
            spread(rod.moments(motion.turn) / cubed)
            + (along * shear - across * axial)
            + stretch_rate
            * (inverse_stretch * inverse_stretch)
            * (self.inertia * motion.spin)
        )
        forces, couple = self.add_loads(motion, forces, couple, others)
        gain = self.dt * self.inverse_masses
        kicked = replace(
            motion,
            velocity=(u + gain * forces[0], v + gain * forces[1]),
            spin=motion.spin + self.dt * stretch * self.inverse_inertia * couple,
        )
        held = self.constrain_rates(kicked)
        if self.decay is not None:
            translation, rotation = self.decay
            u, v = held.velocity
            held = replace(
                held,
                velocity=(translation * u, translation * v),
                spin=rotation * held.spin,
            )
        if not dissipates(self.scene):
            return held
        return self.constrain_rates(self.dissipate(held))


@pytree
class PlanarConsistentStepper(PlanarVerlet):
    """Constants of the consistent step for one scene, one step size and one plane."""

    velocity_kick: Kick
    spin_kick: Kick
    mass_coupling: MassCoupling | None
    """Coupling of the nodes by a mass matrix that is not lumped."""

    @staticmethod
    def create(
        scene: LoadedRod, plane: PlaneName, state: RodState, dt: Array, *, seen: bool
    ) -> PlanarConsistentStepper:
        """Computes the constants for a scene, plane, first state and step `dt` [s].

        `seen`: whether effects or couplings look at the motion in space.
        """
        rod = scene.rod
        constants = PlanarRod.create(rod, state, plane)
        transverse = inertia_about_normal(rod, constants)
        rates = damping_rates(scene) or (None, None)
        return PlanarConsistentStepper(
            scene=scene,
            plane=plane,
            seen=seen,
            dt=dt,
            start=state,
            constants=constants,
            inverse_inertia=1 / transverse,
            velocity_kick=Kick.create(1 / rod.node_masses, rates[0], dt),
            spin_kick=Kick.create(None, rates[1], dt),
            mass_coupling=MassCoupling.of(rod),
        )

    def angle_turned(self, spin: Array, dt: Array) -> Array:
        """Angle of rotation at the rate P/J in a time `dt`, with P = `spin` [rad]."""
        return dt * self.inverse_inertia * spin

    def spin_from_momentum(self, momentum: Array) -> Array:
        """The angular momentum itself, which is the spin of this law [kg m^2/s]."""
        return momentum

    def momentum_from_spin(self, spin: Array) -> Array:
        """The spin itself, which is an angular momentum [kg m^2/s]."""
        return spin

    def spin_in_space(self, spin: Array) -> tuple[Vec3, bool]:
        """Angular momentum in the world frame [kg m^2/s]; False: it is no velocity."""
        zero = jnp.zeros_like(spin)
        components = [zero, zero, zero]
        components[PLANES[self.plane][2]] = spin
        return (components[0], components[1], components[2]), False

    def spin_in_plane(self, spin: Vec3) -> Array:
        """Component of the angular momentum along the normal [kg m^2/s]."""
        return spin[PLANES[self.plane][2]]

    def kick(self, motion: PlanarMotion, others: Loads | None = None) -> PlanarMotion:
        """Changes velocities and angular momenta by all loads over one step.

        `others` are loads from outside the scene, if any.
        """
        rod, (c, s) = self.constants, motion.direction
        dx, dy = motion.edges
        across, along = c * dy - s * dx, c * dx + s * dy
        shear, axial = rod.stresses(across, along)
        forces = spread(axial * c - shear * s), spread(axial * s + shear * c)
        couple = spread(rod.moments(motion.turn)) + (along * shear - across * axial)
        dry = replace(self, scene=without_drag(self.scene))
        forces, couple = dry.add_loads(motion, forces, couple, others)
        if self.mass_coupling is not None:
            forces = self._with_coupling(self.mass_coupling, motion, forces)
        if dry.scene is not self.scene:
            dragged = self._dragged(motion, forces, couple)
            return self.constrain_rates(self.dissipate(dragged))
        u, v = motion.velocity
        kicked = replace(
            motion,
            velocity=(
                self.velocity_kick(u, forces[0]),
                self.velocity_kick(v, forces[1]),
            ),
            spin=self.spin_kick(motion.spin, couple),
        )
        return self.constrain_rates(self.dissipate(kicked))

    def _with_coupling(
        self, coupling: MassCoupling, motion: PlanarMotion, forces: Vec2
    ) -> Vec2:
        """Forces with those that couple the nodes by their masses [N]."""
        a, b, _ = PLANES[self.plane]
        none = jnp.zeros_like(forces[0])
        in_space = self._in_space(forces, jnp.stack([none] * 3))
        added = coupling.forces(self.scene, self.view(motion), in_space)
        return added[a], added[b]

    def _dragged(
        self, motion: PlanarMotion, forces: Vec2, couple: Array
    ) -> PlanarMotion:
        """Motion after a kick by forces [N], couples [N m] and drag over one step."""
        a, b, out = PLANES[self.plane]
        push = [jnp.zeros_like(forces[0])] * 3
        push[a], push[b] = forces
        couples, _ = self.spin_in_space(couple)
        rates = drag_kick(
            self.scene,
            self.view(motion),
            (push[0], push[1], push[2]),
            couples,
            self.dt,
        )
        assert rates is not None
        (velocity, spin) = rates
        return replace(motion, velocity=(velocity[a], velocity[b]), spin=spin[out])
