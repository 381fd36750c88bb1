"""Rods from a section and a material: masses and stiffnesses of their elements.

A section has an area, second moments, a torsion constant and shear factors. Dimensions
are one number or one per element. Shear factors are those of Kaneko and of Hutchinson
(J. Appl. Mech. 68, 2001) at Poisson's ratio 1/2: 27/28 for circles, less for tubes, and
5/6 for rectangles. An ellipse has that of the circle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.geometry.material_frames import module_for
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree, static
from jaxrod.validation import (
    Numbers,
    check_array,
    check_held,
    check_kind,
    is_traced,
    numeric,
)

CIRCLE = np.float64(27 / 28)
"""Shear correction factor of a circle at Poisson's ratio 1/2, as in PyElastica 1.0."""


_LARGEST = 1e40
"""Largest dimension [m]: sixth powers of larger numbers would overflow in float64."""


@pytree
class Section:
    """Properties of the cross-section of a rod; each is one number, or one per element.

    Example:
        >>> square = jaxrod.rectangle(0.02, 0.02)
        >>> round(float(square.area), 6), square.is_round
        (0.0004, False)
        >>> beam, start = jaxrod.straight_rod(
        ...     10, length=1.0, section=square, density=1000.0, youngs_modulus=1e6
        ... )
        >>> round(float(beam.element_masses.sum()), 3)  # [kg]
        0.4
    """

    area: Any
    """Area of the material [m^2]."""
    second_moments: tuple[Any, Any]
    """Second moments of area about d1 and d2 [m^4]."""
    torsion_constant: Any
    """Torsion constant: twisting stiffness divided by shear modulus [m^4]."""
    shear_factors: tuple[Any, Any]
    """Shear correction factors along d1 and d2 [1]."""
    radius: Any
    """Radius of a circle with the area inside the outline [m]. It becomes `Rod.radii`,
    which elasticity and inertia do not use."""
    is_round: bool = static(default=False)
    """Whether moments about d1 and d2 are the same for all dimensions."""


def _dimension(name: str, value: Numbers) -> Any:
    size = numeric(name, value, "m")
    if size.ndim > 1:
        raise ValueError(
            f"{name} must be one number or one per element, got shape {size.shape}"
        )
    if not is_traced(size) and not np.all((size > 0) & np.isfinite(size)):
        raise ValueError(f"{name} must be positive and finite, got {value} m")
    if not is_traced(size) and np.any(size > _LARGEST):
        raise ValueError(f"{name} must be at most {_LARGEST:g} m, got {value} m")
    return size


def circle(radius: Numbers) -> Section:
    """Section that is a solid circle.

    Args:
        radius: Radius [m].

    Raises:
        ValueError: If the radius is not positive.

    Example:
        >>> round(float(jaxrod.circle(0.02).area), 6)  # pi r^2 [m^2]
        0.001257
    """
    r = _dimension("radius", radius)
    second = np.pi * r**4 / 4
    area = np.pi * r**2
    shear = (CIRCLE, CIRCLE)
    return Section(area, (second, second), 2 * second, shear, r, is_round=True)


def tube(outer_radius: Numbers, inner_radius: Numbers) -> Section:
    """Section that is a circle with a concentric hole.

    Args:
        outer_radius: Outer radius [m].
        inner_radius: Inner radius, smaller [m].

    Raises:
        ValueError: If the radii are not positive, or the inner one is not smaller.

    Example:
        >>> solid, hollow = jaxrod.circle(0.02), jaxrod.tube(0.02, 0.01)
        >>> round(float(hollow.area / solid.area), 3)
        0.75
    """
    r = _dimension("outer_radius", outer_radius)
    hole = _dimension("inner_radius", inner_radius)
    if not is_traced(r, hole) and not np.all(hole < r):
        raise ValueError(
            f"inner_radius must be less than outer_radius, got {inner_radius} and "
            f"{outer_radius} m"
        )
    second = np.pi * (r**4 - hole**4) / 4
    m = (hole / r) ** 2
    shear = 13.5 * (1 + m) ** 2 / (14 + 62 * m + 14 * m**2)
    area = np.pi * (r - hole) * (r + hole)
    return Section(area, (second, second), 2 * second, (shear, shear), r, is_round=True)


