r"""Viscosity of bending in a plane: joints resist the rate at which they bend.

The moment $-\tau B\,\dot\phi/\hat D$ of every joint, of Kelvin's and Voigt's material
with the relaxation time $\tau$, changes angular momenta $P$ about the normal only. With
$A = \Delta^T (\tau B/\hat D)\,\Delta\,J^{-1}$, constant in a plane, a backward Euler
step is one product with a matrix, $P \leftarrow (1 + hA)^{-1} P$: no limit of the step,
and a fraction of the work of `jaxrod.internal_damping`, which damps stretch, shear and
twist besides, in space. A mode of angular frequency $\omega$ decays at
$\tau\omega^2/2$.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import Effect, Rod, Scene
from jaxrod.rods.motion import Motion
from jaxrod.structure import pytree


@pytree
class BendingViscosity(Effect):
    """Viscous bending about the vertical; see `bending_viscosity`."""

    kept: Float[Array, "n n"]
    """Angular momenta after a step, by those before it [1]."""

    def dissipate(self, scene: Scene, motion: Motion, dt: Array) -> Motion:
        """The motion after bending rates have decayed for a step."""
        x, y, z = motion.spin
        slowed = jnp.sum(self.kept * z[None, :], axis=1)
        return dataclasses.replace(motion, spin=(x, y, slowed))


def bending_viscosity(rod: Rod, relaxation_time: Array, dt: Array) -> BendingViscosity:
    """Viscous bending about the vertical of a rod in the plane "xy", round and level.

    Args:
        rod: The rod, in a scene of the consistent law.
        relaxation_time: Viscous over elastic stiffness [s].
        dt: Step of the simulation, the one that is going to be used [s].
    """
    n = rod.n_elements
    eye = jnp.eye(n, dtype=rod.rest_lengths.dtype)
    across = eye[1:] - eye[:-1]
    drag = relaxation_time * rod.joint_stiffness[0] / rod.joint_lengths
    rates = jnp.sum(
        across[:, :, None] * drag[:, None, None] * across[:, None, :], axis=0
    )
    return BendingViscosity(jnp.linalg.inv(eye + dt * rates / rod.inertias[0][None, :]))
