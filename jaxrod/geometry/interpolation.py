"""Linear interpolation along a rod, on the host."""

from __future__ import annotations

import numpy as np


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
