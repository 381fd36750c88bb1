"""Warnings about unlikely numbers, detected by dimensionless ratios."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array

from jaxrod.rods.rod import Rod
from jaxrod.validation import is_traced, warn

MOST_STRETCH = 9.0
"""Weight divided by axial stiffness above which a rod is unlikely: at a strain of 9 it
is ten times as long [1]."""


class UnlikelyWarning(UserWarning):
    """Numbers that are unlikely together, e.g. because some are in other units."""


def warn_of_thickness(rod: Rod) -> None:
    """Warns if the largest radius of a rod is larger than its length."""
    radii, lengths = rod.radii, rod.rest_lengths
    # Inside jax.jit, values computed from known numbers are traced, too.
    if is_traced(radii, lengths) or lengths.ndim != 1:
        return
    radius = float(np.max(np.asarray(radii)))
    length = float(np.sum(np.asarray(lengths)))
    if radius > length:
        _warn(
            f"the radius of the rod, {radius:.3g} m, is {radius / length:.3g} times "
            f"its length, {length:.3g} m: are both in the same unit?"
        )


def warn_of_weight(rod: Rod, acceleration: Array) -> None:
    """Warns if the weight of a rod would stretch it tenfold.

    Args:
        rod: The rod.
        acceleration: Gravitational acceleration `(3,)` [m/s^2].
    """
    lines, lengths = rod.linear_density, rod.rest_lengths
    stretching = rod.shear_stretch_stiffness
    if is_traced(lines, lengths, stretching, acceleration) or rod.batch_shape:
        return
    g = np.asarray(acceleration, np.float64)
    mass = float(np.sum(np.asarray(lines) * np.asarray(lengths)))
    weight = mass * float(np.sqrt(np.sum(g * g)))
    stiffness = float(np.min(np.asarray(stretching)[2]))
    if weight > MOST_STRETCH * stiffness:
        _warn(
            f"the weight of the rod, {weight:.3g} N, is {weight / stiffness:.3g} times "
            f"its stiffness against stretching, {stiffness:.3g} N, and would stretch "
            "it more than tenfold: are youngs_modulus in Pa, density in kg/m^3 and "
            "acceleration in m/s^2, or all in units that go together?"
        )


def warn_of_softness(rod: Rod, acceleration: Array, stiffness: Array) -> None:
    """Warns if a rod at rest on a contact would sink in by more than its radius.

    Args:
        rod: The rod.
        acceleration: Gravitational acceleration `(3,)` [m/s^2].
        stiffness: Force of the contact per length of rod and penetration [N/m^2].
    """
    lines, radii = rod.linear_density, rod.radii
    if is_traced(lines, radii, acceleration, stiffness) or rod.batch_shape:
        return
    g = np.asarray(acceleration, np.float64)
    weights = np.asarray(lines) * float(np.sqrt(np.sum(g * g)))
    depths = weights / float(np.min(np.asarray(stiffness))) / np.asarray(radii)
    worst = int(np.argmax(depths))
    if depths[worst] > 1:
        _warn(
            f"a contact of stiffness {float(np.min(np.asarray(stiffness))):.3g} N/m^2 "
            f"cannot carry the rod: under its weight of {weights[worst]:.3g} N/m it "
            f"sinks in by {depths[worst]:.3g} radii. With "
            f"{100 * weights[worst] / float(np.asarray(radii)[worst]):.2g} N/m^2 it "
            "sinks in by a hundredth of its radius; if no stiffness is given, "
            "make_scene chooses one."
        )


def _warn(words: str) -> None:
    warn(
        f'{words} warnings.simplefilter("ignore", jaxrod.UnlikelyWarning) silences '
        "this.",
        UnlikelyWarning,
    )
