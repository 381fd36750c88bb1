"""Loads at places, summed on all nodes and elements of their members."""

from __future__ import annotations

from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.systems.coupling import AllSeen
from jaxrod.systems.places import Indices, Points
from jaxrod.systems.rows import summed


def sum_of_loads(*given: tuple[Points, Loads], seen: AllSeen) -> dict[str, Loads]:
    """Loads on whole members, from loads at places."""
    total: dict[str, Loads] = {}
    for points, loads in given:
        parts = seen[points.member].parts
        size = parts.n_nodes, parts.inertias.shape[1]
        forces = _spread(loads.forces, points.nodes, size[0])
        couples = _spread(loads.couples, points.elements, size[1])
        earlier = total.get(points.member, Loads())
        total[points.member] = Loads(
            _added(earlier.forces, forces), _added(earlier.couples, couples)
        )
    return total


def _spread(vector: Vec3 | None, index: Indices, size: int) -> Vec3 | None:
    if vector is None:
        return None
    x, y, z = (summed(component, index, size) for component in vector)
    return x, y, z


def _added(a: Vec3 | None, b: Vec3 | None) -> Vec3 | None:
    if a is None or b is None:
        return b if a is None else a
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
