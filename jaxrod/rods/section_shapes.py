"""Shapes of sections: area, second moments, torsion constant and shear factors.

Dimensions are one number or one per element. Shear factors are those of Kaneko and of
Hutchinson (J. Appl. Mech. 68, 2001) at Poisson's ratio 1/2: for circles and tubes 27/28
and less, for rectangles 5/6. An ellipse has the circle's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxrod.geometry.material_frames import module_for
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, is_traced, numeric

CIRCLE = np.float64(27 / 28)
"""Shear factor of a circular section at Poisson's ratio 1/2, as in PyElastica 1.0."""


_LARGEST = 1e40
"""Largest dimension [m]: sixth powers of much larger ones overflow in float64."""


@pytree
class Section:
    """A shape of sections; each entry is one number, or one per element."""

    area: Any
    """Area [m^2]."""
    second_moments: tuple[Any, Any]
    """Second moments of area about d1 and d2 [m^4]."""
    torsion_constant: Any
    """Torsional stiffness over shear modulus [m^4]."""
    shear_factors: tuple[Any, Any]
    """Shear correction factors along d1 and d2 [1]."""
    radius: Any
    """Radius of a circle with the area inside the outline; not for mechanics [m]."""
    is_round: bool = static(default=False)
    """Whether it is the same about d1 and d2, whatever its numbers."""


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
    """A solid circle.

    Args:
        radius: Radius [m].

    Raises:
        ValueError: If the radius is not positive.
    """
    r = _dimension("radius", radius)
    second = np.pi * r**4 / 4
    area = np.pi * r**2
    shear = (CIRCLE, CIRCLE)
    return Section(area, (second, second), 2 * second, shear, r, is_round=True)


def tube(outer_radius: Numbers, inner_radius: Numbers) -> Section:
    """A circle with a concentric hole.

    Args:
        outer_radius: Outer radius [m].
        inner_radius: Inner radius, smaller [m].

    Raises:
        ValueError: If the radii are not positive, or the inner one is not smaller.
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
    """A rectangle.

    The torsion constant is `a b^3 (1/3 - 0.21 b/a (1 - b^4 / (12 a^4)))` with the
    longer side a and the shorter b; its error is at most 0.5 % (Young and Budynas,
    Roark's Formulas).

    Args:
        width: Side along d1 [m].
        height: Side along d2 [m].

    Raises:
        ValueError: If a side is not positive.
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
    """An ellipse.

    Args:
        half_width: Semi-axis along d1 [m].
        half_height: Semi-axis along d2 [m].

    Raises:
        ValueError: If a semi-axis is not positive.
    """
    a = _dimension("half_width", half_width)
    b = _dimension("half_height", half_height)
    area = np.pi * a * b
    moments = (area * b**2 / 4, area * a**2 / 4)
    torsion = np.pi * a**3 * b**3 / (a**2 + b**2)
    return Section(area, moments, torsion, (CIRCLE, CIRCLE), (a * b) ** 0.5)
