"""The two ends of a rod: access to the entries of a field there."""

from __future__ import annotations

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
    """Support for the orientation of the element at one end of a rod.

    Example:
        >>> muscle = actuation.muscle(rod, 2.0, into=jaxrod.clamp(state))
        >>> (wall,) = muscle.walls
        >>> wall.end, wall.orientation.tolist()
        ('base', [0.5, 0.5, 0.5, 0.5])
    """

    orientation: Float[Array, "4"]
    """The element's orientation at rest (w, x, y, z)."""
    stiffness: Float[Array, "3"] | None = None
    """Stiffness of the elastic joint between wall and element, about the element's
    axes [N m]; `None` for an element that is held rigidly."""
    end: End = static(default="base")
    """The end that is held."""


def zero_one_end(field: Array, end: End) -> Array:
    """Field with the entry at one end set to zero."""
    if end == "base":
        return vectors.pad(field[1:], 1, 0)
    return vectors.pad(field[:-1], 0, 1)


def replace_end(field: Array, value: Array, end: End) -> Array:
    """Field with the entry at one end replaced."""
    return zero_one_end(field, end) + place(value, field.shape[0], end)


def zero_at_end(field: Vec3, end: End) -> Vec3:
    """Vector field with the entry at one end set to zero."""
    a, b, c = (zero_one_end(component, end) for component in field)
    return a, b, c


def at_end(field: Quaternion, end: End) -> Quaternion:
    """Orientation of the element at one end."""
    index = 0 if end == "base" else -1
    w, x, y, z = (component[index] for component in field)
    return w, x, y, z


def place(value: Array, size: int, end: End) -> Array:
    """Field that is zero except at one end."""
    before, after = (0, size - 1) if end == "base" else (size - 1, 0)
    return vectors.pad(value[None], before, after)


def only_at_end(value: Vec3, size: int, end: End) -> Vec3:
    """Vector field that is zero except at one end."""
    a, b, c = (place(component, size, end) for component in value)
    return a, b, c


def check_end(end: End) -> End:
    """Returns the name of an end; raises ValueError if it is not one."""
    if not isinstance(end, str) or end not in ("base", "tip"):
        raise ValueError(f'end must be "base" or "tip", got {end!r}')
    return end


def check_made_for(name: str, count: int | None, rod: Rod) -> None:
    """Raises ValueError if a support was made from a state with other elements.

    Args:
        name: Name of the support's factory.
        count: Number of elements of the state it was made from; `None` if not known.
        rod: The rod it holds.
    """
    if count is not None and count != rod.n_elements:
        raise ValueError(
            f"{name}(state) must be given a state of the rod it holds: the state has "
            f"{count} elements, the rod {rod.n_elements}"
        )


def made_again_for(count: int | None, rod: Rod) -> int | None:
    """Number of elements to record when a support is resampled for another rod."""
    return None if count is None else rod.n_elements
