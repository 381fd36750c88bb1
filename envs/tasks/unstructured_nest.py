"""Case 4 of the benchmark: an arm through a nest of twelve cylinders at random angles.

The cylinders are 3 cm in radius; the arm moves in space. See
`jaxrod.envs.tasks.obstacle_task` for what this task has in common with Case 3. The
nest is the published one, or is drawn from a seed as the released generator draws it.
It is the same in all episodes.

Variants:

- `"paper"`: the published environment in every detail, so that scores compare. Contact
  follows the published law (`jaxrod.envs.published.contact`). The observed points of an
  obstacle start at the arm's base instead of at the obstacle, as published: so its
  position is not observed. A number that is not finite costs 100 and ends the episode.
- `"clean"`: the same task with the library's own physics, see `jaxrod.envs.arm.clean`.
  Obstacles are observed at their true positions. When a numerical health flag rises the
  arm is frozen and the episode truncated.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body, Capsule
from jaxrod.envs.arm.cylinders import Cylinders
from jaxrod.envs.arm.nest import COUNT, TARGET_HEIGHT, published_nest, random_nest
from jaxrod.envs.tasks.obstacle_task import (
    BASE,
    CONTROL_STEPS,
    PLACED,
    ObstacleTask,
    Variant,
    checked_sizes,
)
from jaxrod.validation import Numbers, check_count


@dataclasses.dataclass(frozen=True)
class UnstructuredNest(ObstacleTask):
    """The task; see the module docstring. Make one with `unstructured_nest`."""

    nest: int | None = None
    """Seed of the nest; `None` for the published nest."""

    n_directions = 2
    n_obstacles = COUNT
    target_position = (-0.8, 0.5, TARGET_HEIGHT)
    plane = None
    contact_points = 2
    """Contact points per element. When the arm is stretched twofold its nodes are 5 cm
    apart. A thin cylinder between two of them would push them further apart."""
    nearest_obstacles = 4
    """Number of nearest obstacles kept per point of the arm. Few points have a fifth
    cylinder within the arm's radius. An arm that gets there, or moves several
    centimetres in a control step, may meet it one control step too late."""

    @property
    def name(self) -> str:
        """Name of the task, as in the registry."""
        return "unstructured"

    @property
    def n_controls(self) -> int:
        """Number of control points per direction."""
        return len(PLACED)

    def control_points(self) -> Numbers:
        """Arc lengths of the control points [m]."""
        return PLACED

    def obstacles(self) -> Cylinders:
        """The nest."""
        return published_nest() if self.nest is None else random_nest(self.nest)

    def bodies(self, obstacles: Cylinders) -> Body:
        """The nest as capsules: the published contact also has round ends."""
        return Capsule(obstacles.starts.T, obstacles.ends.T, obstacles.radii)

    def observed_starts(self, obstacles: Cylinders) -> Float[Array, "3 m"]:
        """Starts of the cylinders; in "paper" the arm's base for each of them."""
        if self.variant == "clean":
            return obstacles.starts
        base = jnp.asarray(BASE, obstacles.starts.dtype)
        return jnp.broadcast_to(base[:, None], obstacles.starts.shape)


def unstructured_nest(
    variant: Variant = "paper",
    *,
    nest: int | None = None,
    n_elements: int | None = None,
    substeps: int | None = None,
    episode_length: int = CONTROL_STEPS,
) -> UnstructuredNest:
    """Makes the task.

    Args:
        variant: "paper" or "clean".
        nest: Seed of a random nest; by default the published nest.
        n_elements: Elements of the arm, a multiple of 10; by default 50 in "paper"
            and 40 in "clean".
        substeps: Simulation steps per control step of 1.4 ms; by default 14 in
            "paper" and 13 in "clean".
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    elements, steps = checked_sizes(variant, n_elements, substeps, episode_length)
    if nest is not None:
        nest = check_count("nest", nest, 0)
    return UnstructuredNest(variant, elements, steps, episode_length, nest=nest)
