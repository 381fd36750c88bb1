r"""Woven rods: braids around a tube, and planar nets of crossing rods.

A strand of length $b$ that winds $N$ times around a tube of radius $R$ and length $L$
has $b^2 = L^2 + (2\pi N R)^2$: a braid that becomes wider becomes shorter, like the
sleeve of a McKibben muscle.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from jaxrod.assemblies.groups import equal_rods, rods_along, scenes
from jaxrod.contacts.bodies import cylinder
from jaxrod.effects.base import Effect
from jaxrod.systems.joints.ties import tie
from jaxrod.systems.joints.welds import attach, weld
from jaxrod.systems.members.rigid_bodies import rigid_body
from jaxrod.systems.system import System, make_system
from jaxrod.validation import as_array, check_count


def braid(
    strands: int,
    n_elements: int,
    *,
    radius: float,
    length: float,
    turns: float,
    thickness: float,
    joined: Literal["pinned", "free"] = "pinned",
    plate_density: float = 1000.0,
    effects: Sequence[Effect] = (),
    **rod: Any,
) -> tuple[System, dict[str, Any]]:
    """Strands wound around the z axis, as many to the left as to the right.

    The members are "left" and "right", equal rods each, and "bottom" and "top", the
    discs to which the ends of the strands are attached. With `joined="pinned"` strands
    are pinned to each other where they cross. The braid is then a trellis: its strands
    turn against each other but cannot slide. With `joined="free"` crossing strands pass
    over and under each other, a little more than a diameter apart, so that contact can
    be added (`jaxrod.systems.rod_contact("left", "right", ...)`).

    Args:
        strands: Number of strands wound each way, at least 2.
        n_elements: Elements of each strand. Pinned strands have to cross at nodes, so
            with `joined="pinned"` it must be a multiple of `2 * strands * turns`, which
            must be a whole number.
        radius: Radius of the tube, from its axis to the centrelines of the strands [m].
        length: Length of the tube [m].
        turns: Turns of each strand around the tube [1].
        thickness: Radius of the strands [m].
        joined: "pinned" or "free".
        plate_density: Density of the discs [kg/m^3].
        effects: Effects on every strand.
        **rod: Material, passed to `jaxrod.rod_along`.

    Returns:
        The system and its state at rest; the strands are naturally curved.

    Raises:
        ValueError: If an argument is out of range, or strands do not cross at nodes.

    Example:
        >>> material = dict(density=1000.0, youngs_modulus=1e6)
        >>> size = dict(radius=0.05, length=0.3, turns=1.0, thickness=0.002)
        >>> system, states = assemblies.braid(2, 8, **size, **material)
        >>> sorted(states), states["left"].positions.shape
        (['bottom', 'left', 'right', 'top'], (2, 3, 9))
    """
    check_count("strands", strands, 2, 1000)
    check_count("n_elements", n_elements, 4, 100_000)
    wide = float(as_array("radius", radius, "m", positive=True))
    extent = float(as_array("length", length, "m", positive=True))
    wound = float(as_array("turns", turns, "", positive=True))
    thick = float(
        as_array("thickness", thickness, "m", positive=True, at_most=wide / 4)
    )
    if joined not in ("pinned", "free"):
        raise ValueError(f'joined must be "pinned" or "free", got {joined!r}')
    # A strand crosses each strand of the other direction 2 N times, N being its turns:
    # the crossings cut it into this many parts.
    parts = 2 * strands * wound
    pinned = joined == "pinned"
    if pinned and (abs(parts - round(parts)) > 1e-9 or n_elements % round(parts)):
        raise ValueError(
            "pinned strands cross at nodes, so 2 * strands * turns must be a whole "
            f"number, got {parts:g}, and n_elements a multiple of it, got {n_elements}"
        )
    share = np.linspace(0, 1, n_elements + 1)
    state: dict[str, Any] = {}
    members: dict[str, Any] = {}
    for name, sign in (("left", 1), ("right", -1)):
        curves = []
        for k in range(strands):
            angle = 2 * np.pi * (sign * wound * share + k / strands)
            size = wide + 0 * angle
            if not pinned:
                # Alternately over and under, so that strands cross a diameter apart.
                waves = np.cos(np.pi * (parts * share + (sign > 0)))
                size = wide + 1.1 * thick * waves
            curves.append(
                np.stack([size * np.cos(angle), size * np.sin(angle), extent * share])
            )
        rods, states = rods_along(curves, radius=thick, **rod)
        members[name], state[name] = scenes(rods, states, effects), states
    dtype = state["left"].positions.dtype
    couplings: list[Any] = []
    for plate, height in (("bottom", 0.0), ("top", extent)):
        out = -1.0 if plate == "bottom" else 1.0
        disc = cylinder((0, 0, height), (0, 0, height + out * 4 * thick), wide + thick)
        members[plate], state[plate] = rigid_body(
            disc, density=plate_density, dtype=dtype
        )
        end = "base" if plate == "bottom" else "tip"
        for name in ("left", "right"):
            ends = [(name, k, end) for k in range(strands)]
            couplings.append(attach(ends, (plate,), state, turning=True))
    if pinned:
        couplings.append(_pins(strands, n_elements, round(parts), state))
    return make_system(members, *couplings, state=state), state


def _pins(strands: int, n_elements: int, parts: int, state: dict[str, Any]) -> Any:
    """Ties that pin the strands together where they cross between the discs.

    Strands cross at nodes `n_elements // parts` elements apart.
    """
    per = n_elements // parts
    first, second = [], []
    left, right = (np.asarray(state[name].positions) for name in ("left", "right"))
    for part in range(1, parts):
        node = part * per
        for k in range(strands):
            apart = np.linalg.norm(right[:, :, node] - left[k, :, node], axis=1)
            other = int(np.argmin(apart))
            if apart[other] < 1e-6 * np.linalg.norm(left[k, :, 1] - left[k, :, 0]):
                first.append(("left", k, node))
                second.append(("right", other, node))
    return tie(first, second, state)


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
        joined: "weld" joins the rods firmly at a crossing; "tie" pins them, so that
            they turn freely.
        effects: Effects on every rod.
        **rod: Section and material, passed to `jaxrod.straight_rod`.

    Returns:
        The system and its state at rest.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> material = dict(radius=0.002, density=1000.0, youngs_modulus=1e6)
        >>> system, states = assemblies.net(2, 3, spacing=0.1, **material)
        >>> states["rows"].positions.shape, states["columns"].positions.shape
        ((2, 3, 5), (3, 3, 3))
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

        if cells * per < 2:
            raise ValueError(
                "elements_per_cell must be at least 2 if there is only one cell, got 1"
            )
        rods, states = equal_rods(
            cells * per,
            {"start": starts},
            length=cells * side,
            direction=direction,
            normal=(0.0, 0.0, 1.0),
            **rod,
        )
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
