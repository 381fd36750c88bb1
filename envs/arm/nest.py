"""The nests of Case 4: twelve cylinders at random angles in front of the target."""

from __future__ import annotations

import numpy as np

from jaxrod.envs.arm.cylinders import Cylinders, cylinders
from jaxrod.validation import check_count

LENGTH = 1.0
RADIUS = 0.03
COUNT = 12
TARGET_HEIGHT = 0.35
"""Height z of the target; the released generator places the cylinders around it [m]."""

# Start, direction, normal of each cylinder, from the published figure of Case 4.
_PUBLISHED = """
-0.491883 0.872705 0.417081 -0.419161 -0.745410 -0.518331 0.468713 -0.666606 0.579607
-0.492705 0.876931 0.249509 -0.462854 -0.753862 -0.466324 0.531067 -0.657033 0.535048
-0.529425 0.927545 0.474854 -0.117778 -0.855089 -0.504926 0.194242 -0.518481 0.832735
-0.510665 0.897239 0.008958 -0.233819 -0.794479 0.560475 -0.305889 0.607292 0.733231
-0.423498 0.971995 0.617344 -0.135134 -0.943990 -0.301035 0.386590 -0.329975 0.861199
-0.282434 0.938554 0.401229 -0.181636 -0.951057 0.250000 -0.559017 0.309017 0.769421
-0.462430 0.868503 0.285311 -0.287665 -0.737006 0.611613 -0.313679 0.675886 0.666921
-0.447059 0.977018 0.530546 -0.045956 -0.954036 0.296146 -0.146297 0.299690 0.942753
-0.462750 0.954664 0.324748 -0.137927 -0.909328 0.392554 -0.301435 0.416080 0.857913
-0.432468 0.957789 0.324492 0.202580 -0.915578 -0.347388 -0.461225 -0.402141 0.790920
-0.800000 0.100000 0.700000 0.592974 0.309017 -0.743566 -0.192669 0.951057 0.241599
-0.700000 0.800000 0.800000 0.309017 0.000000 -0.951057 0.000000 1.000000 0.000000
"""


def published_nest() -> Cylinders:
    """The nest of the published figure; the published scores are consistent with it."""
    numbers = np.array(_PUBLISHED.split(), float).reshape(COUNT, 3, 3)
    starts, directions, normals = numbers.swapaxes(0, 1)
    return cylinders(starts, directions, normals, length=LENGTH, radius=RADIUS)


def random_nest(seed: int) -> Cylinders:
    """A nest as the released generator draws it: centres in the plane of the base.

    Args:
        seed: Seed of the nest; the same number gives the same nest everywhere.

    Raises:
        ValueError: If the seed is negative.
    """
    random = np.random.default_rng(check_count("nest", seed, 0))
    a, b = np.deg2rad(random.uniform(60, 120, (2, COUNT)))
    directions = np.stack([np.cos(a) * np.cos(b), -np.sin(a), np.cos(a) * np.sin(b)], 1)
    normals = np.stack([np.sin(a) * np.cos(b), np.cos(a), np.sin(a) * np.sin(b)], 1)
    x = random.uniform(-0.55, -0.40, COUNT)
    z = TARGET_HEIGHT + random.uniform(-0.5, 0.5, COUNT)
    starts = np.stack([x, 0.5 - 0.5 * LENGTH * directions[:, 1], z], 1)
    return cylinders(starts, directions, normals, length=LENGTH, radius=RADIUS)
