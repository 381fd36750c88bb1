"""The arm of the benchmark, with muscles, for problems of control."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxrod import clamp, control_spline, exponential_damping, make_scene
from jaxrod.control.trajectories.reach import ActuatedArm
from jaxrod.envs.arm.soft_arm import COUPLE_DENSITY, LENGTH, VISCOSITY, clean_rod


def actuated_arm(
    n_elements: int = 20,
    *,
    n_controls: int = 6,
    couple_density: float = COUPLE_DENSITY,
    viscosity: float = VISCOSITY,
    dtype: Any = None,
) -> ActuatedArm:
    """The benchmark's soft arm under the consistent law, straight and at rest.

    It is 1 m long, 5 cm in radius, with 1000 kg/m^3, 10 MPa, and incompressible. It is
    clamped at the origin, points along +y, and is in a viscous medium.

    Args:
        n_elements: Number of elements, at least 2.
        n_controls: Number of control points along the arm, per direction.
        couple_density: Couple per rest length for a control value of one [N m/m].
        viscosity: Force per length and speed [kg/(m s)], and couple per length and
            spin [kg m/s].
        dtype: Floating-point type; by default JAX's default.

    Raises:
        ValueError: If an argument is out of range.
    """
    rod, state = clean_rod(n_elements, (0.0, 0.0, 0.0), "y", dtype)
    damping = exponential_damping(
        viscosity / float(rod.linear_density[0]),
        viscosity / float(rod.rotary_inertia[0, 0]),
    )
    kind = rod.radii.dtype
    return ActuatedArm(
        scene=make_scene(rod, clamp(state), damping),
        state=state,
        spline=control_spline(n_controls, LENGTH, dtype=kind),
        couple_density=jnp.asarray(couple_density, kind),
    )
