"""Scenery of a benchmark task: arm, target, obstacles."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import Rod, RodState
from jaxrod.envs.arm.cylinders import Cylinders
from jaxrod.envs.protocol import Snapshot


def arm_and_target(
    rod: Rod,
    arm: RodState,
    target: Float[Array, "3"],
    radius: Float[Array, ""],
    obstacles: Cylinders | None = None,
) -> Snapshot:
    """Snapshot of the arm, its target, and its obstacles.

    Args:
        rod: The arm's parameters.
        arm: The arm.
        target: Centre of the target [m].
        radius: Radius of the target [m].
        obstacles: Obstacles, if any.
    """
    cylinders: tuple[tuple[Array, Array, Array], ...] = ()
    if obstacles is not None:
        starts, ends = obstacles.starts.T, obstacles.ends.T
        cylinders = tuple(zip(starts, ends, obstacles.radii, strict=True))
    return Snapshot(
        positions=arm.positions,
        radii=rod.radii,
        spheres=((target, radius),),
        cylinders=cylinders,
        readouts={"distance to target [m]": jnp.sqrt(jnp.sum((arm.tip - target) ** 2))},
        up="y",
    )
