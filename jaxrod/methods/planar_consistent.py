"""The consistent law in a plane; see also `planar_verlet` and `consistent`.

Elements rotate at the rate P/J about the normal between kicks.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod, damping_rates
from jaxrod.methods.drag_kick import drag_kick, without_drag
from jaxrod.methods.kick import Kick
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
from jaxrod.rods.rod import RodState
from jaxrod.structure import pytree


@pytree
class PlanarConsistentStepper(PlanarVerlet):
    """Constants of the consistent step for one scene, one step size and one plane."""

    velocity_kick: Kick
    spin_kick: Kick

    @staticmethod
    def create(
        scene: LoadedRod, plane: PlaneName, state: RodState, dt: Array
    ) -> PlanarConsistentStepper:
        """Computes the constants once, outside the loop."""
        rod = scene.rod
        constants = PlanarRod.create(rod, state, plane)
        transverse = inertia_about_normal(rod, constants)
        rates = damping_rates(scene) or (None, None)
        return PlanarConsistentStepper(
            scene=scene,
            plane=plane,
            dt=dt,
            start=state,
            constants=constants,
            inverse_inertia=1 / transverse,
            velocity_kick=Kick.create(1 / rod.node_masses, rates[0], dt),
            spin_kick=Kick.create(None, rates[1], dt),
        )

    def angle_turned(self, spin: Array, dt: Array) -> Array:
        """Angle of rotation at the rate P/J [rad]."""
        return dt * self.inverse_inertia * spin

    def spin_from_momentum(self, momentum: Array) -> Array:
        """The angular momentum itself [kg m^2/s]."""
        return momentum

    def momentum_from_spin(self, spin: Array) -> Array:
        """The spin itself, an angular momentum [kg m^2/s]."""
        return spin

    def spin_in_space(self, spin: Array) -> tuple[Vec3, bool]:
        """Angular momentum, world frame."""
        zero = jnp.zeros_like(spin)
        components = [zero, zero, zero]
        components[PLANES[self.plane][2]] = spin
        return (components[0], components[1], components[2]), False

    def spin_in_plane(self, spin: Vec3) -> Array:
        """Component of the spin along the normal."""
        return spin[PLANES[self.plane][2]]

    def kick(self, motion: PlanarMotion) -> PlanarMotion:
        """Changes velocities and angular momenta by all loads over one step."""
        rod, (c, s) = self.constants, motion.direction
        dx, dy = motion.edges
        across, along = c * dy - s * dx, c * dx + s * dy
        shear, axial = rod.stresses(across, along)
        forces = spread(axial * c - shear * s), spread(axial * s + shear * c)
        couple = spread(rod.moments(motion.turn)) + (along * shear - across * axial)
        others = replace(self, scene=without_drag(self.scene))
        forces, couple = others.add_loads(motion, forces, couple)
        if others.scene is not self.scene:
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

    def _dragged(
        self, motion: PlanarMotion, forces: Vec2, couple: Array
    ) -> PlanarMotion:
        """Motion after a kick with drag."""
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
