"""Rods of any section: masses and stiffnesses from a shape and a material."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.rods.rod import Rod
from jaxrod.rods.section_shapes import Section
from jaxrod.validation import Numbers, check_array, check_held, check_kind, is_traced


def shaped_rod(
    n: int,
    *,
    rest_lengths: Any,
    section: Section,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None,
    poisson_ratio: Numbers,
    shear_correction: Numbers | None,
    dtype: Any,
) -> Rod:
    """A rod that is straight at rest; arguments as in `jaxrod.straight_rod`.

    Raises:
        ValueError: If an argument is out of range, or the type cannot hold what follows
            from it.
        TypeError: If the section is something else.
    """
    check_kind("section", section, Section)

    def per_element(name: str, value: Numbers, unit: str) -> Any:
        return check_array(name, value, [(), (n,)], unit, positive=True, dtype=dtype)

    densities = per_element("density", density, "kg/m^3")
    young = per_element("youngs_modulus", youngs_modulus, "Pa")
    ratio = check_array("poisson_ratio", poisson_ratio, [(), (n,)], "")
    if not is_traced(ratio) and np.any((ratio <= -1) | (ratio > 0.5)):
        raise ValueError(f"poisson_ratio must be in (-1, 0.5], got {poisson_ratio}")
    if shear_modulus is None:
        shear = young / (2 * (1 + ratio))
    else:
        shear = per_element("shear_modulus", shear_modulus, "Pa")
    factors = section.shear_factors
    if shear_correction is not None:
        given = per_element("shear_correction", shear_correction, "")
        factors = (given, given)

    def leaf(name: str, value: Any, unit: str) -> Array:
        if np.shape(value) not in ((), (n,)):
            raise ValueError(
                f"section must have one number or one per element ({n}), got shape "
                f"{np.shape(value)}"
            )
        if not is_traced(value):
            check_held(name, np.asarray(value), unit, dtype, each=True)
        return jnp.broadcast_to(jnp.asarray(value, dtype), (n,))

    area, (first, second) = section.area, section.second_moments
    with np.errstate(all="ignore"):
        line = densities * area
        inertias = [densities * first, densities * second]
        if section.is_round:
            inertias = inertias[:1]
        inertias.append(densities * (first + second))
        across = [factor * shear * area for factor in factors]
        bends = [
            *(young * moment for moment in (first, second)),
            shear * section.torsion_constant,
        ]
        return Rod(
            rest_lengths=leaf("element length", rest_lengths, "m"),
            radii=leaf("radius of the section", section.radius, "m"),
            linear_density=leaf("density times area", line, "kg/m"),
            rotary_inertia=jnp.stack(
                [leaf("density times second moment", j, "kg m") for j in inertias]
            ),
            shear_stretch_stiffness=jnp.stack(
                [
                    *(leaf("shear stiffness", s, "N") for s in across),
                    leaf("youngs_modulus times area", young * area, "N"),
                ]
            ),
            bend_twist_stiffness=jnp.stack(
                [leaf("bending and twisting stiffness", b, "N m^2") for b in bends]
            ),
            rest_strains=jnp.zeros((3, n), dtype),
            rest_curvatures=jnp.zeros((3, n - 1), dtype),
        )
