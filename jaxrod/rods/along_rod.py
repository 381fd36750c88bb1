"""Arc lengths of nodes and elements of a rod, and linear interpolation along it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.geometry.material_frames import module_for
from jaxrod.rods.rod import Rod


def interpolated(values: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Linear interpolation along the last axis, extrapolated beyond the ends.

    Args:
        values: Values at the old points `(..., m)`.
        old: Coordinates of the old points, increasing `(m,)`.
        new: Coordinates of the new points `(k,)`.

    Returns:
        Values at the new points `(..., k)`.
    """
    values = values.astype(np.float64)
    if old.size == 1:
        return np.repeat(values, new.size, axis=-1)
    before, share = neighbours(old, new)
    return values[..., before] * (1 - share) + values[..., before + 1] * share


def neighbours(old: np.ndarray, new: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the old point before each new point, and its fraction of the interval.

    The fraction is 0 at that old point and 1 at the next [1].
    """
    before = np.clip(np.searchsorted(old, new) - 1, 0, old.size - 2)
    return before, (new - old[before]) / (old[before + 1] - old[before])


def node_places(rod: Rod) -> Any:
    """Rest arc length from the base to every node [m], float64 unless traced."""
    xp = module_for(rod.rest_lengths)
    lengths = rod.rest_lengths if xp is jnp else np.asarray(rod.rest_lengths, float)
    return xp.concatenate([xp.zeros(1, lengths.dtype), xp.cumsum(lengths)])


def middle_places(rod: Rod) -> Any:
    """Rest arc length from the base to the middle of every element [m]."""
    places = node_places(rod)
    return 0.5 * (places[1:] + places[:-1])


def resampled_along(values: Array, old: Any, new: Any) -> Array:
    """Values on the last axis, interpolated from arc lengths `old` to `new` [m].

    A last axis with a single value, which is for the whole rod, is returned unchanged.
    """
    if values.shape[-1] == 1:
        return values
    found = interpolated(np.asarray(values), np.asarray(old), np.asarray(new))
    return jnp.asarray(found, values.dtype)
