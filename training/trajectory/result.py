"""Result and history of a trajectory optimisation."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxrod import RodState
from jaxrod.control.descent import Ending
from jaxrod.training.trajectory.cost import TrajectoryProblem

Reason = Ending


@dataclasses.dataclass(frozen=True, eq=False)
class TrajectoryHistory:
    """History with one entry per gradient step, in arrays of shape (n_steps,)."""

    loss: np.ndarray
    """Loss that is minimised [m^2]."""
    tip_distance: np.ndarray
    """Distance of the tip from the target at the end [m]."""
    tip_speed: np.ndarray
    """Speed of the tip at the end [m/s]."""
    gradient_norm: np.ndarray
    """Norm of the loss gradient with respect to the knots, before clipping [m^2]."""
    wall_s: np.ndarray
    """Time since the start, including compilation [s]."""


@dataclasses.dataclass(frozen=True, eq=False)
class TrajectoryResult:
    """Result of an optimisation, with its history."""

    knots: Float[Array, "n_knots directions n_controls"]
    """Control values in [-1, 1], linear in time between knots."""
    knot_times: Float[np.ndarray, " n_knots"]
    """Times of the knots [s]."""
    controls: Float[Array, "n_intervals directions n_controls"]
    """Control values held over each control interval."""
    times: Float[np.ndarray, "n_intervals+1"]
    """Ends of the control intervals, from 0 [s]."""
    states: RodState
    """Recorded motion: a state for each of `times`, along a new first axis."""
    tip_distance: float
    """Distance of the tip from the target at the end of the recorded motion [m]."""
    tip_speed: float
    """Speed of the tip at the end of the recorded motion [m/s]."""
    success: bool
    """Whether the recorded motion ends within the tolerances."""
    reason: Reason
    """Reason why the optimisation stopped."""
    iterations: int
    """Number of gradient steps."""
    history: TrajectoryHistory
    """Losses, tip distances and speeds of all gradient steps."""
    problem: TrajectoryProblem
    """The problem that was optimised."""
    compile_s: float
    """Time to the first loss [s]: compilation, unless the program is in memory."""
    wall_s: float
    """Time from start to end, including compilation [s]."""

    @property
    def tip_positions(self) -> Float[Array, "n_intervals+1 3"]:
        """The path of the tip [m]."""
        return self.states.positions[:, :, -1]

    def replay(self, title: str = "Optimised trajectory") -> Any:
        """The motion with the target, as a `jaxrod.viz.Replay`."""
        from jaxrod.viz import Replay, Sphere

        target = np.asarray(self.problem.target, float)
        apart = np.linalg.norm(np.asarray(self.tip_positions, float) - target, axis=1)
        return Replay.from_rollout(
            self.states.positions,
            self.problem.arm.scene.rod.radii,
            self.times,
            spheres=[Sphere(target, 0.02)],
            readouts={"distance [m]": apart},
            title=title,
            up="y",
        )
