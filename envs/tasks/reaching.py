r"""Case 2 of the benchmark: a soft arm's tip reaches a point with an orientation.

Eighteen control values shape the couples along the arm, six about each material axis
(two of bending, one of twist), and are renewed every 1.4 ms. The goal stands still
during an episode of 1428 control steps (2 s). It is a point in a box around the arm,
and a frame whose d3 is vertical, turned about the vertical by up to 90 degrees from the
arm's frame at rest. Let $d$ be the distance of the tip from it and $\delta =
\sin^2(\varphi/2)$ the misalignment, where $\varphi$ is the angle between the last
element's frame and the goal's. The reward per control step is $-d^2 - \delta^2/2$, plus
up to 1.5 within 10 cm, plus up to 4.5 more within 5 cm:

| within | for the distance | for the orientation | if well aligned |
|---|---|---|---|
| 10 cm | 0.5 | 0.5 (1 - δ) | 0.5, δ at most 0.10 |
| 5 cm | 1.5 | 1.5 (1 - δ) | 1.5, δ at most 0.05 |

Variants:

- `"paper"`: the published environment in every detail, so that scores compare. An arm
  that breaks costs 10 000 and ends the episode.
- `"clean"`: the same arm with the library's own physics, see `jaxrod.envs.arm.clean`;
    elements and steps keep the tip within 1 % of the length (docs/clean_settings.md).
  When a numerical health flag rises the arm is frozen and the episode truncated.

Orientations are observed as quaternions (w, x, y, z) with non-negative w, of the
rotation from the world to the material frame.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import RodState, control_spline, freeze
from jaxrod.envs.arm.arm_task import (
    CONTROL_PERIOD,
    OBSERVED_NODES,
    Arm,
    Bonus,
    check_sizes,
    check_variant,
    distance_reward,
    observed_points,
    shown_distance,
    speed_and_direction,
)
from jaxrod.envs.arm.clean import clean_arm
from jaxrod.envs.arm.cost import COST_WIDTH, CostOfResiduals, tip_residuals
from jaxrod.envs.arm.scenery import arm_and_target
from jaxrod.envs.arm.soft_arm import LENGTH, REFERENCE_ELEMENTS
from jaxrod.envs.checking import action_of_size
from jaxrod.envs.protocol import Snapshot
from jaxrod.envs.published.arm import published_arm
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.structure import pytree

Variant = Literal["paper", "clean"]
VARIANTS: tuple[Variant, ...] = ("paper", "clean")

N_CONTROLS = 6
BASE = (0.0, 0.0, 0.0)
AXIS = "y"


@pytree
class GoalParams:
    """Distribution of goals."""

    lower: Float[Array, "3"]
    """Lower corner of the box [m]."""
    upper: Float[Array, "3"]
    """Upper corner of the box [m]."""
    largest_yaw: Float[Array, ""]
    """Largest rotation about the vertical, either way [rad]."""
    radius: Float[Array, ""]
    """Radius of the sphere to draw [m]."""


@pytree
class Goal:
    """Position and orientation that the tip should reach."""

    position: Float[Array, "3"]
    """Position of the tip [m]."""
    orientation: Float[Array, "4"]
    """Orientation as observed: unit quaternion (w, x, y, z), world to material, with w
    >= 0."""


@pytree
class ReachingParams:
    """Numbers of the task; every one is a traced leaf."""

    arm: Arm
    """The arm and everything that acts on it."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    target: GoalParams
    """Distribution of goals."""
    bonus: Bonus
    """Distances within which the distance bonuses are paid."""
    aligned: Float[Array, "2"]
    """Largest misalignments for the last bonus, nearby and touching [1]."""
    crash_reward: Float[Array, ""]
    """Reward of a step after which the arm is not finite ("paper")."""


