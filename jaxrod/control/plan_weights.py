"""Plans between knots, as constant matrices: of what is acted, and of shifts.

A plan has a value now and `knots` values at equal distances ahead. Between them it is
one of `SHAPES`: `"lines"` from value to value, or `"steps"`, where every knot's value
is held from the time of the one before. After the last one it stays.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SHAPES = ("lines", "steps")


def weights_at(
    times: Float[np.ndarray, " times"], knots: int, spacing: int, shape: str = "lines"
) -> Float[np.ndarray, "times knots_and_now"]:
    """Rows that make values at these times of the value now and of the knots.

    Args:
        times: In the unit of `spacing`, not negative. Where a step changes its value
            it is still the one before.
        knots: Their number; they lie at `spacing`, `2 spacing` and so on.
        spacing: Time between two.
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
    """Values of the pieces of a plan, in their middles, each held `hold` long."""
    pieces = knots * spacing // hold
    return weights_at((np.arange(pieces) + 0.5) * hold, knots, spacing, shape)


def shift_weights(
    knots: int, spacing: int, by: int, shape: str = "lines"
) -> Float[np.ndarray, "knots_and_now knots_and_now"]:
    """The value and knots of the plan as it is seen `by` later.

    Of steps that no longer fall together the later one is taken.
    """
    return weights_at(by + spacing * np.arange(knots + 1), knots, spacing, shape)
