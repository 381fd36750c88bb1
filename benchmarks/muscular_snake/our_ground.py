"""Our law of the ground as a force on PyElastica's body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import jaxrod
from benchmarks.muscular_snake import scene
from jaxrod.rods.motion import motion_of


def our_ground(sinks: float, drag: float) -> Callable[[Any], None]:
    """Adds forces and couples of `scene.body_on_ground` to a rod of PyElastica.

    Args:
        sinks: As in `scene.ours`, and so is `drag`.
        drag: Drag of friction at the onset of slip.
    """
    body, of_body, ground = scene.body_on_ground(sinks, drag)

    @jax.jit
    def loads(positions: Any, velocities: Any, orientations: Any, spins: Any) -> Any:
        state = replace(
            of_body,
            positions=positions,
            velocities=velocities,
            orientations=orientations,
        )
        state = jaxrod.with_angular_velocities(body, state, spins)
        made = ground.loads(body, motion_of(state))
        return jnp.stack(made.forces), jnp.stack(made.couples)

    def act(rod: Any) -> None:
        # Rows of a matrix of theirs are directors, columns of a rotation.
        turns = Rotation.from_matrix(np.transpose(rod.director_collection, (2, 1, 0)))
        quaternions = np.roll(turns.as_quat(), 1, axis=1).T
        forces, couples = loads(
            rod.position_collection,
            rod.velocity_collection,
            quaternions,
            rod.omega_collection,
        )
        rod.external_forces += np.asarray(forces)
        rod.external_torques += np.asarray(couples)

    return act
