"""Places along a rod on the host, and interpolation from one grid to another."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.geometry.material_frames import module_for
from jaxrod.rods.rod import Rod


def interpolated(values: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Linear interpolation of the last axis, extrapolated beyond the ends.

    Args:
        values: Values at the old places `(..., m)`.
        old: Old places, increasing `(m,)`.
        new: New places `(k,)`.

    Returns:
        Values at the new places `(..., k)`.
    """
    values = values.astype(np.float64)
    if old.size == 1:
        return np.repeat(values, new.size, axis=-1)
    before, share = neighbours(old, new)
    return values[..., before] * (1 - share) + values[..., before + 1] * share


def neighbours(old: np.ndarray, new: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the old place before each new one, and the fraction to the next."""
    before = np.clip(np.searchsorted(old, new) - 1, 0, old.size - 2)
    return before, (new - old[before]) / (old[before + 1] - old[before])


def node_places(rod: Rod) -> Any:
    """Rest arc length from the start to every node [m], float64 unless traced."""
    xp = module_for(rod.rest_lengths)
    lengths = rod.rest_lengths if xp is jnp else np.asarray(rod.rest_lengths, float)
    return xp.concatenate([xp.zeros(1, lengths.dtype), xp.cumsum(lengths)])


def middle_places(rod: Rod) -> Any:
    """Rest arc length from the start to the middle of every element [m]."""
    places = node_places(rod)
    return 0.5 * (places[1:] + places[:-1])


def resampled_along(values: Array, old: Any, new: Any) -> Array:
    """Values along a rod (on the last axis), interpolated at other places.

    A single number for all places is returned unchanged.
    """
    if values.shape[-1] == 1:
        return values
    found = interpolated(np.asarray(values), np.asarray(old), np.asarray(new))
    return jnp.asarray(found, values.dtype)
