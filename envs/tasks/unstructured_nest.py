"""Case 4 of the benchmark: an arm reaches through a nest of twelve random cylinders.

The cylinders are 3 cm in radius, at random angles. The arm moves in space. See
`jaxrod.envs.tasks.obstacle_task` for what this task has in common with Case 3. The
nest is the published one, or is drawn from a seed as the released generator draws it.
It is the same in all episodes.

Variants:

- `"paper"`: the published environment in every detail, so that scores can be compared.
  Contact follows the published law (`jaxrod.envs.arm.published_contact`). As published,
  the observed points of an obstacle start at the arm's base instead of at the obstacle,
  so its position is not observed. A number that is not finite costs 100 and ends the
  episode.
- `"clean"`: the same task with the library's own physics, see `jaxrod.envs.arm.clean`.
  Obstacles are observed at their true positions. When a numerical health flag rises the
  arm is frozen and the episode truncated.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body, Capsule
from jaxrod.envs.arm.cylinders import Cylinders, cylinders
from jaxrod.envs.tasks.arm_task import Variant, checked_sizes
from jaxrod.envs.tasks.obstacle_task import (
    CONTROL_STEPS,
    PLACED,
    SIZES,
    ObstacleTask,
)
from jaxrod.validation import Numbers, check_count

LENGTH = 1.0
RADIUS = 0.03
COUNT = 12
TARGET_HEIGHT = 0.35
"""Coordinate z of the target, around which the generator places the cylinders [m]."""

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
    """Makes the nest of the published figure, with which the published scores agree."""
    numbers = np.array(_PUBLISHED.split(), float).reshape(COUNT, 3, 3)
    starts, directions, normals = numbers.swapaxes(0, 1)
    return cylinders(starts, directions, normals, length=LENGTH, radius=RADIUS)


def random_nest(seed: int) -> Cylinders:
    """Draws a nest like the published generator: centres in the plane y = 0.5 m.

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


@dataclasses.dataclass(frozen=True)
class UnstructuredNest(ObstacleTask):
    """Task of Case 4: an arm in a nest of cylinders; made by `unstructured_nest`."""

    nest: int | None = None
    """Seed of a random nest; `None` for the published nest."""

    name = "unstructured"
    n_directions = 2
    n_controls = len(PLACED)
    n_obstacles = COUNT
    target_position = (-0.8, 0.5, TARGET_HEIGHT)
    plane = None
    contact_points = 2
    """Number of contact points per element. When the arm is stretched twofold its nodes
    are 5 cm apart. With one point per element a thin cylinder between two of them would
    push them further apart."""
    nearest_obstacles = 4
    """Number of nearest cylinders that each contact point considers, chosen at the
    start of a control step. Few places in the nest have a fifth cylinder within the
    arm's radius. There, or if the arm moves several centimetres in a control step,
    contact may be noticed one control step late."""

    def control_points(self) -> Numbers:
        """Arc lengths of the control points [m]."""
        return PLACED

    def obstacles(self) -> Cylinders:
        """Makes the cylinders of the nest."""
        return published_nest() if self.nest is None else random_nest(self.nest)

    def bodies(self, obstacles: Cylinders) -> Body:
        """Capsules for the contact in the variant "clean", one for each cylinder.

        The published contact also has round ends.
        """
        return Capsule(obstacles.starts.T, obstacles.ends.T, obstacles.radii)

    def observed_starts(self, obstacles: Cylinders) -> Float[Array, "3 m"]:
        """Point at which each cylinder's observed points begin [m].

        It is the cylinder's start in "clean", and the arm's base in "paper".
        """
        if self.variant == "clean":
            return obstacles.starts
        base = jnp.asarray(self.base, obstacles.starts.dtype)
        return jnp.broadcast_to(base[:, None], obstacles.starts.shape)


def unstructured_nest(
    variant: Variant = "paper",
    *,
    nest: int | None = None,
    n_elements: int | None = None,
    substeps: int | None = None,
    episode_length: int = CONTROL_STEPS,
) -> UnstructuredNest:
    """Makes the task of Case 4; see the module docstring.

    Args:
        variant: "paper" or "clean".
        nest: Seed of a random nest; by default the published nest.
        n_elements: Elements of the arm, a multiple of 10; by default 50 in "paper"
            and 40 in "clean".
        substeps: Simulation steps per control step of 1.4 ms; by default 14 in
            "paper" and 13 in "clean", or more for more elements than usual.
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    elements, steps = checked_sizes(
        variant, SIZES, n_elements, substeps, episode_length
    )
    if nest is not None:
        nest = check_count("nest", nest, 0)
    return UnstructuredNest(variant, elements, steps, episode_length, nest=nest)
