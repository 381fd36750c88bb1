r"""The reaching problem: bring the tip of an arm to a target, at rest, in a given time.

With $d$ the distance of the tip from the target, $v$ its speed, $u$ the control values
and $T$ the final time,

$$L = d(T)^2 + w_v\, v(T)^2 + w_r\, \overline{d^2} + w_u\, \overline{u^2}.$$
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.analysis.stability import stable_dt
from jaxrod.control.trajectories.problem import Problem, make_problem
from jaxrod.effects.actuation import ControlSpline, ElementAverages, spline_couples
from jaxrod.geometry import vectors
from jaxrod.model import TimeStep
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.stepping.runs import advance, check_step, with_memory
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, check_array, check_time_step, warn


class UnreachableTargetWarning(UserWarning):
    """Warns that the target is farther from the arm's base than the arm is long."""


class Arm(Protocol):
    """A pytree that makes a scene from controls, such as `ActuatedArm`."""

    @property
    def scene(self) -> Scene:
        """Scene of the arm without controls."""

    @property
    def state(self) -> RodState:
        """Initial state of the arm."""

    def with_controls(self, controls: Any) -> Scene:
        """Returns the scene of the arm under controls."""


@pytree
class ActuatedArm:
    """A scene, its initial state, and the muscles that are added to it.

    Make one from any scene of one rod: `ActuatedArm(scene, state, spline,
    couple_density)`. `jaxrod.envs.actuated_arm` makes the benchmark's arm.

    Example:
        >>> arm = envs.actuated_arm(10, n_controls=4)
        >>> arm.control_shape, type(arm.state).__name__
        ((2, 4), 'RodState')
    """

    scene: Scene
    """The rod and everything that acts on it except its muscles."""
    state: RodState
    """Initial state of the rod."""
    spline: ControlSpline | ElementAverages
    """Shape of the muscle couples along the rod, from `control_spline`."""
    couple_density: Float[Array, ""]
    """Couple per unit rest length at a control value of one [N m/m]."""

    @property
    def control_shape(self) -> tuple[int, int]:
        """Shape (2, n_controls): controls about d1 and d2, at points along the arm."""
        return 2, self.spline.n_controls

    @property
    def prepared(self) -> ActuatedArm:
        """Copy of the arm whose spline is averaged over the elements in advance."""
        averages = self.spline.averaged(self.scene.rod)
        return replace(self, spline=averages)

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
        return replace(self.scene, effects=(*self.scene.effects, muscles))


@pytree
class Reach:
    """Data of a reaching problem made by `reach`: arm, target, weights and steps.

    Example:
        >>> arm = envs.actuated_arm(10)
        >>> problem = control.reach(arm, (0.3, 0.8, 0.0), duration=0.1, dt=1e-3)
        >>> problem.data.control_shape, problem.data.steps_per_interval
        ((2, 6), 10)
    """

    arm: Any
    """The arm, such as an `ActuatedArm`."""
    target: Float[Array, "3"]
    """Target position of the tip at the end [m]."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    speed_root: Float[Array, ""]
    """Square root of the weight on the squared speed of the tip at the end [s]."""
    running_root: Float[Array, ""]
    """Square root of the weight on the mean squared distance over time [1]."""
    effort_root: Float[Array, ""]
    """Square root of the weight on the mean squared control value [m]."""
    steps_per_interval: int = static()
    """Number of time steps of the simulation in an interval."""
    n_intervals: int = static()
    """Number of control intervals, over which means are taken."""
    control_shape: tuple[int, ...] = static()
    """Shape of the controls that the arm takes."""

    @property
    def scene(self) -> Scene:
        """The arm's scene, without controls."""
        return self.arm.scene

    def readouts(self, state: RodState) -> dict[str, Array]:
        """Returns the distance of the tip from the target, and the tip's speed."""
        return {
            "distance [m]": vectors.safe_norm(vectors.split(state.tip - self.target)),
            "tip speed [m/s]": vectors.safe_norm(
                vectors.split(state.velocities[:, -1])
            ),
        }


