"""Number of contact points that elements need, from their lengths and radii."""

from __future__ import annotations

import math

import numpy as np

from jaxrod.systems.parts import Parts
from jaxrod.validation import is_traced


def points_needed(coupling: str, name: str, own: Parts, spacing: float) -> int:
    """Points per element for which neighbours are at most some radii apart.

    Args:
        coupling: Name of the factory, for messages.
        name: Name of the member.
        own: Constants of the member.
        spacing: Largest distance between neighbours over the radius [1].

    Raises:
        ValueError: If lengths or radii are traced.
    """
    if is_traced(own.rest_lengths, own.radii):
        raise ValueError(
            f"{coupling}: of {name!r} the lengths or radii are traced: give "
            "points_per_element"
        )
    ratio = np.asarray(own.rest_lengths) / np.asarray(own.radii)
    return max(1, math.ceil(float(np.max(ratio)) / spacing - 1e-6))
