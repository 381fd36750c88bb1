r"""The cost of a trajectory, as a differentiable function of its knots.

Control values $u(t)$ run linearly between knots. They are held over a control
interval at their value in its middle, while the rod is stepped many times. With $d$
the distance of the tip from the target, $v$ the tip's speed and $T$ the end,

$$L = d(T)^2 + w_v\, v(T)^2 + w_r\, \overline{d^2} + w_u\, \overline{u^2}.$$

Every control interval is checkpointed, so reverse mode keeps one state per interval
and the steps of one interval at a time.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod import RodState, advance, stable_dt
from jaxrod.structure import pytree, static
from jaxrod.training.trajectory.actuated_arm import ActuatedArm


@pytree
class TrajectoryProblem:
    """An arm, a target, and what a trajectory costs. Numbers traced, counts static."""

    arm: ActuatedArm
    """The arm."""
    target: Float[Array, "3"]
    """Target position of the tip at the end [m]."""
    dt: Float[Array, ""]
    """Step of the simulation [s]."""
    speed_weight: Float[Array, ""]
    """Cost of the squared speed of the tip at the end [s^2]."""
    running_weight: Float[Array, ""]
    """Cost of the mean squared distance over time [1]."""
    effort_weight: Float[Array, ""]
    """Cost of the mean squared control value [m^2]."""
    n_intervals: int = static()
    """Control intervals."""
    steps_per_interval: int = static()
    """Simulation steps in each."""

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


_MOST_STEPS = 2**30
"""Steps are counted in 32 bits; twice as many may come of rounding up."""


def time_steps(
    arm: ActuatedArm, duration: float, control_interval: float, dt: float | None
) -> tuple[int, int, float]:
    """Cuts a duration into whole control intervals of whole steps.

    Args:
        arm: The arm, for its largest stable step.
        duration: Time from start to end [s].
        control_interval: For how long control values are held, at most [s].
        dt: Largest step of the simulation [s]; 0.8 of the stable one if None.

    Returns:
        Control intervals, steps in each, and the step [s].

    Raises:
        ValueError: there are more steps than can be counted.
    """
    largest = float(stable_dt(arm.scene).dt) if dt is None else dt
    in_all = duration / min(control_interval, largest)
    if not in_all < _MOST_STEPS:
        raise ValueError(
            f"duration must be less than {_MOST_STEPS:,} steps of the simulation, got "
            f"{duration:g} s, {in_all:.3g} steps"
        )
    # Forgive the last digit: 1 s in intervals of 0.01 s are 100, not 101.
    n_intervals = max(1, math.ceil(duration / control_interval * (1 - 1e-6)))
    steps = max(1, math.ceil(duration / n_intervals / largest * (1 - 1e-6)))
    return n_intervals, steps, duration / (n_intervals * steps)


def controls_over_time(
    knots: Float[Array, "n_knots directions n_controls"], n_intervals: int
) -> Float[Array, "n_intervals directions n_controls"]:
    """Control values in the middle of every control interval.

    Linear between the knots, which are equally spaced from start to end.
    """
    last = knots.shape[0] - 1
    place = (jnp.arange(n_intervals, dtype=knots.dtype) + 0.5) * (last / n_intervals)
    before = jnp.clip(jnp.floor(place).astype(int), 0, max(last - 1, 0))
    share = (place - before)[:, None, None]
    return (1 - share) * knots[before] + share * knots[jnp.minimum(before + 1, last)]


def trajectory_cost(
    problem: TrajectoryProblem, knots: Float[Array, "n_knots directions n_controls"]
) -> TrajectoryCost:
    """Simulates the arm under given knots. Differentiable, also in the problem."""

    def interval(state: RodState, controls: Array) -> tuple[RodState, Array]:
        after = _interval(problem, state, controls)
        return after, jnp.sum((after.tip - problem.target) ** 2)

    controls = controls_over_time(knots, problem.n_intervals)
    remembered = jax.checkpoint(interval, prevent_cse=False)
    state, squares = lax.scan(remembered, problem.arm.state, controls)
    square, speed_square = squares[-1], jnp.sum(state.velocities[:, -1] ** 2)
    loss = (
        square
        + problem.speed_weight * speed_square
        + problem.running_weight * jnp.mean(squares)
        + problem.effort_weight * jnp.mean(controls**2)
    )
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

    def interval(state: RodState, controls: Array) -> tuple[RodState, RodState]:
        after = _interval(problem, state, controls)
        return after, after

    controls = controls_over_time(knots, problem.n_intervals)
    start = problem.arm.state
    _, states = lax.scan(interval, start, controls)
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]), start, states
    )


def _interval(problem: TrajectoryProblem, state: RodState, controls: Array) -> RodState:
    scene = problem.arm.with_controls(controls)
    return advance(scene, state, problem.dt, problem.steps_per_interval)
