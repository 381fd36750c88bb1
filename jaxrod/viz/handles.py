"""Handles of the live page: sliders and targets, and the numbers of a model they set.

A handle names its numbers by a function that selects them, such as
`lambda scene: scene.effects[1].tension[0]`. The function is called once with a copy of
the model whose numbers are replaced by marks, so that it is known which were selected.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.viz.shapes import numbers, require_finite

Where = Callable[[Any], Any]
Extent = tuple[np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False)
class Slider:
    """A slider of the live page, which sets numbers of a scene or a system.

    Example:
        >>> tension = viz.Slider(lambda scene: scene.effects[1].tension[0], 0.0, 5.0)
        >>> controls = {"tension [N]": tension}  # for `viz.live`
        >>> controls["tension [N]"].high
        5.0
    """

    where: Where | None
    """Function that selects from the model the numbers to set; all of them get the
    value of the slider. `None` for a slider that only `law` reads."""
    low: float
    """Value at the left end, in the unit of the numbers."""
    high: float
    """Value at the right end, in the unit of the numbers."""
    start: float | None = None
    """Initial value; by default that of the model, or `low` without `where`."""

    radius: ClassVar[None] = None
    """A slider is not drawn as a ball."""

    def ends(self, box: Extent) -> Extent:
        """Lowest and highest value."""
        return np.asarray(self.low, float), np.asarray(self.high, float)

    def initial(self, label: str, found: Array | None) -> np.ndarray:
        """Initial value, after checks of all numbers; raises a ValueError."""
        name = f"controls[{label!r}]"
        low = float(checked(f"{name}.low", self.low))
        high = float(checked(f"{name}.high", self.high))
        if not low < high:
            raise ValueError(f"{name} must have low < high, got {low:g} and {high:g}")
        start = self.start
        if start is None:
            start = low if found is None else float(found[0])
        return self.checked(label, checked(f"{name}.start", start))

    def checked(self, label: str, value: Any) -> np.ndarray:
        """A value as an array; raises a ValueError if it is out of range."""
        number = float(checked(repr(label), value))
        if not self.low <= number <= self.high:
            raise ValueError(
                f"{label!r} must be from {self.low:g} to {self.high:g}, got {number:g}"
            )
        return np.asarray(number)


@dataclasses.dataclass(frozen=True, eq=False)
class Target:
    """A ball in the live page that is moved with the mouse, and sets three numbers.

    Example:
        >>> goal = viz.Target(None, radius=0.03, start=(1.0, 0.0, 0.2))
        >>> goal.radius  # `values["goal"]` in the function `law` of `viz.live`
        0.03
    """

    where: Where | None
    """Function that selects three numbers of the model, a point [m]; `None` for a
    target that only `law` reads."""
    radius: float
    """Radius of the ball [m]."""
    start: Any = None
    """Initial position [m], shape (3,); by default that of the model."""

    def ends(self, box: Extent) -> Extent:
        """Lowest and highest corner of the view, beyond which it may be dragged."""
        return box

    def initial(self, label: str, found: Array | None) -> np.ndarray:
        """Initial value, after checks of all numbers; raises a ValueError."""
        name = f"controls[{label!r}]"
        radius = float(checked(f"{name}.radius", self.radius, unit="m"))
        if not radius > 0:
            raise ValueError(f"{name}.radius must be positive, got {radius:g} m")
        if found is not None and len(found) != 3:
            raise ValueError(f"{name} must select 3 numbers, got {len(found)}")
        start = self.start
        if start is None:
            if found is None:
                raise ValueError(f"{name} needs start, a point (3,) in m")
            start = found
        return self.checked(label, start)

    def checked(self, label: str, value: Any) -> np.ndarray:
        """A point as an array; raises a ValueError if it is none."""
        return checked(repr(label), value, (3,), "m")


Handle = Slider | Target
_ONLY_ONE = "a where function selects numbers of the model, such as effects[1].force[2]"


def checked(
    name: str, value: Any, shape: tuple[int, ...] = (), unit: str = "1"
) -> np.ndarray:
    """Finite numbers of one shape as an array; raises a ValueError for others."""
    given = numbers(name, value, unit)
    if given.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {given.shape}")
    require_finite(name, given, unit)
    return given


class _Mark:
    """Placeholder of one number of a model."""

    def __init__(self, leaf: int, entry: int) -> None:
        self.place = leaf, entry


@dataclasses.dataclass(frozen=True)
class Selected:
    """Numbers of a model, as entries of its leaves."""

    places: tuple[tuple[int, int], ...]
    """Index of the leaf, and of the entry in it, for each number."""

    def read(self, model: Any) -> Array:
        """The numbers, shape (count,)."""
        leaves = jax.tree.leaves(model)
        return jnp.stack([jnp.ravel(leaves[leaf])[k] for leaf, k in self.places])

    def written(self, model: Any, value: Array) -> Any:
        """Copy of the model with other numbers: one for all, or one for each."""
        leaves, structure = jax.tree.flatten(model)
        groups = [(value, self.places)]
        if value.ndim:
            groups = [(value[k], (place,)) for k, place in enumerate(self.places)]
        for number, places in groups:
            for leaf in {leaf for leaf, _ in places}:
                old = jnp.asarray(leaves[leaf])
                here = np.zeros(old.size, bool)
                here[[k for own, k in places if own == leaf]] = True
                new = number.astype(old.dtype)
                leaves[leaf] = jnp.where(here.reshape(old.shape), new, old)
        return jax.tree.unflatten(structure, leaves)


def selected(label: str, where: Where, model: Any) -> Selected:
    """Finds out which numbers of a model a function selects.

    Raises:
        ValueError: It selects none, or computes with them.
    """
    leaves, structure = jax.tree.flatten(model)
    marked = []
    for index, leaf in enumerate(leaves):
        marks = [_Mark(index, entry) for entry in range(np.size(leaf))]
        array = np.empty(len(marks), object)
        array[:] = marks
        marked.append(array.reshape(np.shape(leaf)))
    name = f"controls[{label!r}].where"
    try:
        found = where(jax.tree.unflatten(structure, marked))
    except Exception as error:
        raise ValueError(
            f"{name} failed: {type(error).__name__}: {error} ({_ONLY_ONE})"
        ) from error
    listed = list(np.ravel(np.asarray(found, object)))
    places: list[Any] = [getattr(one, "place", None) for one in listed]
    if not places or None in places:
        raise ValueError(
            f"{name} must return numbers of the model unchanged, got "
            f"{type(found).__name__}; a schedule moves by itself: give a number instead"
        )
    return Selected(tuple(places))


@dataclasses.dataclass(frozen=True)
class Controls:
    """All handles of a page, with the numbers that they set."""

    handles: Mapping[str, Handle]
    """Sliders and targets by label."""
    places: Mapping[str, Selected]
    """Numbers of the model, by label of the handle that sets them."""

    def applied(self, model: Any, values: Mapping[str, Array]) -> Any:
        """Copy of the model with the values of all handles."""
        for label, place in self.places.items():
            model = place.written(model, values[label])
        return model


def controls_of(
    handles: Mapping[str, Handle], model: Any
) -> tuple[Controls, dict[str, np.ndarray]]:
    """Checks handles, and returns them as controls with their initial values."""
    if not isinstance(handles, Mapping):
        raise TypeError(
            "controls must be a dict of sliders and targets by label, got "
            f"{type(handles).__name__}"
        )
    places: dict[str, Selected] = {}
    values: dict[str, np.ndarray] = {}
    for label, handle in handles.items():
        # A class has the methods of its handles, but no numbers to select.
        if isinstance(handle, type) or not callable(getattr(handle, "initial", None)):
            raise TypeError(
                f"controls[{label!r}] must be a viz.Slider or a viz.Target, got "
                f"{handle!r}"
            )
        found = None
        if handle.where is not None:
            places[label] = selected(label, handle.where, model)
            found = places[label].read(model)
        values[label] = handle.initial(label, found)
    return Controls(dict(handles), places), values
