"""Conversion of user input to arrays, with clear errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def numbers(name: str, values: ArrayLike, unit: str) -> np.ndarray:
    """A private copy as a float64 array, or a clear error."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name} must be an array of numbers [{unit}], got {type(values).__name__}"
        ) from error


def require_finite(
    name: str, values: np.ndarray, unit: str, times: np.ndarray | None = None
) -> None:
    """Raises for NaN or infinity, with the place and time of the first one."""
    finite = np.isfinite(values)
    if finite.all():
        return
    where = tuple(int(i) for i in np.argwhere(~finite)[0])
    when = "" if times is None else f" (t = {times[where[0]]:g} s)"
    raise ValueError(
        f"{name} must be finite, got {values[where]} {unit} at index {where}{when}"
    )


def checked_times(times: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Times of frames [s], one per frame, or a clear error."""
    clock = numbers("times", times, "s")
    if clock.shape != shape:
        raise ValueError(
            f"times must have shape {shape} [s], one per frame, got {clock.shape}"
        )
    require_finite("times", clock, "s")
    backward = np.flatnonzero(np.diff(clock) <= 0)
    if backward.size:
        k = int(backward[0])
        raise ValueError(
            f"times must increase, got {clock[k]:g} s then {clock[k + 1]:g} s "
            f"at index {k + 1}"
        )
    return clock