def rectangle(width: Numbers, height: Numbers) -> Section:
    """Section that is a solid rectangle.

    The torsion constant is `a b^3 (1/3 - 0.21 b/a (1 - b^4 / (12 a^4)))` with the
    longer side a and the shorter b; its error is at most 0.5 % (Young and Budynas,
    Roark's Formulas).

    Args:
        width: Side along d1 [m].
        height: Side along d2 [m].

    Raises:
        ValueError: If a side is not positive.

    Example:
        >>> strip = jaxrod.rectangle(width=0.04, height=0.01)
        >>> about_d1, about_d2 = strip.second_moments
        >>> round(float(about_d2 / about_d1), 3)
        16.0
    """
    w, h = _dimension("width", width), _dimension("height", height)
    xp = module_for(w, h)
    a, b = xp.maximum(w, h), xp.minimum(w, h)
    share = b / a
    torsion = a * b**3 * (1 / 3 - 0.21 * share * (1 - share**4 / 12))
    area = w * h
    moments = (area * h**2 / 12, area * w**2 / 12)
    return Section(
        area,
        moments,
        torsion,
        (np.float64(5 / 6), np.float64(5 / 6)),
        xp.sqrt(area / np.pi),
    )


def ellipse(half_width: Numbers, half_height: Numbers) -> Section:
    """Section that is a solid ellipse.

    Args:
        half_width: Semi-axis along d1 [m].
        half_height: Semi-axis along d2 [m].

    Raises:
        ValueError: If a semi-axis is not positive.

    Example:
        >>> flat = jaxrod.ellipse(0.02, 0.01)
        >>> about_d1, about_d2 = flat.second_moments
        >>> round(float(about_d2 / about_d1), 3)
        4.0
    """
    a = _dimension("half_width", half_width)
    b = _dimension("half_height", half_height)
    area = np.pi * a * b
    moments = (area * b**2 / 4, area * a**2 / 4)
    torsion = np.pi * a**3 * b**3 / (a**2 + b**2)
    return Section(area, moments, torsion, (CIRCLE, CIRCLE), (a * b) ** 0.5)


@dataclass(frozen=True)
class _Words:
    """Formulas of the properties of a section as text, for error messages."""

    radius: str
    area: str
    moments: tuple[str, str]
    polar: str
    torsion: str


_ROUND = _Words(
    radius="radius",
    area="pi radius^2",
    moments=("pi/4 radius^4",) * 2,
    polar="pi/2 radius^4",
    torsion="pi/2 radius^4",
)
_SHAPED = _Words(
    radius="section.radius",
    area="section.area",
    moments=("section.second_moments[0]", "section.second_moments[1]"),
    polar="sum(section.second_moments)",
    torsion="section.torsion_constant",
)