@pytree
class ReachingState:
    """State of an episode."""

    arm: RodState
    """The arm."""
    muscles: Any
    """Memory of its muscles."""
    target: Goal
    """The goal."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Reaching(CostOfResiduals):
    """The reaching task; see the module docstring. Make one with `reaching`."""

    variant: Variant
    n_elements: int
    substeps: int
    episode_length: int = 1428
    name: str = "reaching"

    plane: ClassVar[PlaneName | None] = None
    """Plane of motion: none."""

    @property
    def observation_size(self) -> int:
        """Eleven points, velocity and frame of the tip, and of the goal: 52 numbers."""
        return 3 * OBSERVED_NODES + 4 + 4 + 7 + 4

    @property
    def action_size(self) -> int:
        """Six control values about d1, six about d2, six about d3."""
        return 3 * N_CONTROLS

    @property
    def control_period(self) -> float:
        """Time between actions [s]."""
        return CONTROL_PERIOD

    def control_points(self) -> int:
        """Number of control points."""
        return N_CONTROLS

    def default_params(self) -> ReachingParams:
        """Numbers of the task, in JAX's default precision."""
        spline = control_spline(self.control_points(), LENGTH)
        arm: Arm
        if self.variant == "paper":
            arm = published_arm(self.n_elements, BASE, AXIS, spline)
        else:
            arm = clean_arm(
                self.n_elements,
                BASE,
                AXIS,
                spline,
                published_elements=REFERENCE_ELEMENTS,
            )

        def numbers(value: float | list[float]) -> Array:
            return jnp.asarray(value, arm.rod.radii.dtype)

        return ReachingParams(
            arm=arm,
            dt=numbers(CONTROL_PERIOD / self.substeps),
            target=GoalParams(
                lower=numbers([-0.6, 0.3, -0.6]),
                upper=numbers([0.6, 0.9, 0.6]),
                largest_yaw=numbers(float(jnp.pi) / 2),
                radius=numbers(0.05),
            ),
            bonus=Bonus(near=numbers(0.10), touching=numbers(0.05)),
            aligned=numbers([0.10, 0.05]),
            crash_reward=numbers(-10_000.0),
        )

    def reset(
        self, key: Key[Array, ""], params: ReachingParams
    ) -> tuple[Float[Array, " observation"], ReachingState]:
        """Starts with the arm straight and at rest, the goal anywhere in its box."""
        muscles = params.arm.relaxed()
        state = ReachingState(
            params.arm.rest,
            muscles,
            random_goal(key, params.target),
            jnp.zeros((), jnp.int32),
        )
        return self.observe(state), state

    def step(
        self,
        key: Key[Array, ""],
        state: ReachingState,
        action: Float[Array, " action"],
        params: ReachingParams,
    ) -> tuple[
        Float[Array, " observation"],
        ReachingState,
        Float[Array, ""],
        Bool[Array, ""],
        Bool[Array, ""],
        dict[str, Array],
    ]:
        """Advances one control step: the couples of the action act for 1.4 ms."""
        before = state.arm
        state, crashed = self._moved(state, action, params, 1)
        arm = state.arm
        observation = self.observe(state)
        distance_squared = jnp.sum((arm.tip - state.target.position) ** 2)
        misalignment = misaligned(arm, state.target)
        reward = reaching_reward(distance_squared, misalignment, params)
        timeout = state.steps >= self.episode_length
        if self.variant == "paper":
            crashed |= ~jnp.all(jnp.isfinite(observation))
            reward = jnp.where(crashed, params.crash_reward, reward)
            observation = jnp.where(crashed, 0, observation)
            terminated, truncated = crashed, timeout
        else:
            terminated, truncated = jnp.zeros((), bool), timeout | crashed
        sound = freeze(crashed, before, arm)
        info = {
            "distance": shown_distance(sound, state.target.position),
            "misalignment": misaligned(sound, state.target),
            "flagged": crashed,
        }
        return observation, state, reward, terminated, truncated, info

    def predict(
        self,
        state: ReachingState,
        action: Float[Array, " action"],
        params: ReachingParams,
        control_steps: int = 1,
    ) -> ReachingState:
        """Predicts the state under one action, exactly as `step`: nothing is random.

        Args:
            state: Current state.
            action: In [-1, 1].
            params: Numbers of the task.
            control_steps: Number of control steps for which the action is held.
        """
        return self._moved(state, action, params, control_steps)[0]

    def residuals(
        self,
        state: ReachingState,
        action: Float[Array, " action"],
        params: ReachingParams,
        width: float = COST_WIDTH,
    ) -> Float[Array, "6"]:
        r"""Residuals for planners: the tip's offset and rotation from the goal.

        The three numbers of the rotation are $\sin(\varphi/2)$ times its axis, divided
        by the square root of the largest misalignment that still earns a bonus. Before
        this division their squares sum to the misalignment.
        """
        del action
        way = tip_residuals(
            state.arm.tip - state.target.position, params.bonus.touching, width
        )
        turn = turn_from(tip_frame(state.arm), state.target.orientation)
        return jnp.concatenate([way, turn / jnp.sqrt(params.aligned[1])])

    def _moved(
        self,
        state: ReachingState,
        action: Float[Array, " action"],
        params: ReachingParams,
        control_steps: int,
    ) -> tuple[ReachingState, Bool[Array, ""]]:
        """Returns the later state, and whether the arm crashed."""
        action = action_of_size(action, self.action_size)
        controls = jnp.reshape(action, (3, N_CONTROLS))
        arm, muscles, crashed = params.arm.advance(
            state.arm, state.muscles, controls, params.dt, control_steps * self.substeps
        )
        steps = state.steps + control_steps
        return ReachingState(arm, muscles, state.target, steps), crashed

    def snapshot(self, state: ReachingState, params: ReachingParams) -> Snapshot:
        """The arm, and a sphere at the goal."""
        target, radius = state.target.position, params.target.radius
        return arm_and_target(params.arm.rod, state.arm, target, radius)

    def observe(self, state: ReachingState) -> Float[Array, " observation"]:
        """Points of the arm, velocity and frame of the tip, then of the goal."""
        return jnp.concatenate(
            [
                observed_points(state.arm),
                speed_and_direction(state.arm.velocities[:, -1]),
                tip_frame(state.arm),
                state.target.position,
                # The goal's velocity is zero; it is observed as in Case 1.
                jnp.zeros_like(state.target.orientation),
                state.target.orientation,
            ]
        )


