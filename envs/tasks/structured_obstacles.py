"""Case 3 of the benchmark: a planar arm reaches through a maze of eight cylinders.

The cylinders are 0.1 m in radius, parallel to y, and leave gaps of 0.12 m between them
and before the target. The arm, 0.1 m thick, bends in the plane y = 0.5 m only. See
`jaxrod.envs.tasks.obstacle_task` for what this task has in common with Case 4.

Variants:

- `"paper"`: the published environment in every detail, so that scores can be compared.
  Contact follows the published law, broad phase included
  (`jaxrod.envs.arm.published_contact`): an obstacle is ignored until the arm's bounding
  box, padded by 7 cm, reaches its axis. A number that is not finite costs 100 and ends
  the episode.
- `"clean"`: the same task with the library's own physics, in the plane only, see
  `jaxrod.envs.arm.clean`; the arm is in contact where it overlaps a cylinder. When a
  numerical health flag rises the arm is frozen and the episode truncated.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body, Sphere
from jaxrod.envs.arm.cylinders import Cylinders, cylinders
from jaxrod.envs.tasks.arm_task import Variant, checked_sizes
from jaxrod.envs.tasks.obstacle_task import (
    CONTROL_STEPS,
    PLACED,
    SIZES,
    ObstacleTask,
)
from jaxrod.validation import Numbers, check_count

AXES = (
    (-0.6, 0.12),
    (-0.2, 0.12),
    (-0.4, 0.37),
    (-0.4, 0.00),
    (-0.4, -0.20),
    (-0.4, -0.40),
    (-0.4, 0.57),
    (-0.4, 0.77),
)
"""Coordinates x and z of the cylinders' axes [m]."""
RADIUS = 0.1
CYLINDER_LENGTH = 1.0


@dataclasses.dataclass(frozen=True)
class StructuredObstacles(ObstacleTask):
    """Task of Case 3: a planar arm in a maze; made by `structured_obstacles`."""

    controls: int | None = None
    """Number of equidistant control points; `None` for the two points of the paper, at
    0.4 m and 0.9 m."""

    name = "structured"
    n_directions = 1
    n_obstacles = len(AXES)
    target_position = (-0.8, 0.5, 0.15)
    plane = "zx"
    contact_points = 1
    nearest_obstacles = 3
    """Number of nearest cylinders that each contact point of the arm considers, chosen
    at the start of a control step. No point is nearer than 10 cm to a fourth cylinder.
    The arm, 5 cm in radius, would touch it only if the point moved 5 cm in the step."""

    @property
    def n_controls(self) -> int:
        """Number of control points along the arm."""
        return len(PLACED) if self.controls is None else self.controls

    def control_points(self) -> int | Numbers:
        """Number of equidistant control points, or their arc lengths [m]."""
        return PLACED if self.controls is None else self.controls

    def obstacles(self) -> Cylinders:
        """Makes the cylinders of the maze.

        As published, their normals are parallel to their axes, which is a mistake.
        """
        x, z = np.array(AXES).T
        along = np.tile([0.0, 1.0, 0.0], (len(AXES), 1))
        starts = np.stack([x, np.zeros_like(x), z], 1)
        return cylinders(starts, along, along, length=CYLINDER_LENGTH, radius=RADIUS)

    def bodies(self, obstacles: Cylinders) -> Body:
        """Spheres for the contact in the variant "clean", one for each cylinder.

        In the plane of motion, sphere and cylinder are the same circle.
        """
        return Sphere(obstacles.centres.T, obstacles.radii)

    def observed_starts(self, obstacles: Cylinders) -> Float[Array, "3 m"]:
        """Start of each cylinder, at which its observed points begin [m]."""
        return obstacles.starts


def structured_obstacles(
    variant: Variant = "paper",
    *,
    controls: int | None = None,
    n_elements: int | None = None,
    substeps: int | None = None,
    episode_length: int = CONTROL_STEPS,
) -> StructuredObstacles:
    """Makes the task of Case 3; see the module docstring.

    Args:
        variant: "paper" or "clean".
        controls: Number of equidistant control points; the paper's supplement has 2, 4,
            6 and 8. The default is the two points of its main text, at 0.4 and 0.9 m.
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
    if controls is not None:
        controls = check_count("controls", controls, 2)
    return StructuredObstacles(
        variant, elements, steps, episode_length, controls=controls
    )
