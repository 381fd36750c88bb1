"""Places on members of a system: nodes of rods and points of bodies, by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxrod.geometry.rotations import Quaternion, split_quaternion
from jaxrod.rods.rod import Layout
from jaxrod.structure import pytree, static, storable
from jaxrod.systems.coupling import AllParts, check_named
from jaxrod.validation import check_count, is_traced

Place = Sequence[Any]
"""Place on a member: `("arm", "tip")` or `("arm", 7)` on a rod, `("arms", 2, "base")`
on one of equal rods, `("ball",)` or `("balls", 3)` on bodies and points. A place on a
rod has the orientation of the element after the node; at the tip, of the last element.
"""


@storable
@dataclass(init=False, repr=False, eq=False)
class Indices:
    """Static array of integers: hashable, and compared by value."""

    values: np.ndarray
    """The integers, read-only."""

    def __init__(self, values: Any) -> None:
        """Stores a read-only copy of the integers."""
        self.values = np.array(values, np.int32, ndmin=1)
        self.values.flags.writeable = False
        self._hash = hash((self.values.shape, self.values.tobytes()))

    def __hash__(self) -> int:
        """Hash of the integers, computed once."""
        return self._hash

    def __eq__(self, other: object) -> bool:
        """Whether the other object has equal integers."""
        return (
            isinstance(other, Indices)
            and self._hash == other._hash
            and np.array_equal(self.values, other.values)
        )

    def __len__(self) -> int:
        """Number of integers."""
        return len(self.values)

    def __repr__(self) -> str:
        """Text such as `Indices([0, 1])`."""
        return f"Indices({self.values.tolist()})"


@pytree
class Points:
    """Nodes and elements of one member, by index over all its rods or bodies."""

    member: str = static()
    """Name of the member."""
    nodes: Indices = static()
    """Indices of nodes, over all rods of the member; or of bodies."""
    elements: Indices = static()
    """Indices of the elements that turn with these nodes; or of bodies."""

    def check(self, parts: AllParts) -> None:
        """Raises a `ValueError` if the member is missing or has too few nodes."""
        check_named(self.member, parts)
        largest = parts[self.member].n_nodes
        if np.any(self.nodes.values >= largest):
            raise ValueError(
                f"{self.member!r} has {largest} nodes, got node "
                f"{int(np.max(self.nodes.values))}"
            )


def layouts_of(state: Mapping[str, Any]) -> dict[str, Layout]:
    """Layouts (numbers of rods and elements) of all members, from a state.

    Raises:
        TypeError: If it is not a mapping from names to states of rods and bodies.
    """
    if not isinstance(state, Mapping):
        raise TypeError(
            "state must be a dict of the states of all members by name, got "
            f"{type(state).__name__}"
        )
    return {name: _layout(name, own) for name, own in state.items()}


def _layout(name: str, state: Any) -> Layout:
    layout: Layout | None = getattr(state, "layout", None)
    if layout is None:
        raise TypeError(
            f"state of {name!r} must be a RodState, a BodyState or another with a "
            f"layout, got {type(state).__name__}"
        )
    return layout


def resolved(
    name: str, place: Place, layouts: Mapping[str, Layout]
) -> tuple[str, int, int]:
    """Name of the member of a place, and the indices of its node and its element.

    Indices count over all rods of the member.

    Args:
        name: Name of the argument, for messages.
        place: The place; see `Place`.
        layouts: Layouts of all members.

    Raises:
        ValueError: If there is no such place.
        TypeError: If `place` is not a sequence such as `("arm", "tip")`.
    """
    if isinstance(place, str) or not isinstance(place, Sequence) or not place:
        raise TypeError(f'{name} must be a place such as ("arm", "tip"), got {place!r}')
    member, *rest = place
    check_named(member, layouts, where=name)
    own = layouts[member]
    if not own.is_rod:
        if len(rest) > 1:
            raise ValueError(f"{name}: a body is named alone, got {place!r}")
        body = _of_many(name, f"of {member!r}", rest, own.count)
        return member, body, body
    if len(rest) not in (1, 2):
        raise ValueError(
            f'{name}: of a rod an end ("base", "tip") or a node is needed, '
            f"got {place!r}"
        )
    rod = _of_many(name, f"of {member!r}", rest[:-1], own.count)
    node = _node(name, member, rest[-1], own)
    element = min(node, own.n_elements - 1)
    per_rod = own.n_elements
    return member, rod * (per_rod + 1) + node, rod * per_rod + element


def _of_many(name: str, where: str, given: Sequence[Any], count: int) -> int:
    if not given:
        if count > 1:
            raise ValueError(f"{name}: {where} there are {count}, say which")
        return 0
    which = check_count(f"{name}: the number {where}", given[0], 0, count - 1)
    return int(which)


def _node(name: str, member: str, node: Any, layout: Layout) -> int:
    last = layout.n_elements
    if node == "base":
        return 0
    if node == "tip":
        return last
    if isinstance(node, str):
        raise ValueError(
            f'{name}: an end is "base" or "tip", got {node!r} of {member!r}'
        )
    counted = node + last + 1 if isinstance(node, int) and node < 0 else node
    return check_count(f"{name}: node of {member!r}", counted, 0, last)


def points_of(name: str, places: Sequence[tuple[str, int, int]]) -> Points:
    """Points from places of one member, as `resolved` returns them.

    Raises:
        ValueError: If the places are of several members.
    """
    members = {member for member, _, _ in places}
    if len(members) != 1:
        raise ValueError(
            f"all places of {name} must be of one member, got {sorted(members)}: give "
            "a coupling for each"
        )
    return Points(
        members.pop(),
        Indices([node for _, node, _ in places]),
        Indices([element for _, _, element in places]),
    )


@pytree
class Pose:
    """Position and orientation of a place in a state."""

    place: Any
    """Position of the node, or of the body's origin [m]."""
    orientation: Quaternion
    """Orientation of the element that turns with the place, or of the body."""
    spacing: Any
    """Current length of that element [m]; infinite for a body."""


def position_of(name: str, place: Place, state: Mapping[str, Any]) -> Pose:
    """Pose of a place in a state.

    Args:
        name: Name of the argument, for messages.
        place: See `jaxrod.systems.joints.places.Place`.
        state: State of a system.
    """
    layouts = layouts_of(state)
    member, node, element = resolved(name, place, layouts)
    own, layout = state[member], layouts[member]
    positions, orientations = own.positions, own.orientations
    if not is_traced(positions, orientations):
        # On the host: this is little work, but it would take long to compile.
        positions, orientations = map(np.asarray, (positions, orientations))
    positions, orientations = layout.row(positions), layout.row(orientations)
    x = positions[:, node]
    w = split_quaternion(orientations[:, element])
    if not layout.is_rod:
        return Pose(x, w, np.inf)
    # Each rod has one node more than elements.
    start = element + element // layout.n_elements
    edge = positions[:, start + 1] - positions[:, start]
    return Pose(x, w, (edge[0] ** 2 + edge[1] ** 2 + edge[2] ** 2) ** 0.5)
