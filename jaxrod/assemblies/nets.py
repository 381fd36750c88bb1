"""Nets: two layers of parallel rods, joined where they cross."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from jaxrod.assemblies.groups import equal_rods, scenes
from jaxrod.effects.base import Effect
from jaxrod.rods.factories import straight_rod
from jaxrod.systems.joints.ties import tie
from jaxrod.systems.joints.welds import weld
from jaxrod.systems.system import System, make_system
from jaxrod.validation import as_array, check_count


def net(
    rows: int,
    columns: int,
    *,
    spacing: float,
    elements_per_cell: int = 2,
    joined: Literal["weld", "tie"] = "weld",
    effects: Sequence[Effect] = (),
    **rod: Any,
) -> tuple[System, dict[str, Any]]:
    """A net of square cells in the plane z = 0.

    The members are "rows", equal rods along x, and "columns", equal rods along y. Row
    `i` and column `j` meet at node `j * elements_per_cell` of the row and node
    `i * elements_per_cell` of the column.

    Args:
        rows: Rods along x, at least 2.
        columns: Rods along y, at least 2.
        spacing: Side of a cell [m].
        elements_per_cell: Elements of a rod along a cell.
        joined: "weld" makes the rods one at a crossing; "tie" pins them, so that they
            turn freely.
        effects: Effects on every rod.
        **rod: Section and material, passed to `jaxrod.straight_rod`.

    Returns:
        The system and its state at rest.

    Raises:
        ValueError: If an argument is out of range.
    """
    check_count("rows", rows, 2, 1000)
    check_count("columns", columns, 2, 1000)
    per = check_count("elements_per_cell", elements_per_cell, 1, 1000)
    side = float(as_array("spacing", spacing, "m", positive=True))
    if joined not in ("weld", "tie"):
        raise ValueError(f'joined must be "weld" or "tie", got {joined!r}')
    state, members = {}, {}
    for name, count, cells, axis in (
        ("rows", rows, columns - 1, 0),
        ("columns", columns, rows - 1, 1),
    ):
        starts = np.zeros((count, 3))
        starts[:, 1 - axis] = side * np.arange(count)
        direction = np.eye(3)[axis]

        def made(start: Any, cells: int = cells, way: Any = direction) -> Any:
            return straight_rod(
                max(cells * per, 2),
                length=cells * side,
                start=start,
                direction=way,
                normal=(0.0, 0.0, 1.0),
                **rod,
            )

        if cells * per < 2:
            raise ValueError(
                "elements_per_cell must be at least 2 where there is one cell, got 1"
            )
        rods, states = equal_rods(made, starts)
        members[name] = scenes(rods, states, effects)
        state[name] = states
    crossings = [(i, j) for i in range(rows) for j in range(columns)]
    join: Any = weld if joined == "weld" else tie
    joints = join(
        [("rows", i, j * per) for i, j in crossings],
        [("columns", j, i * per) for i, j in crossings],
        state,
    )
    return make_system(members, joints, state=state), state