def reach(
    arm: Arm,
    target: Numbers,
    duration: float = 1.0,
    *,
    speed_weight: float = 1e-3,
    running_weight: float = 0.0,
    effort_weight: float = 0.0,
    control_interval: float = 0.01,
    dt: TimeStep | None = None,
    control_shape: tuple[int, ...] | None = None,
    lower: Any = -1.0,
    upper: Any = 1.0,
) -> Problem:
    """Makes the problem of bringing the tip of an arm to a target, and to rest there.

    With zero running and effort weights there are six residuals, and a solver that uses
    their derivatives needs only six rows. So leave `effort_weight` zero, and give
    `levenberg_marquardt` a ridge instead.

    Args:
        arm: A pytree with `scene`, `state` and `with_controls(controls)`: an
            `ActuatedArm`, or a custom one.
        target: Target position of the tip at the end `(3,)` [m].
        duration: Time from start to end [s].
        speed_weight: Weight on the squared speed of the tip at the end [s^2].
        running_weight: Weight on the mean squared distance over time [1].
        effort_weight: Weight on the mean squared control value [m^2].
        control_interval: Longest time for which a control is held [s].
        dt: Largest time step of the simulation [s], or the result of `stable_dt`, which
            is also the default. Interval and step are shortened so that whole numbers
            of them fit.
        control_shape: Shape of the controls that `arm.with_controls` takes; by default
            `arm.control_shape`, the two directions of bending of an `ActuatedArm`.
        lower: Lower bounds of the control values: one number, or one per value.
        upper: Upper bounds of the control values: one number, or one per value.

    Raises:
        ValueError: An argument is out of range or has the wrong shape.

    Warns:
        UnreachableTargetWarning: The target is farther from the base of the arm than
            the arm is long.
        jaxrod.UnstableStepWarning: `dt` is above the stability bound.

    Example:
        >>> arm = envs.actuated_arm(10, n_controls=4)
        >>> problem = control.reach(arm, (0.3, 0.8, 0.0), duration=0.1, dt=1e-3)
        >>> problem.n_controls, problem.n_intervals  # two directions of four points
        (8, 10)
    """
    place = _checked(arm, target)
    shape = control_shape
    if shape is None:
        shape = getattr(arm, "control_shape", None)
    if shape is None:
        raise ValueError(
            "control_shape must be given: the shape of the controls that "
            f"{type(arm).__name__}.with_controls takes"
        )
    length = _positive("duration", duration, "s")
    largest = None if dt is None else float(check_time_step(dt))
    held = _positive("control_interval", control_interval, "s")
    units = {"speed_weight": "s^2", "running_weight": "", "effort_weight": "m^2"}
    weights = speed_weight, running_weight, effort_weight
    roots = [
        math.sqrt(check_array(name, weight, [()], unit, non_negative=True))
        for (name, unit), weight in zip(units.items(), weights, strict=True)
    ]
    n_intervals, steps, step = time_steps(arm, length, held, largest)
    kind = arm.state.positions.dtype
    check_step(arm.scene, jnp.asarray(step, kind))
    speed, running, effort = (jnp.asarray(root, kind) for root in roots)
    arm = getattr(arm, "prepared", arm)
    along = any(root > 0 for root in roots[1:])
    return make_problem(
        with_memory(arm.scene, arm.state),
        moved,
        n_intervals=n_intervals,
        interval=length / n_intervals,
        n_controls=math.prod(shape),
        running=on_the_way if along else None,
        final=at_the_end,
        data=Reach(
            arm=arm,
            target=jnp.asarray(place, kind),
            dt=jnp.asarray(step, kind),
            speed_root=speed,
            running_root=running,
            effort_root=effort,
            steps_per_interval=steps,
            n_intervals=n_intervals,
            control_shape=tuple(shape),
        ),
        lower=lower,
        upper=upper,
    )


def moved(data: Reach, state: RodState, control: Array, interval: Array) -> RodState:
    """Returns the arm's state after interval number `interval`, counted from 0.

    `state` is the state at its beginning, and `control` acts during it.
    """
    scene = data.arm.with_controls(control.reshape(data.control_shape))
    first = interval * data.steps_per_interval
    return advance(scene, state, data.dt, data.steps_per_interval, first=first)


def on_the_way(
    data: Reach, state: RodState, control: Array, interval: Array
) -> tuple[Array, Array]:
    """Returns the residuals of an interval: tip minus target, and the control.

    They are weighted by the square roots in `data`, so that their squares sum to the
    running terms of the cost. `state` is the state after the interval.
    """
    del interval
    count = data.n_intervals
    return (
        data.running_root / math.sqrt(count) * (state.tip - data.target),
        data.effort_root / math.sqrt(count * control.size) * control,
    )


def at_the_end(data: Reach, state: RodState) -> tuple[Array, Array]:
    """Returns the six final residuals: tip minus target, and weighted velocity [m]."""
    return state.tip - data.target, data.speed_root * state.velocities[:, -1]


_MOST_STEPS = 2**30
"""Largest number of time steps of a problem before rounding up, which may double it;
the step counter has 32 bits."""


def time_steps(
    arm: Any, duration: float, control_interval: float, dt: float | None
) -> tuple[int, int, float]:
    """Divides a duration into whole control intervals of whole time steps.

    Args:
        arm: The arm, whose largest stable step is used.
        duration: Time from start to end [s].
        control_interval: Longest time for which control values are held [s].
        dt: Largest time step of the simulation [s]; 0.8 of the stability bound if
            `None`.

    Returns:
        Number of control intervals, number of steps in each, and the time step [s].

    Raises:
        ValueError: There are more steps than the counter can hold.
    """
    largest = float(stable_dt(arm.scene).dt) if dt is None else dt
    in_all = duration / min(control_interval, largest)
    if not in_all < _MOST_STEPS:
        raise ValueError(
            f"duration must be less than {_MOST_STEPS:,} steps of the simulation, got "
            f"{duration:g} s, which is {in_all:.3g} steps"
        )
    # Allow for round-off: 1 s in intervals of 0.01 s makes 100 intervals, not 101.
    n_intervals = max(1, math.ceil(duration / control_interval * (1 - 1e-6)))
    steps = max(1, math.ceil(duration / n_intervals / largest * (1 - 1e-6)))
    return n_intervals, steps, duration / (n_intervals * steps)


def _checked(arm: Any, target: Numbers) -> np.ndarray:
    """Validates the arm and the target, and returns the target as floats `(3,)`.

    Warns if the target is out of reach.
    """
    lacking = [
        name for name in ("scene", "state", "with_controls") if not hasattr(arm, name)
    ]
    if lacking:
        raise ValueError(
            "arm must have scene, state and with_controls, as a "
            f"jaxrod.control.ActuatedArm has, got {type(arm).__name__} without "
            f"{lacking[0]}"
        )
    place = check_array("target", target, [(3,)], "m")
    base = np.asarray(arm.state.positions[:, 0], float)
    away, length = float(np.linalg.norm(place - base)), float(arm.scene.rod.length)
    if away > length * (1 + 1e-6):
        warn(
            f"target is {away:.3g} m from the arm's base and the arm is {length:.3g} m "
            "long: the tip can only approach it",
            UnreachableTargetWarning,
        )
    return np.asarray(place)


def _positive(name: str, value: float, unit: str) -> float:
    return float(check_array(name, value, [()], unit, positive=True))
