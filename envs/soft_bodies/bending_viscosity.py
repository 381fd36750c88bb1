r"""Viscosity of bending in a plane: joints resist the rate at which they bend.

The moment $-\tau B\,\dot\phi/\hat D$ of every joint, of a Kelvin-Voigt material with
the relaxation time $\tau$, changes angular momenta $P$ about the normal only. In a
plane $A = \Delta^T (\tau B/\hat D)\,\Delta\,J^{-1}$ is constant, so a backward Euler
step is one matrix product, $P \leftarrow (1 + hA)^{-1} P$. It does not limit the time
step. It costs a fraction of `jaxrod.internal_damping`, which also damps stretch, shear
and twist, in space. A mode of angular frequency $\omega$ decays at $\tau\omega^2/2$.
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
    """Matrix from the angular momenta before a step to those after it [1]."""

    def dissipate(self, scene: Scene, motion: Motion, dt: Array) -> Motion:
        """Returns the motion after the bending rates have decayed for one step."""
        x, y, z = motion.spin
        slowed = jnp.sum(self.kept * z[None, :], axis=1)
        return dataclasses.replace(motion, spin=(x, y, slowed))


def bending_viscosity(rod: Rod, relaxation_time: Array, dt: Array) -> BendingViscosity:
    """Viscous bending about the vertical, for a round, level rod in the plane "xy".

    Args:
        rod: The rod, in a scene of the consistent law.
        relaxation_time: Ratio of viscous to elastic stiffness [s].
        dt: Time step of the simulation, the same that will be used [s].
    """
    n = rod.n_elements
    eye = jnp.eye(n, dtype=rod.rest_lengths.dtype)
    across = eye[1:] - eye[:-1]
    drag = relaxation_time * rod.joint_stiffness[0] / rod.joint_lengths
    rates = jnp.sum(
        across[:, :, None] * drag[:, None, None] * across[:, None, :], axis=0
    )
    return BendingViscosity(jnp.linalg.inv(eye + dt * rates / rod.inertias[0][None, :]))
