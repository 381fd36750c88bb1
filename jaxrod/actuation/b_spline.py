r"""Clamped uniform cubic B-splines: a shape along a rod from a few coefficients.

With $K$ coefficients there are $K - 3$ equal pieces. The first and the last coefficient
are the values at the ends. The curve passes near the others, not through them, and
never exceeds the largest of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array

from jaxrod.geometry.material_frames import module_for

DEGREE = 3


def b_spline_basis(count: int, places: Any) -> Array | np.ndarray:
    """Contribution of each coefficient at places along a rod.

    Args:
        count: Number of coefficients, at least 4.
        places: Places from 0 to 1 `(m,)`; slightly outside, the end pieces continue.

    Returns:
        The basis `(m, count)`, on the host unless the places are traced.
    """
    xp = module_for(places)
    inner = np.linspace(0.0, 1.0, count - DEGREE + 1)
    knots = np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])
    pieces = count - DEGREE
    piece = xp.clip(xp.floor(places * pieces).astype(int), 0, pieces - 1) + DEGREE
    # Cox-de Boor recursion.
    columns = [1.0 * (piece == k) for k in range(len(knots) - 1)]
    for degree in range(1, DEGREE + 1):
        rising = [
            _share(places - knots[k], knots[k + degree] - knots[k])
            for k in range(len(columns))
        ]
        columns = [
            rising[k] * columns[k] + (1 - rising[k + 1]) * columns[k + 1]
            for k in range(len(columns) - 1)
        ]
    return xp.stack(columns[:count], axis=-1)


def _share(part: Any, whole: float) -> Any:
    """Fraction `part / whole`; zero if `whole` is zero."""
    return part / whole if whole > 0 else 0 * part
