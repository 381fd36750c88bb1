"""Carpets of cilia or whiskers: equal rods that stand on a wall."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxrod.assemblies.groups import MOST_RODS, equal_rods, scenes
from jaxrod.effects.base import Effect
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.rods.factories import straight_rod
from jaxrod.systems.system import System, make_system
from jaxrod.validation import Numbers, as_array, check_count


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

    def made(start: Any) -> Any:
        return straight_rod(
            n_elements,
            length=length,
            radius=radius,
            start=start,
            direction=way,
            normal=(1.0, 0.0, 0.0) if abs(way[0]) < 0.9 else (0.0, 1.0, 0.0),
            **rod,
        )

    rods, states = equal_rods(made, starts)
    members = {"cilia": scenes(rods, states, effects, clamped=True)}
    return make_system(members), {"cilia": states}
