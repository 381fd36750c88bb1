"""Checks of the numbers that laws of contact between rods have in common."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array

from jaxrod.systems.contact.neighbour_lists import NeighbourLists
from jaxrod.validation import Numbers, as_array, check_count, check_kind


def contact_numbers(
    members: tuple[str, ...],
    stiffness: Numbers,
    damped: tuple[Numbers | None, Numbers | None, Numbers | None],
    onset: Numbers,
    partners: int,
    lists: NeighbourLists | None,
    *,
    units: tuple[str, str],
) -> dict[str, Any]:
    """Checked fields that laws have in common.

    Args:
        members: Names of the members.
        stiffness: Force per penetration.
        damped: Damping, friction and friction drag.
        onset: Width of the onset over the mean of the radii [1].
        partners: Rods that may touch one place at a time.
        lists: Settings of lists of neighbours.
        units: Units of the stiffness and of damping.

    Raises:
        ValueError: If a number is out of range, or friction has no drag.
        TypeError: If a name is not a string.
    """
    for name in members:
        if not isinstance(name, str):
            raise TypeError(f"members are named by strings, got {name!r}")
    if not members or len(set(members)) < len(members):
        raise ValueError(f"members must be named once each, got {list(members)}")
    damping, friction, friction_drag = damped
    drag = damping if friction_drag is None else friction_drag
    if friction is not None and drag is None:
        raise ValueError(
            f"friction needs friction_drag > 0 {units[1]}, what it resists per speed "
            "at the onset of slip (by default the damping), got none"
        )
    if lists is not None:
        check_kind("lists", lists, NeighbourLists)

    def number(name: str, value: Numbers | None, unit: str) -> Array | None:
        return None if value is None else as_array(name, value, unit, positive=True)

    return {
        "stiffness": as_array("stiffness", stiffness, units[0], positive=True),
        "onset": as_array("onset", onset, "", positive=True),
        "damping": number("damping", damping, units[1]),
        "friction": number("friction", friction, ""),
        "friction_drag": (
            None if friction is None else number("friction_drag", drag, units[1])
        ),
        "members": members,
        "partners": check_count("partners", partners, 1, 1000),
        "lists": lists,
    }
