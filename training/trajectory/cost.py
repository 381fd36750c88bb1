r"""The cost of a trajectory, as a differentiable function of its knots.

The problem is that of `jaxrod.control.reach`. Control values run linearly between
knots and are held over a control interval at their value in its middle, while the rod
is stepped many times.

Every control interval is checkpointed, so reverse mode keeps one state per interval
and the steps of one interval at a time.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod import RodState
from jaxrod.control import ActuatedArm, Problem, Reach
from jaxrod.control.problem import over_time, run, squares, trajectory
from jaxrod.structure import pytree


@pytree
class TrajectoryProblem:
    """An arm, a target, and what a trajectory costs."""

    control: Problem
    """The same as a problem of `jaxrod.control`."""

    @property
    def reach(self) -> Reach:
        """Its data."""
        data: Reach = self.control.data
        return data

    @property
    def arm(self) -> ActuatedArm:
        """The arm."""
        arm: ActuatedArm = self.reach.arm
        return arm

    @property
    def target(self) -> Float[Array, "3"]:
        """Target position of the tip at the end [m]."""
        return self.reach.target

    @property
    def dt(self) -> Float[Array, ""]:
        """Step of the simulation [s]."""
        return self.reach.dt

    @property
    def n_intervals(self) -> int:
        """Control intervals."""
        return self.control.n_intervals

    @property
    def steps_per_interval(self) -> int:
        """Simulation steps in each."""
        return self.reach.steps_per_interval

    @property
    def duration(self) -> Float[Array, ""]:
        """Time from start to end [s]."""
        return self.dt * (self.n_intervals * self.steps_per_interval)


@pytree
class TrajectoryCost:
    """Cost of a trajectory, and the tip at its end."""

    loss: Float[Array, ""]
    """The sum that is minimised [m^2]."""
    tip_distance: Float[Array, ""]
    """Distance of the tip from the target at the end [m]."""
    tip_speed: Float[Array, ""]
    """Speed of the tip at the end [m/s]."""


def controls_over_time(
    knots: Float[Array, "n_knots directions n_controls"], n_intervals: int
) -> Float[Array, "n_intervals directions n_controls"]:
    """Control values in the middle of every control interval.

    Linear between the knots, which are equally spaced from start to end.
    """
    flat = over_time(knots.reshape(knots.shape[0], -1), n_intervals)
    return flat.reshape(n_intervals, *knots.shape[1:])


def trajectory_cost(
    problem: TrajectoryProblem, knots: Float[Array, "n_knots directions n_controls"]
) -> TrajectoryCost:
    """Simulates the arm under given knots. Differentiable, also in the problem."""
    control = problem.control
    along, last = run(control, _controls(problem, knots))
    assert control.final is not None
    loss = squares((along, control.final(control.data, last)))
    square = jnp.sum((last.tip - problem.target) ** 2)
    speed_square = jnp.sum(last.velocities[:, -1] ** 2)
    return TrajectoryCost(loss, jnp.sqrt(square), jnp.sqrt(speed_square))


@jax.jit
def cost_and_gradient(
    problem: TrajectoryProblem, knots: Float[Array, "n_knots directions n_controls"]
) -> tuple[TrajectoryCost, Float[Array, "n_knots directions n_controls"]]:
    """The cost and the gradient of its loss with respect to the knots."""

    def loss(knots: Array) -> tuple[Array, TrajectoryCost]:
        cost = trajectory_cost(problem, knots)
        # The distances are reported, not differentiated: a root has no slope at zero.
        return cost.loss, lax.stop_gradient(cost)

    gradient, cost = jax.grad(loss, has_aux=True)(knots)
    return cost, gradient


@jax.jit
def record_trajectory(
    problem: TrajectoryProblem, knots: Float[Array, "n_knots directions n_controls"]
) -> RodState:
    """The states at the start and after every control interval, stacked in front."""
    states: RodState = trajectory(problem.control, _controls(problem, knots))
    return states


def _controls(problem: TrajectoryProblem, knots: Array) -> Array:
    """Controls of all intervals, one after the other."""
    return over_time(knots.reshape(knots.shape[0], -1), problem.n_intervals)
