"""Linear interpolation along a rod, on the host."""

from __future__ import annotations

import numpy as np


def interpolated(values: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Linear interpolation of the last axis, continued beyond the ends.

    Args:
        values: At the old places `(..., m)`.
        old: Increasing places `(m,)`.
        new: Places `(k,)`.

    Returns:
        At the new places `(..., k)`.
    """
    values = values.astype(np.float64)
    if old.size == 1:
        return np.repeat(values, new.size, axis=-1)
    before, share = neighbours(old, new)
    return values[..., before] * (1 - share) + values[..., before + 1] * share


def neighbours(old: np.ndarray, new: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each new place the old one before it, and how far on towards the next."""
    before = np.clip(np.searchsorted(old, new) - 1, 0, old.size - 2)
    return before, (new - old[before]) / (old[before + 1] - old[before])
