"""Degrees of freedom held by supports, and a check that none is held twice."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

from jaxrod.effects.ends import End

Axes = tuple[bool, bool, bool]
"""Flags of the world axes x, y and z along which a node is held."""


ALL_AXES: Axes = (True, True, True)


@dataclass(frozen=True)
class Held:
    """Degrees of freedom that one effect holds: of a node, of an element, or of both.

    Example:
        >>> jaxrod.pin_support(state, "tip", axes="yz").held(rod)
        (Held(node=10, axes=(False, True, True), element=None),)
        >>> (held,) = jaxrod.clamp(state).held(rod)
        >>> held.node, held.element
        (0, 0)
    """

    node: int | None = None
    """Index of the held node, negative from the end; `None` if no node is held."""
    axes: Axes = ALL_AXES
    """World axes along which the node is held."""
    element: int | None = None
    """Index of the element whose orientation is held, rigidly or by a joint; `None` if
    none is."""


def held_end(end: End, axes: Axes = ALL_AXES) -> Held:
    """Degrees of freedom of an end: its node along `axes`, and its element."""
    index = 0 if end == "base" else -1
    return Held(index, axes, index)


def check_held_once(held: Iterable[tuple[str, Held]], n_elements: int) -> None:
    """Checks that no two supports hold the same degree of freedom.

    Args:
        held: Held degrees of freedom, each with the name of its effect.
        n_elements: Number of elements of the rod.

    Raises:
        ValueError: If two supports do. They would undo each other, and neither reaction
            would be the load that its support bears.
    """
    for (name, one), (other_name, other) in combinations(held, 2):
        both = f"{name} and {other_name} both hold"
        axes = [
            axis
            for axis, *pair in zip("xyz", one.axes, other.axes, strict=True)
            if all(pair)
        ]
        node = _same(one.node, other.node, n_elements + 1)
        if node is not None and axes:
            raise ValueError(
                f"{both} node {node} along {', '.join(axes)}: along each axis a node "
                "is held by one support at most"
            )
        element = _same(one.element, other.element, n_elements)
        if element is not None:
            raise ValueError(
                f"{both} the orientation of element {element}: an element is held by "
                "one support at most"
            )


def _same(one: int | None, other: int | None, size: int) -> int | None:
    """Common position of two indices in `size` entries; `None` if they differ."""
    if one is None or other is None or one % size != other % size:
        return None
    return one % size
