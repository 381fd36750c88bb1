"""Groups of rods in a replay; the rods of a group have the same number of elements."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxrod.viz.shapes import checked_colour, numbers, require_finite


@dataclasses.dataclass(frozen=True, eq=False)
class Rods:
    """A group of R rods with n elements each, over T frames.

    Example:
        >>> path = state.positions[None]  # one frame
        >>> rods = viz.Replay.from_rollout(path, 0.02, [0.0], name="arm").rods[0]
        >>> rods.num_rods, rods.num_nodes, rods.radii.shape
        (1, 11, (1, 10))
    """

    positions: Float[np.ndarray, "num_frames num_rods num_nodes 3"]
    """Node positions [m], shape (T, R, n+1, 3)."""
    radii: Float[np.ndarray, "num_rods num_elements"]
    """Element radii [m], shape (R, n)."""
    name: str = ""
    """Common name of the rods."""
    names: tuple[str, ...] = ()
    """Names of the individual rods; empty, or R names."""
    colour: str = ""
    """Colour as "#rrggbb"; empty for an automatic colour."""
    fields: Mapping[str, Float[np.ndarray, "num_frames num_rods num_nodes"]] = (
        dataclasses.field(default_factory=dict)
    )
    """Fields that can colour the rods: by label, a number at every node and frame,
    shape (T, R, n+1)."""

    @property
    def num_rods(self) -> int:
        """Number of rods, R."""
        return self.positions.shape[1]

    @property
    def num_nodes(self) -> int:
        """Number of nodes of each rod, n+1."""
        return self.positions.shape[2]

    def at_frames(self, keep: Any) -> Rods:
        """Copy with only the frames of the indices `keep`."""
        return dataclasses.replace(
            self,
            positions=self.positions[keep],
            fields={label: values[keep] for label, values in self.fields.items()},
        )


def checked_rods(
    positions: Any,
    radii: Any,
    times: np.ndarray,
    *,
    names: Sequence[str] = (),
    name: str = "",
    colour: str = "",
    fields: Mapping[str, Any] | None = None,
) -> Rods:
    """Validates a user's arrays, and returns them as a group of rods.

    Arguments are those of `Replay.from_nodes`; `names` are its `rod_names`.
    """
    nodes = numbers("positions", positions, "m")
    if nodes.ndim == 3:
        nodes = nodes[:, None]
    if nodes.ndim != 4 or nodes.shape[-1] != 3 or nodes.shape[2] < 2:
        raise ValueError(
            "positions must have shape (T, n+1, 3) or (T, R, n+1, 3) [m] with "
            f"at least 2 nodes, got {np.shape(positions)}"
        )
    num_frames, num_rods, num_nodes, _ = nodes.shape
    if num_frames == 0 or num_rods == 0:
        raise ValueError(
            f"positions must hold at least one frame and one rod, got {nodes.shape}"
        )
    if num_frames != len(times):
        raise ValueError(
            f"positions must have {len(times)} frames, one per time, got {num_frames}"
        )
    require_finite("positions", nodes, "m", times)
    if names and len(names) != num_rods:
        raise ValueError(
            f"rod_names must be empty or hold {num_rods} names, got {len(names)}"
        )
    return Rods(
        positions=nodes,
        radii=checked_radii(radii, num_rods, num_nodes - 1),
        name=str(name),
        names=tuple(str(name) for name in names),
        colour=checked_colour(colour),
        fields={
            str(label): checked_field(str(label), values, nodes.shape[:3])
            for label, values in (fields or {}).items()
        },
    )


def checked_radii(radii: Any, num_rods: int, num_elements: int) -> np.ndarray:
    """Radii broadcast to shape (R, n); raises a ValueError if invalid."""
    values = numbers("radii", radii, "m")
    if values.shape not in ((), (num_elements,), (num_rods, num_elements)):
        raise ValueError(
            f"radii must have shape ({num_elements},) or ({num_rods}, {num_elements}) "
            f"[m], got {values.shape}"
        )
    require_finite("radii", values, "m")
    if values.min() <= 0:
        raise ValueError(f"radii must be positive, got {values.min():g} m")
    return np.broadcast_to(values, (num_rods, num_elements)).copy()


def checked_field(label: str, values: Any, shape: tuple[int, int, int]) -> np.ndarray:
    """Validates a field, and returns it interpolated to the nodes, (T, R, n+1).

    Args:
        label: Name of the field, for the error message.
        values: Numbers that are broadcastable to (T, R, k), with k nodes, elements or
            inner joints of a rod; or one number per rod.
        shape: Numbers of frames, rods and nodes: (T, R, n+1).
    """
    frames, rods, nodes = shape
    given = numbers(f"fields[{label!r}]", values, "-")
    if given.ndim == 0 or given.shape[-1] not in (nodes, nodes - 1, nodes - 2):
        given = given[..., None]
    if rods == 1 and given.ndim == 2:
        given = given[:, None]
    along = given.shape[-1]
    try:
        whole = np.broadcast_to(given, (frames, rods, along)).astype(float)
    except ValueError:
        raise ValueError(
            f"fields[{label!r}] must broadcast to ({frames}, {rods}, n) with n = "
            f"{nodes}, {nodes - 1} or {nodes - 2}: frames, rods and nodes, elements or "
            f"joints; got {np.shape(values)}"
        ) from None
    if along == nodes:
        return whole
    if along == nodes - 1:
        return at_nodes(whole)
    if along == nodes - 2:
        return np.pad(whole, ((0, 0), (0, 0), (1, 1)), mode="edge")
    return np.repeat(whole, nodes, axis=-1)


def at_nodes(of_elements: np.ndarray) -> np.ndarray:
    """Averages n element values to n+1 node values along the last axis.

    An inner node gets the mean of its two elements, an end node the value of its only
    element.
    """
    padded = np.concatenate(
        [of_elements[..., :1], of_elements, of_elements[..., -1:]], -1
    )
    return (padded[..., 1:] + padded[..., :-1]) / 2
