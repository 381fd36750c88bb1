"""Interpolation of plans between knots, and their shift in time, as constant matrices.

A plan has a value now and `knots` values at equal distances ahead. Between them it has
one of `SHAPES`: `"lines"` from value to value, or `"steps"`, where every knot's value
is held from the time of the previous one. After the last knot the plan is constant.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SHAPES = ("lines", "steps")


def weights_at(
    times: Float[np.ndarray, " times"], knots: int, spacing: int, shape: str = "lines"
) -> Float[np.ndarray, "times knots_and_now"]:
    """Returns weights of the value now and of the knots, a row for each time.

    Args:
        times: Times in the unit of `spacing`, not negative. At the time where a step
            changes its value, the plan still has the earlier value.
        knots: Number of knots; they lie at `spacing`, `2 spacing` and so on.
        spacing: Time between two knots.
        shape: One of `SHAPES`.
    """
    place = np.minimum(np.asarray(times, float) / spacing, knots)
    if shape == "steps":
        place = np.ceil(place)
    corners = np.arange(knots + 1)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - corners[None, :]))


def piece_weights(
    knots: int, spacing: int, hold: int, shape: str = "lines"
) -> Float[np.ndarray, "pieces knots_and_now"]:
    """Returns weights of a plan's pieces, at their midpoints, each `hold` long."""
    pieces = knots * spacing // hold
    return weights_at((np.arange(pieces) + 0.5) * hold, knots, spacing, shape)


def shift_weights(
    knots: int, spacing: int, by: int, shape: str = "lines"
) -> Float[np.ndarray, "knots_and_now knots_and_now"]:
    """Returns weights of the plan's value and knots after a shift in time by `by`.

    For steps whose times no longer coincide, the later step is taken.
    """
    return weights_at(by + spacing * np.arange(knots + 1), knots, spacing, shape)
