"""Ends of a rod, "base" and "tip", and degrees of freedom that supports hold.

Functions here read and write the entry of a field at an end. A check finds degrees of
freedom that are held twice.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import Quaternion
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree, static

End = Literal["base", "tip"]


@pytree
class Wall:
    """Wall that holds the orientation of a rod's end element, rigidly or by a joint.

    Example:
        >>> muscle = actuation.muscle(rod, 2.0, into=jaxrod.clamp(state))
        >>> (wall,) = muscle.walls
        >>> wall.end, wall.orientation.tolist()
        ('base', [0.5, 0.5, 0.5, 0.5])
    """

    orientation: Float[Array, "4"]
    """Orientation of the end element when the wall joint is at rest (w, x, y, z)."""
    stiffness: Float[Array, "3"] | None = None
    """Stiffness of the elastic joint between the wall and the end element, about the
    axes of the element [N m]; `None` for an element that is held rigidly."""
    end: End = static(default="base")
    """End of the rod that the wall holds, "base" or "tip"."""


def zero_one_end(field: Array, end: End) -> Array:
    """Array over nodes or elements with its entry at one end set to zero."""
    if end == "base":
        return vectors.pad(field[1:], 1, 0)
    return vectors.pad(field[:-1], 0, 1)


def replace_end(field: Array, value: Array, end: End) -> Array:
    """Array over nodes or elements with its entry at one end set to `value`."""
    return zero_one_end(field, end) + place(value, field.shape[0], end)


def zero_at_end(field: Vec3, end: End) -> Vec3:
    """Vector field over nodes or elements with its entry at one end set to zero."""
    a, b, c = (zero_one_end(component, end) for component in field)
    return a, b, c


def at_end(field: Quaternion, end: End) -> Quaternion:
    """Orientation of the element at one end."""
    index = 0 if end == "base" else -1
    w, x, y, z = (component[index] for component in field)
    return w, x, y, z


def place(value: Array, size: int, end: End) -> Array:
    """Array of `size` entries, zero except for `value` at one end."""
    before, after = (0, size - 1) if end == "base" else (size - 1, 0)
    return vectors.pad(value[None], before, after)


def only_at_end(value: Vec3, size: int, end: End) -> Vec3:
    """Vector field of `size` entries, zero except for `value` at one end."""
    a, b, c = (place(component, size, end) for component in value)
    return a, b, c


def check_end(end: End) -> End:
    """Returns the end if it is "base" or "tip"; raises ValueError otherwise."""
    if not isinstance(end, str) or end not in ("base", "tip"):
        raise ValueError(f'end must be "base" or "tip", got {end!r}')
    return end


def check_made_for(name: str, count: int | None, rod: Rod) -> None:
    """Raises ValueError if a support was made for another number of elements.

    Args:
        name: Name of the support's factory.
        count: Number of elements of the state from which the support was made; `None`
            if not known.
        rod: The rod that the support holds.
    """
    if count is not None and count != rod.n_elements:
        raise ValueError(
            f"{name}(state) must be given a state of the rod it holds: the state has "
            f"{count} elements, the rod {rod.n_elements}"
        )


def made_again_for(count: int | None, rod: Rod) -> int | None:
    """`made_for` for a support moved to `rod`; `None` if the old `count` is `None`."""
    return None if count is None else rod.n_elements


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
    """Raises ValueError if two supports hold the same degree of freedom.

    Args:
        held: Held degrees of freedom, each with the name of its effect.
        n_elements: Number of elements of the rod.

    Raises:
        ValueError: If they do. They would undo each other, and neither reaction would
            be the load that its support bears.
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
    """Non-negative form of two indices that denote the same one of `size` entries.

    Negative indices count from the end. `None` if the indices denote different entries,
    or one of them is `None`.
    """
    if one is None or other is None or one % size != other % size:
        return None
    return one % size
