"""An arm with muscles: a scene, its initial state, and the muscles' actuation."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.actuation import ControlSpline, ElementAverages, spline_couples
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.structure import pytree


@pytree
class ActuatedArm:
    """A scene, its initial state, and the muscles that are added to it.

    Make one from any scene of one rod: `ActuatedArm(scene, state, spline,
    couple_density)`. `jaxrod.envs.actuated_arm` makes the benchmark's arm.
    """

    scene: Scene
    """The rod and everything that acts on it except its muscles."""
    state: RodState
    """Initial state."""
    spline: ControlSpline | ElementAverages
    """Shape of the muscle couples along the rod, from `control_spline`."""
    couple_density: Float[Array, ""]
    """Couple per unit rest length at a control value of one [N m/m]."""

    @property
    def control_shape(self) -> tuple[int, int]:
        """Shape of the controls that bend the arm: two directions, points along it."""
        return 2, self.spline.n_controls

    @property
    def prepared(self) -> ActuatedArm:
        """The same arm, its spline averaged over the elements once for all controls."""
        if isinstance(self.spline, ElementAverages):
            return self
        averages = self.spline.averaged(self.scene.rod)
        return dataclasses.replace(self, spline=averages)

    def with_controls(self, controls: Float[Array, "directions n_controls"]) -> Scene:
        """Returns the scene with its muscles active.

        Args:
            controls: Control values [1] about d1 and d2 and, if there is a third
                row, d3 (twist).
        """
        missing = 3 - controls.shape[0]
        padded = jnp.pad(controls, ((0, missing), (0, 0)))
        muscles = spline_couples(
            self.scene.rod, self.spline, padded, self.couple_density
        )
        return dataclasses.replace(self.scene, effects=(*self.scene.effects, muscles))
