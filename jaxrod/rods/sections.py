"""Rods of round section: masses and stiffnesses from radius and material."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.rods.rod import Rod
from jaxrod.validation import Numbers, check_array, check_held, is_traced


def round_rod(
    n: int,
    *,
    rest_lengths: Any,
    radius: Numbers,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None,
    poisson_ratio: Numbers,
    shear_correction: Numbers,
    dtype: Any,
) -> Rod:
    """A rod that is straight at rest; arguments as in `jaxrod.straight_rod`.

    Args:
        n: Number of elements.
        rest_lengths: Of the elements `(n,)`, checked [m].
        radius: One number, one per element, or those of base and tip [m].
        density: One number or one per element [kg/m^3].
        youngs_modulus: One number or one per element [Pa].
        shear_modulus: One number or one per element, or `None` for Poisson's ratio
            to give it [Pa].
        poisson_ratio: One number or one per element [1].
        shear_correction: One number or one per element [1].
        dtype: float32 or float64.

    Raises:
        ValueError: If an argument is out of range, or the type cannot hold it or what
            follows from it.
    """

    def per_element(name: str, value: Numbers, unit: str) -> Any:
        return check_array(name, value, [(), (n,)], unit, positive=True, dtype=dtype)

    radii = _radii(radius, n, dtype)
    densities = per_element("density", density, "kg/m^3")
    young = per_element("youngs_modulus", youngs_modulus, "Pa")
    correction = per_element("shear_correction", shear_correction, "")
    ratio = check_array("poisson_ratio", poisson_ratio, [(), (n,)], "")
    if not is_traced(ratio) and np.any((ratio <= -1) | (ratio > 0.5)):
        raise ValueError(f"poisson_ratio must be in (-1, 0.5], got {poisson_ratio}")
    if shear_modulus is None:
        shear = young / (2 * (1 + ratio))
    else:
        shear = per_element("shear_modulus", shear_modulus, "Pa")

    def check(formula: str, value: Any, unit: str) -> None:
        if not is_traced(value):
            check_held(formula, value, unit, dtype, each=True)

    def leaf(formula: str, value: Any, unit: str) -> Array:
        check(formula, value, unit)
        return jnp.broadcast_to(jnp.asarray(value, dtype), (n,))

    # Numbers that the type cannot hold are refused in words, not NumPy's warnings.
    with np.errstate(all="ignore"):
        area = np.pi * radii**2
        second_moment = area**2 / (4 * np.pi)
        line, rotary = densities * area, densities * second_moment
        across = correction * shear * area
        bending, twisting = young * second_moment, 2 * shear * second_moment
        # Not stored, but worked out in every step: squares of lengths, masses and
        # inertias of elements, stiffnesses of joints, squares of frequencies.
        squared = rest_lengths**2
        check("element length^2", squared, "m^2")
        check("density pi radius^2 element length", line * rest_lengths, "kg")
        check("density pi/4 radius^4 element length", rotary * rest_lengths, "kg m^2")
        for formula, stiffness in (
            ("youngs_modulus pi/4 radius^4", bending),
            ("shear_modulus pi/2 radius^4", twisting),
        ):
            check(f"{formula} / element length", stiffness / rest_lengths, "N m")
            check(f"{formula} element length", stiffness * rest_lengths, "N m^3")
        stretch = young / densities / squared
        check("youngs_modulus / density / element length^2", stretch, "1/s^2")
        check(
            "shear_modulus / density / radius^2", shear / densities / radii**2, "1/s^2"
        )
        shearing = leaf("shear_correction shear_modulus pi radius^2", across, "N")
        bending = leaf("youngs_modulus pi/4 radius^4", bending, "N m^2")
        return Rod(
            rest_lengths=leaf("element length", rest_lengths, "m"),
            radii=leaf("radius", radii, "m"),
            linear_density=leaf("density pi radius^2", line, "kg/m"),
            rotary_inertia=jnp.stack(
                [
                    leaf("density pi/4 radius^4", rotary, "kg m"),
                    leaf("density pi/2 radius^4", 2 * rotary, "kg m"),
                ]
            ),
            shear_stretch_stiffness=jnp.stack(
                [
                    shearing,
                    shearing,
                    leaf("youngs_modulus pi radius^2", young * area, "N"),
                ]
            ),
            bend_twist_stiffness=jnp.stack(
                [
                    bending,
                    bending,
                    leaf("shear_modulus pi/2 radius^4", twisting, "N m^2"),
                ]
            ),
            rest_strains=jnp.zeros((3, n), dtype),
            rest_curvatures=jnp.zeros((3, n - 1), dtype),
        )


def _radii(radius: Numbers, n: int, dtype: Any) -> Any:
    """One radius, or one for each element; for a pair those of the taper."""
    shapes = [(), (2,), (n,)]
    radii = check_array("radius", radius, shapes, "m", positive=True, dtype=dtype)
    if radii.shape != (2,):
        return radii
    if n == 2:
        raise ValueError(
            "radius must be one number for a rod of 2 elements: two could be those of "
            "the elements or, as for every other rod, of base and tip; got "
            f"{radius}. Take 3 elements"
        )
    base, tip = radii
    return base + (tip - base) * (np.arange(n) + 0.5) / n