def random_goal(key: Key[Array, ""], params: GoalParams) -> Goal:
    """Draws a goal anywhere in the box, its frame at any angle about the vertical."""
    place, turn = jax.random.split(key)
    position = jax.random.uniform(place, (3,), minval=params.lower, maxval=params.upper)
    unit = jax.random.uniform(turn, (), params.lower.dtype, -1.0)
    return Goal(position, frame_at_yaw(params.largest_yaw * unit))


def frame_at_yaw(yaw: Float[Array, ""]) -> Float[Array, "4"]:
    r"""The arm's frame at rest, turned about the vertical, as observed.

    $d_1 = (-\sin\theta, 0, \cos\theta)$, $d_2 = (\cos\theta, 0, \sin\theta)$, d3 up.
    """
    half = jnp.pi / 4 - 0.5 * yaw
    s, c = jnp.sin(half), jnp.cos(half)
    return jnp.sqrt(0.5).astype(yaw.dtype) * jnp.stack([s, s, c, c])


def tip_frame(arm: RodState) -> Float[Array, "4"]:
    """The last element's frame as observed."""
    w, x, y, z = arm.orientations[:, -1]
    sign = jnp.where(w < 0, -1, 1)
    return sign * jnp.stack([w, -x, -y, -z])


def turn_from(frame: Float[Array, "4"], goal: Float[Array, "4"]) -> Float[Array, "3"]:
    """Vector part of the rotation between two frames given as unit quaternions [1].

    Its squares sum to the misalignment. Changing the sign of either quaternion only
    changes the sign of the result.
    """
    w, x, y, z = frame
    a, b, c, d = goal
    return jnp.stack(
        [
            a * x - w * b + y * d - z * c,
            a * y - w * c + z * b - x * d,
            a * z - w * d + x * c - y * b,
        ]
    )


def misaligned(arm: RodState, goal: Goal) -> Array:
    """Misalignment of the last element's frame from the goal's, 0 to 1 [1]."""
    return 1 - jnp.sum(tip_frame(arm) * goal.orientation) ** 2


def reaching_reward(
    distance_squared: Array, misalignment: Array, params: ReachingParams
) -> Array:
    """Reward of a control step; see the module docstring."""
    near = distance_squared <= params.bonus.near**2
    touching = distance_squared <= params.bonus.touching**2
    aligned = misalignment <= params.aligned
    for_orientation = 0.5 * near * (1 - misalignment + aligned[0])
    for_orientation += 1.5 * touching * (1 - misalignment + aligned[1])
    return (
        distance_reward(distance_squared, params.bonus)
        - 0.5 * misalignment**2
        + for_orientation
    )


def reaching(
    variant: Variant = "paper",
    *,
    n_elements: int = REFERENCE_ELEMENTS,
    substeps: int | None = None,
    episode_length: int = 1428,
) -> Reaching:
    """Makes the reaching task.

    Args:
        variant: "paper" or "clean".
        n_elements: Elements of the arm, a multiple of 10.
        substeps: Simulation steps per control step of 1.4 ms; by default 7 in
            "paper" and 4 in "clean".
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    default_substeps = 7 if variant == "paper" else 4
    substeps = default_substeps if substeps is None else substeps
    check_sizes(n_elements, substeps, episode_length)
    return Reaching(variant, n_elements, substeps, episode_length)
