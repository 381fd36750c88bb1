"""Parallel rods: bundles glued to their neighbours, and carpets on a wall."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxrod.assemblies.groups import MOST_RODS, equal_rods, scenes
from jaxrod.effects.base import Effect
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.systems.joints.glue import glue
from jaxrod.systems.system import System, make_system
from jaxrod.validation import Numbers, as_array, check_count, numeric

TOUCHING = 1.05
"""Distance of rods divided by the sum of their radii, up to which they are glued
[1]."""


def hexagonal_places(rings: int, spacing: float) -> np.ndarray:
    """Positions of the rods in a hexagonal bundle of 1, 7, 19, 37, ... rods.

    Args:
        rings: Number of rings around the rod in the middle.
        spacing: Distance between neighbours [m].

    Returns:
        Coordinates in the plane perpendicular to the bundle `(2, k)` [m].

    Raises:
        ValueError: If `rings` is negative, or `spacing` is not positive.

    Example:
        >>> assemblies.hexagonal_places(2, spacing=0.01).shape
        (2, 19)
    """
    check_count("rings", rings, 0, 100)
    around = range(-rings, rings + 1)
    found = [
        (i + 0.5 * j, 0.75**0.5 * j)
        for i in around
        for j in around
        if abs(i + j) <= rings
    ]
    return float(as_array("spacing", spacing, "m", positive=True)) * np.array(found).T


def bundle(
    places: Numbers,
    n_elements: int,
    *,
    length: float,
    radius: float,
    stiffness: Numbers,
    turning_stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    turning_damping: Numbers | None = None,
    clamped: bool = True,
    effects: Sequence[Effect] = (),
    **rod: Any,
) -> tuple[System, dict[str, Any]]:
    """Parallel rods along x, each glued to the rods that it touches.

    The system has one member, "rods".

    Args:
        places: Coordinates y and z of the rods `(2, k)` [m], such as those from
            `hexagonal_places`.
        n_elements: Elements of each rod.
        length: Length of the rods [m].
        radius: Radius of the rods [m].
        stiffness: Force of the glue per its length and distance [N/m^2].
        turning_stiffness: Couple of the glue per length and angle [N].
        damping: Force of the glue per length and relative speed [kg/(m s)].
        turning_damping: Couple of the glue per length and relative angular velocity
            [N s].
        clamped: Whether all rods are clamped at their base.
        effects: Effects on every rod.
        **rod: Material, passed to `jaxrod.straight_rod`.

    Returns:
        The system and its state at rest.

    Raises:
        ValueError: If a number is out of range, rods overlap, or none touch.

    Example:
        >>> places = assemblies.hexagonal_places(1, spacing=0.01)
        >>> material = dict(density=1000.0, youngs_modulus=1e6, stiffness=1e5)
        >>> system, states = assemblies.bundle(
        ...     places, 4, length=0.3, radius=0.005, **material
        ... )
        >>> states["rods"].positions.shape
        (7, 3, 5)
    """
    across = np.asarray(numeric("places", places, "m"))
    if across.ndim != 2 or across.shape[0] != 2 or across.shape[1] < 2:
        raise ValueError(
            f"places must have shape (2, k) [m], k > 1, got {across.shape}"
        )
    as_array("radius", radius, "m", positive=True)
    apart = np.linalg.norm(across[:, :, None] - across[:, None, :], axis=0)
    one, two = np.triu_indices(across.shape[1], 1)
    near = apart[one, two]
    if np.min(near) < 2 * radius * (1 - 1e-6):
        raise ValueError(
            f"rods of radius {radius:g} m overlap: places are {np.min(near):.3g} m "
            "apart"
        )
    touching = near <= TOUCHING * 2 * radius
    if not np.any(touching):
        raise ValueError(
            f"no rods of radius {radius:g} m touch: the nearest places are "
            f"{np.min(near):.3g} m apart"
        )
    starts = np.concatenate([np.zeros((1, across.shape[1])), across]).T

    rods, states = equal_rods(
        n_elements,
        {"start": starts},
        length=length,
        radius=radius,
        direction=(1.0, 0.0, 0.0),
        **rod,
    )
    state = {"rods": states}
    bond = glue(
        [("rods", int(k)) for k in one[touching]],
        [("rods", int(k)) for k in two[touching]],
        state,
        stiffness=stiffness,
        turning_stiffness=turning_stiffness,
        damping=damping,
        turning_damping=turning_damping,
    )
    members = {"rods": scenes(rods, states, effects, clamped=clamped)}
    return make_system(members, bond, state=state), state


def cilia(
    rows: int,
    columns: int,
    n_elements: int,
    *,
    spacing: float,
    length: float,
    radius: Numbers,
    direction: Numbers = (0.0, 0.0, 1.0),
    effects: Sequence[Effect] = (),
    **rod: Any,
) -> tuple[System, dict[str, Any]]:
    """Rods clamped on a square grid in the plane z = 0.

    The system has one member, "cilia". The rod in row `i` and column `j` is number
    `i * columns + j`. A pair of radii, at base and tip, makes whiskers.

    Args:
        rows: Number of rods along x.
        columns: Number of rods along y.
        n_elements: Elements of each rod.
        spacing: Distance between neighbours [m].
        length: Length of the rods [m].
        radius: Radius of the rods, or a pair of radii at base and tip [m].
        direction: Direction of the rods from the wall, of any length `(3,)`.
        effects: Effects on every rod.
        **rod: Material, passed to `jaxrod.straight_rod`.

    Returns:
        The system and its state at rest.

    Raises:
        ValueError: If an argument is out of range, or neighbours overlap.

    Example:
        >>> material = dict(radius=0.01, density=1000.0, youngs_modulus=1e6)
        >>> system, states = assemblies.cilia(
        ...     2, 3, n_elements=4, spacing=0.25, length=0.5, **material
        ... )
        >>> states["cilia"].tip[4].tolist()  # row 1, column 1
        [0.25, 0.25, 0.5]
    """
    check_count("rows", rows, 1, MOST_RODS)
    check_count("columns", columns, 1, MOST_RODS // rows)
    apart = float(as_array("spacing", spacing, "m", positive=True))
    widest = float(np.max(np.asarray(radius)))
    if apart < 2 * widest:
        raise ValueError(
            f"spacing must be at least the diameter, {2 * widest:g} m, got {apart:g} m"
        )
    way = unit_vector("direction", direction)
    x, y = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    starts = apart * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)

    rods, states = equal_rods(
        n_elements,
        {"start": starts},
        length=length,
        radius=radius,
        direction=way,
        normal=(1.0, 0.0, 0.0) if abs(way[0]) < 0.9 else (0.0, 1.0, 0.0),
        **rod,
    )
    members = {"cilia": scenes(rods, states, effects, clamped=True)}
    return make_system(members), {"cilia": states}
