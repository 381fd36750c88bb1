"""The soft arm of the benchmark: dimensions, rods, and the arm as a control problem."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxrod import Rod, RodState, clamp, exponential_damping, make_scene, straight_rod
from jaxrod.actuation import control_spline
from jaxrod.control.trajectories.reach import ActuatedArm

CONTROL_PERIOD = 1.4e-3
"""Time between actions in every case [s]."""
LENGTH = 1.0
"""Length of the arm [m]."""
RADIUS = 0.05
"""Radius of the arm [m]."""
DENSITY = 1000.0
"""Density of the arm [kg/m^3]."""
YOUNGS_MODULUS = 1e7
"""Young's modulus of the arm [Pa]."""
VISCOSITY = 30.0
"""Viscous force per length and speed [kg/(m s)]; the same number is the couple per
length and angular velocity [kg m/s]."""
TORQUE_PER_ELEMENT = 75.0
"""Couple on an element for a control value of one [N m]."""
REFERENCE_ELEMENTS = 20
"""Number of elements of the published arm in Cases 1 and 2."""
COUPLE_DENSITY = TORQUE_PER_ELEMENT * REFERENCE_ELEMENTS / LENGTH
"""Couple per length for a control value of one: the sum over all elements, spread over
the length [N m/m]."""


def published_rod(
    n_elements: int, start: tuple[float, float, float], axis: str
) -> tuple[Rod, RodState]:
    """Makes the arm with the published moduli, G = E/1.5, shear correction 4/3.

    It is straight and at rest.

    Args:
        n_elements: Number of elements: 20 in Cases 1 and 2, 50 in Cases 3 and 4.
        start: Position of the clamped end [m].
        axis: Axis along the arm: "y" (Cases 1, 2; d1 is +z) or "z" (Cases 3, 4; d1 is
            +y).
    """
    return straight_rod(
        n_elements,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNGS_MODULUS,
        shear_modulus=YOUNGS_MODULUS / 1.5,
        shear_correction=4 / 3,
        start=start,
        **_frame(axis),
    )


def clean_rod(
    n_elements: int,
    start: tuple[float, float, float],
    axis: str,
    dtype: Any = None,
) -> tuple[Rod, RodState]:
    """Makes the arm of incompressible material: G = E/3, shear correction 27/28.

    Its dimensions, density and Young's modulus are those of `published_rod`, which also
    explains the arguments.
    """
    return straight_rod(
        n_elements,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNGS_MODULUS,
        start=start,
        dtype=dtype,
        **_frame(axis),
    )


def _frame(axis: str) -> dict[str, Any]:
    if axis == "y":
        return {"direction": (0.0, 1.0, 0.0), "normal": (0.0, 0.0, 1.0)}
    return {"direction": (0.0, 0.0, 1.0), "normal": (0.0, 1.0, 0.0)}


def actuated_arm(
    n_elements: int = 20,
    *,
    n_controls: int = 6,
    couple_density: float = COUPLE_DENSITY,
    viscosity: float = VISCOSITY,
    dtype: Any = None,
) -> ActuatedArm:
    """Makes the benchmark's soft arm in a scene, straight and at rest.

    It is 1 m long and 5 cm in radius, of an incompressible material with a density of
    1000 kg/m^3 and a Young's modulus of 10 MPa. It is clamped at the origin, points
    along +y, and is in a viscous medium.

    Args:
        n_elements: Number of elements, at least 2.
        n_controls: Number of control points along the arm, per direction.
        couple_density: Couple per rest length for a control value of one [N m/m].
        viscosity: Force per length and speed [kg/(m s)]; the same number is the couple
            per length and angular velocity [kg m/s].
        dtype: Floating-point type; by default JAX's default.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> arm = envs.actuated_arm(10, n_controls=4)
        >>> arm.control_shape, arm.scene.rod.n_elements
        ((2, 4), 10)
        >>> bent = arm.with_controls(jnp.ones(arm.control_shape))
        >>> len(bent.effects) - len(arm.scene.effects)  # the muscles
        1
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
