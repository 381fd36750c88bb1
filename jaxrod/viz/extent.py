"""The bounding box of a replay."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxrod.viz.meshes import Mesh
from jaxrod.viz.rods import Rods
from jaxrod.viz.shapes import Cylinder, Sphere

_EVERY = 8
"""Stride of the frames at which turning bodies are checked."""


def extent(
    rods: Sequence[Rods],
    meshes: Sequence[Mesh] = (),
    spheres: Sequence[Sphere] = (),
    cylinders: Sequence[Cylinder] = (),
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Corners of the box that contains everything in every frame [m]."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for some in rods:
        margin = float(some.radii.max())
        low = np.minimum(low, some.positions.min(axis=(0, 1, 2)) - margin)
        high = np.maximum(high, some.positions.max(axis=(0, 1, 2)) + margin)
    for mesh in meshes:
        last = len(mesh.positions) - 1
        for frame in {0, *range(0, last, _EVERY), last}:
            for body in range(mesh.count):
                corners = mesh.placed(frame, body)
                low = np.minimum(low, corners.min(axis=0))
                high = np.maximum(high, corners.max(axis=0))
    for sphere in spheres:
        low = np.minimum(low, sphere.positions.min(axis=0) - sphere.radius)
        high = np.maximum(high, sphere.positions.max(axis=0) + sphere.radius)
    for cylinder in cylinders:
        for end in (cylinder.start, cylinder.end):
            low = np.minimum(low, end - cylinder.radius)
            high = np.maximum(high, end + cylinder.radius)
    if not np.isfinite(low).all():
        return -np.ones(3), np.ones(3)
    return low, high