def rod_of_section(
    n: int,
    *,
    rest_lengths: Any,
    middles: Any,
    radius: Numbers | None,
    section: Section | None,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None,
    poisson_ratio: Numbers,
    shear_correction: Numbers | None,
    dtype: Any,
) -> Rod:
    """A rod that is straight at rest; arguments as in `jaxrod.straight_rod`.

    Args:
        n: Number of elements.
        rest_lengths: Rest lengths of the elements `(n,)`, already validated [m].
        middles: Arc-length positions of the element midpoints, divided by the rod's
            length `(n,)` [1].
        radius: Radius of round sections [m]: one number, one per element, or the pair
            of base and tip radius.
        section: Section instead of a radius.
        density: Mass density, one number or one per element [kg/m^3].
        youngs_modulus: Young's modulus, one number or one per element [Pa].
        shear_modulus: Shear modulus, one number or one per element, or `None` to
            compute it from Poisson's ratio [Pa].
        poisson_ratio: Poisson's ratio, one number or one per element [1].
        shear_correction: Shear correction factor, one number or one per element, or
            `None` for that of the section [1].
        dtype: float32 or float64.

    Raises:
        ValueError: If an argument is out of range, or the dtype cannot represent it or
            numbers derived from it.
        TypeError: If the section has the wrong type.
    """

    def per_element(name: str, value: Numbers, unit: str) -> Any:
        return check_array(name, value, [(), (n,)], unit, positive=True, dtype=dtype)

    words = _SHAPED if radius is None else _ROUND
    # Numbers that the dtype cannot hold raise our error, without NumPy's warnings.
    with np.errstate(all="ignore"):
        if radius is None:
            check_kind("section", section, Section)
            assert section is not None
            _check_shapes(section, n)
        else:
            section = _round(_radii(radius, middles, dtype))
    densities = per_element("density", density, "kg/m^3")
    young = per_element("youngs_modulus", youngs_modulus, "Pa")
    factors = section.shear_factors
    if shear_correction is not None:
        factors = (per_element("shear_correction", shear_correction, ""),) * 2
    ratio = check_array("poisson_ratio", poisson_ratio, [(), (n,)], "")
    if not is_traced(ratio) and np.any((ratio <= -1) | (ratio > 0.5)):
        raise ValueError(f"poisson_ratio must be in (-1, 0.5], got {poisson_ratio}")
    if shear_modulus is None:
        shear = young / (2 * (1 + ratio))
    else:
        shear = per_element("shear_modulus", shear_modulus, "Pa")

    def check(formula: str, unit: str, value: Callable[..., Any], *given: Any) -> None:
        # If something is traced, each operation would be a program to compile.
        if not is_traced(given):
            held = np.asarray(value(*given))
            check_held(formula, held, unit, dtype, each=True)

    def leaf(formula: str, value: Any, unit: str) -> Any:
        check(formula, unit, np.asarray, value)
        # Known numbers are converted without a program, which would be compiled.
        arrays = jnp if is_traced(value) else np
        return arrays.broadcast_to(arrays.asarray(value, dtype), (n,))

    def rows(*leaves: Any) -> Array:
        return jnp.asarray((jnp if is_traced(leaves) else np).stack(leaves))

    area, moments = section.area, section.second_moments
    axes = 1 if section.is_round else 2
    with np.errstate(all="ignore"):
        line = densities * area
        twisting = shear * section.torsion_constant
        # Checked because every step computes them, though they are not stored: squares
        # of lengths, masses and inertias of elements, stiffnesses of joints, squares of
        # frequencies.
        h, rho = rest_lengths, densities
        check("element length^2", "m^2", lambda h: h**2, h)
        named = f"density {words.area} element length"
        check(named, "kg", lambda m, h: m * h, line, h)
        for formula, i in zip(words.moments[:axes], moments, strict=False):
            named = f"density {formula} element length"
            check(named, "kg m^2", lambda rho, i, h: rho * i * h, rho, i, h)
            bends = f"youngs_modulus {formula}"
            named = f"{bends} / element length"
            check(named, "N m", lambda e, i, h: e * i / h, young, i, h)
            named = f"{bends} element length"
            check(named, "N m^3", lambda e, i, h: e * i * h, young, i, h)
            rate = lambda g, rho, a, i: g / rho * (a / i)
            named = f"shear_modulus / density {words.area} / ({formula})"
            check(named, "1/s^2", rate, shear, rho, area, i)
        twists = f"shear_modulus {words.torsion}"
        check(f"{twists} / element length", "N m", lambda c, h: c / h, twisting, h)
        check(f"{twists} element length", "N m^3", lambda c, h: c * h, twisting, h)
        stretch = lambda e, rho, h: e / rho / h**2
        named = "youngs_modulus / density / element length^2"
        check(named, "1/s^2", stretch, young, rho, h)
        polar = densities * (moments[0] + moments[1])
        return Rod(
            rest_lengths=jnp.asarray(leaf("element length", rest_lengths, "m")),
            radii=jnp.asarray(leaf(words.radius, section.radius, "m")),
            linear_density=jnp.asarray(leaf(f"density {words.area}", line, "kg/m")),
            rotary_inertia=rows(
                *(
                    leaf(f"density {formula}", densities * moment, "kg m")
                    for formula, moment in zip(
                        words.moments[:axes], moments, strict=False
                    )
                ),
                leaf(f"density {words.polar}", polar, "kg m"),
            ),
            shear_stretch_stiffness=rows(
                *(
                    leaf(
                        f"shear_correction shear_modulus {words.area}",
                        factor * shear * area,
                        "N",
                    )
                    for factor in factors
                ),
                leaf(f"youngs_modulus {words.area}", young * area, "N"),
            ),
            bend_twist_stiffness=rows(
                *(
                    leaf(f"youngs_modulus {formula}", young * moment, "N m^2")
                    for formula, moment in zip(words.moments, moments, strict=True)
                ),
                leaf(twists, twisting, "N m^2"),
            ),
            rest_strains=jnp.asarray(np.zeros((3, n), dtype)),
            rest_curvatures=jnp.asarray(np.zeros((3, n - 1), dtype)),
        )


def _round(radii: Any) -> Section:
    """Section of solid circles, with second moments from the area, as in PyElastica."""
    area = np.pi * radii**2
    second = area**2 / (4 * np.pi)
    shear = (CIRCLE, CIRCLE)
    return Section(area, (second, second), 2 * second, shear, radii, is_round=True)


def _check_shapes(section: Section, n: int) -> None:
    for leaf in jax.tree.leaves(section):
        if np.shape(leaf) not in ((), (n,)):
            raise ValueError(
                f"section must have one number or one per element ({n}), got shape "
                f"{np.shape(leaf)}"
            )


def _radii(radius: Numbers, middles: Any, dtype: Any) -> Any:
    """Validates and returns a radius; a pair becomes a linear taper, one per element.

    `middles` are the arc-length positions of the element midpoints, divided by the
    rod's length.
    """
    n = len(middles)
    shapes = [(), (2,), (n,)]
    radii = check_array("radius", radius, shapes, "m", positive=True, dtype=dtype)
    if radii.shape != (2,):
        return radii
    if n == 2:
        raise ValueError(
            "radius must be one number for a rod of 2 elements: two could be the radii "
            "of the elements or of base and tip; got "
            f"{radius}. Take 3 elements"
        )
    base, tip = radii
    return base + (tip - base) * middles
