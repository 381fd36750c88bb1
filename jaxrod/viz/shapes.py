"""Spheres and cylinders that are shown with the rods."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxrod.viz.arrays import numbers, require_finite


@dataclasses.dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere shown with the rods, such as a target."""

    positions: Any
    """Centre [m], shape (3,) if it is at rest, (T, 3) if it moves."""
    radius: float
    """Radius [m]."""
    name: str = "target"
    """Name in the legend."""


@dataclasses.dataclass(frozen=True, eq=False)
class Cylinder:
    """A cylinder at rest, such as an obstacle."""

    start: Any
    """Centre of one end [m], shape (3,)."""
    end: Any
    """Centre of the other end [m], shape (3,)."""
    radius: float
    """Radius [m]."""
    name: str = "obstacle"
    """Name in the legend."""


def checked_sphere(index: int, sphere: Sphere, times: np.ndarray) -> Sphere:
    """A checked copy of a sphere, with one position per frame."""
    name = f"spheres[{index}].positions"
    centre = numbers(name, sphere.positions, "m")
    if centre.shape not in ((3,), (len(times), 3)):
        raise ValueError(
            f"{name} must have shape (3,) or ({len(times)}, 3) [m], got {centre.shape}"
        )
    require_finite(name, centre, "m")
    radius = _positive(f"spheres[{index}].radius", sphere.radius, "m")
    moving = np.broadcast_to(centre, (len(times), 3)).copy()
    return Sphere(moving, radius, str(sphere.name))


def checked_cylinder(index: int, cylinder: Cylinder) -> Cylinder:
    """A checked copy of a cylinder."""
    ends = []
    for side in ("start", "end"):
        name = f"cylinders[{index}].{side}"
        point = numbers(name, getattr(cylinder, side), "m")
        if point.shape != (3,):
            raise ValueError(f"{name} must have shape (3,) [m], got {point.shape}")
        require_finite(name, point, "m")
        ends.append(point)
    if np.array_equal(ends[0], ends[1]):
        raise ValueError(
            f"cylinders[{index}] must have a length, got start = end = {ends[0]} m"
        )
    radius = _positive(f"cylinders[{index}].radius", cylinder.radius, "m")
    return Cylinder(ends[0], ends[1], radius, str(cylinder.name))


def _positive(name: str, value: Any, unit: str) -> float:
    number = numbers(name, value, unit)
    if number.ndim != 0 or not (np.isfinite(number) and number > 0):
        raise ValueError(f"{name} must be one positive number, got {value} {unit}")
    return float(number)
