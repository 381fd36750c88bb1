r"""A vessel with three branches: a closed surface of triangles, made by code.

The trunk runs along x, from a closed end at x = -10 mm to the fork at x = 170 mm. Its
lumen is 12 mm wide. Three branches leave the fork at 35 degrees to the trunk, 120
degrees apart about it. Each is 9 mm wide and 60 mm long, measured along its axis. All
ends are round.

The surface is where a smooth distance is zero. With the distances $d_i$ of trunk and
branches it is $d = -w \ln \sum_i e^{-d_i/w}$, so the walls blend over the width $w$ of
1 mm, and the fork has no sharp edges.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod import shapes
from jaxrod.contacts.distance_grid import SignedDistanceGrid
from jaxrod.geometry.surfaces import Triangles, of_distance
from jaxrod.validation import knows_constants

BACK, FORK = -0.01, 0.17
"""Coordinates x of the trunk's closed end and of the fork [m]."""
LUMEN, BRANCH_LUMEN = 0.006, 0.0045
"""Radii of trunk and branches [m]."""
BRANCH_LENGTH = 0.06
"""Length of the axis of a branch, from the fork [m]."""
SPREAD = np.deg2rad(35.0)
"""Angle of each branch to the trunk [rad]."""
N_BRANCHES = 3
"""Number of branches."""
BLEND = 0.001
"""Width over which walls blend [m]."""
CELL, SPACING, MARGIN = 0.0025, 0.002, 0.002
"""Size of the mesh's triangles, distance of grid points, and margin of the grid [m]."""


def branch_directions() -> np.ndarray:
    """Unit vectors along the branches, from the fork (3, branches)."""
    about = 2 * np.pi * np.arange(N_BRANCHES) / N_BRANCHES
    along, across = np.full(N_BRANCHES, np.cos(SPREAD)), np.sin(SPREAD)
    return np.stack([along, across * np.cos(about), across * np.sin(about)])


def vessel_surface() -> Triangles:
    """Vertices (v, 3) [m] and triangles (f, 3) of the inner surface of the vessel."""
    fork = np.array([FORK, 0.0, 0.0])
    tubes = [(np.array([BACK, 0.0, 0.0]), fork, LUMEN)]
    for way in branch_directions().T:
        tubes.append((fork, fork + BRANCH_LENGTH * way, BRANCH_LUMEN))

    def surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distances, normals = [], []
        for start, end, radius in tubes:
            axis = end - start
            part = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
            out = points - start - part[:, None] * axis
            length = np.linalg.norm(out, axis=1)
            distances.append(length - radius)
            normals.append(out / np.maximum(length, 1e-12)[:, None])
        least = np.min(distances, axis=0)
        weights = np.exp((least - np.stack(distances)) / BLEND)
        total = np.sum(weights, axis=0)
        normal = np.sum(weights[:, :, None] * normals, axis=0) / total[:, None]
        return least - BLEND * np.log(total), normal

    reach = max(LUMEN, BRANCH_LUMEN) + 2 * BLEND
    low = np.min([np.minimum(start, end) for start, end, _ in tubes], axis=0) - reach
    high = np.max([np.maximum(start, end) for start, end, _ in tubes], axis=0) + reach
    return of_distance(surface, low, high, int(np.max(high - low) / CELL))


def vessel_wall() -> SignedDistanceGrid:
    """Everything outside of the vessel, as a body, in JAX's default precision."""
    kind = jnp.result_type(float)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, kind), _wall())


@functools.cache
@knows_constants
def _wall() -> SignedDistanceGrid:
    """The same with NumPy's arrays. It is made once, which takes seconds."""
    lumen = shapes.from_mesh(*vessel_surface(), spacing=SPACING, margin=MARGIN)
    wall: SignedDistanceGrid = jax.tree.map(np.asarray, lumen.complement())
    return wall
