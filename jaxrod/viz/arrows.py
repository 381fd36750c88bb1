"""Arrows in a replay, such as forces or velocities."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxrod.viz.arrays import numbers, require_finite
from jaxrod.viz.rods import checked_colour

MOST = 400
"""Largest number of arrows of one kind; of more, the longest are drawn."""
_SHORTEST = 0.02
"""Smallest length of a drawn arrow, relative to the longest [1]."""


@dataclasses.dataclass(frozen=True, eq=False)
class Arrows:
    """A arrows over T frames."""

    origins: Float[np.ndarray, "num_frames a 3"]
    """Starting points [m], shape (T, A, 3)."""
    vectors: Float[np.ndarray, "num_frames a 3"]
    """Vectors to show, for example forces [N], shape (T, A, 3)."""
    name: str = "force [N]"
    """Name and unit in the legend."""
    length: float | None = None
    """Length of the longest arrow [m]; `None` for a seventh of the scene."""
    colour: str = "#d62f5b"
    """Colour as "#rrggbb"."""

    def at_frames(self, keep: Any) -> Arrows:
        """A copy with some of the frames."""
        return dataclasses.replace(
            self, origins=self.origins[keep], vectors=self.vectors[keep]
        )

    @property
    def largest(self) -> float:
        """Largest size of a vector in any frame, in its own unit."""
        return float(np.linalg.norm(self.vectors, axis=-1).max(initial=0.0))

    def drawn(self, size: float) -> tuple[np.ndarray, float]:
        """The vectors as lengths [m], invisibly short ones as zero, and the scale.

        Args:
            size: Size of the scene [m].
        """
        longest = size / 7 if self.length is None else self.length
        scale = longest / (self.largest or 1.0)
        lengths = np.linalg.norm(self.vectors, axis=-1, keepdims=True) * scale
        return np.where(lengths >= _SHORTEST * longest, self.vectors * scale, 0), scale


def checked_arrows(index: int, arrows: Arrows, times: np.ndarray) -> Arrows:
    """A checked copy of arrows, without those that are always too short."""
    name = f"arrows[{index}]"
    vectors = numbers(f"{name}.vectors", arrows.vectors, "-")
    origins = numbers(f"{name}.origins", arrows.origins, "m")
    if vectors.ndim != 3 or vectors.shape[0] != len(times) or vectors.shape[2] != 3:
        raise ValueError(
            f"{name}.vectors must have shape ({len(times)}, a, 3), got {vectors.shape}"
        )
    try:
        origins = np.broadcast_to(origins, vectors.shape).copy()
    except ValueError:
        raise ValueError(
            f"{name}.origins must have shape {vectors.shape} [m], got {origins.shape}"
        ) from None
    require_finite(f"{name}.vectors", vectors, "-", times)
    require_finite(f"{name}.origins", origins, "m", times)
    if arrows.length is not None and not 0 < arrows.length < np.inf:
        raise ValueError(f"{name}.length must be positive, got {arrows.length} m")
    peaks = np.linalg.norm(vectors, axis=-1).max(axis=0, initial=0.0)
    seen = np.flatnonzero(peaks > _SHORTEST * peaks.max(initial=0.0))
    seen = np.sort(seen[np.argsort(-peaks[seen], kind="stable")][:MOST])
    return Arrows(
        origins[:, seen],
        vectors[:, seen],
        str(arrows.name),
        arrows.length,
        checked_colour(arrows.colour),
    )
