r"""Case 2 of the benchmark: a soft arm's tip reaches a point with an orientation.

Eighteen control values shape the couples along the arm, six about each material axis
(two of bending, one of twist), and are renewed every 1.4 ms. The goal does not move
during an episode of 1428 control steps (2 s). It is a point in a box around the arm,
and a frame whose d3 is vertical, turned about the vertical by up to 90 degrees from the
arm's frame at rest. Let $d$ be the distance of the tip from the goal and $\delta =
\sin^2(\varphi/2)$ the misalignment, where $\varphi$ is the angle between the last
element's frame and the goal's. The reward per control step is $-d^2 - \delta^2/2$, plus
up to 1.5 within 10 cm, plus up to 4.5 more within 5 cm:

| within | for the distance | for the orientation | if well aligned |
|---|---|---|---|
| 10 cm | 0.5 | 0.5 (1 - δ) | 0.5, δ at most 0.10 |
| 5 cm | 1.5 | 1.5 (1 - δ) | 1.5, δ at most 0.05 |

Variants:

- `"paper"`: the published environment in every detail, so that scores can be compared.
  An arm that breaks costs 10,000 and ends the episode.
- `"clean"`: the same arm with the library's own physics (`jaxrod.envs.arm.clean`). Its
  numbers of elements and steps keep the error of the tip within 1 % of the length
  (docs/clean_settings.md). When a numerical health flag rises the arm is frozen and the
  episode truncated.

Orientations are observed as quaternions (w, x, y, z) with non-negative w, of the
rotation from the world to the material frame.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxrod import RodState
from jaxrod.envs.arm.soft_arm import REFERENCE_ELEMENTS
from jaxrod.envs.protocol import Channel, Goals
from jaxrod.envs.tasks.arm_task import (
    COST_WIDTH,
    OBSERVED_NODES,
    TIP,
    ArmParams,
    ArmState,
    BenchmarkTask,
    Variant,
    checked_sizes,
    distance_reward,
    speed_channels,
    squared_distance,
)
from jaxrod.structure import pytree

SIZES: dict[Variant, tuple[int, int]] = {
    "paper": (REFERENCE_ELEMENTS, 7),
    "clean": (REFERENCE_ELEMENTS, 4),
}
"""Default numbers of elements, and of simulation steps per control step."""


@pytree
class GoalParams:
    """Parameters of the random goals: a box of positions, and a range of angles."""

    lower: Float[Array, "3"]
    """Lower corner of the box of positions [m]."""
    upper: Float[Array, "3"]
    """Upper corner of the box of positions [m]."""
    largest_yaw: Float[Array, ""]
    """Largest rotation of the goal's frame about the vertical, either way [rad]."""
    radius: Float[Array, ""]
    """Radius of the sphere with which the goal is drawn [m]."""


@pytree
class Goal:
    """Position and orientation that the tip should reach."""

    position: Float[Array, "3"]
    """Position for the tip [m]."""
    orientation: Float[Array, "4"]
    """Orientation for the last element: unit quaternion (w, x, y, z), world to
    material, with w >= 0."""


@pytree
class ReachingParams(ArmParams):
    """Parameters of the reaching task; every number is a traced leaf."""

    aligned: Float[Array, "2"]
    """Largest misalignments for the alignment bonus, within 10 cm and within 5 cm of
    the goal [1]."""


@dataclasses.dataclass(frozen=True)
class Reaching(BenchmarkTask):
    """Task in which the tip reaches a point with an orientation; made by `reaching`."""

    variant: Variant
    n_elements: int
    substeps: int
    episode_length: int = 1428
    name: str = "reaching"

    n_directions = 3
    n_controls = 6
    crash_reward = -10_000.0

    observation_size = 3 * OBSERVED_NODES + 4 + 4 + 7 + 4
    """52 numbers: eleven points of the arm (33), speed and direction (4) and quaternion
    (4) of its tip; position (3), speed and direction (4) and quaternion (4) of the
    goal."""

    def default_params(self) -> ReachingParams:
        """Default parameters of the task, in JAX's default precision."""
        arm = self.arm()
        number = functools.partial(jnp.asarray, dtype=arm.rod.radii.dtype)
        target = GoalParams(
            lower=number([-0.6, 0.3, -0.6]),
            upper=number([0.6, 0.9, 0.6]),
            largest_yaw=number(float(jnp.pi) / 2),
            radius=number(0.05),
        )
        aligned = number([0.10, 0.05])
        return ReachingParams(**self.common_params(arm), target=target, aligned=aligned)

    def first_target(self, key: Key[Array, ""], params: Any) -> Goal:
        """Draws a goal anywhere in its box, turned about the vertical."""
        return random_goal(key, params.target)

    def ended(
        self,
        observation: Float[Array, " observation"],
        crashed: Bool[Array, ""],
        before: ArmState,
        params: Any,
    ) -> tuple[Float[Array, " observation"], Bool[Array, ""]]:
        """Observation to return in the variant "paper", and whether the episode ends.

        The episode ends, and the observation is zero, if the arm crashed or an observed
        number is not finite. `before` is the state before the step.
        """
        crashed |= ~jnp.all(jnp.isfinite(observation))
        return super().ended(observation, crashed, before, params)

    def reward(self, state: ArmState, params: Any) -> Float[Array, ""]:
        """Reward of a state by distance and misalignment; see `reaching_reward`."""
        misalignment = misaligned(state.arm, state.target)
        return reaching_reward(squared_distance(state), misalignment, params)

    def scalars(self, arm: RodState, target: Goal) -> dict[str, Array]:
        """Scalars of `info`: distance from the goal [m] and misalignment of the tip."""
        misalignment = misaligned(arm, target)
        return super().scalars(arm, target) | {"misalignment": misalignment}

    def residuals(
        self,
        state: ArmState,
        action: Float[Array, " action"],
        params: Any,
        width: float = COST_WIDTH,
    ) -> Float[Array, "6"]:
        r"""Residuals whose squares sum to the planners' cost: offset, then rotation.

        The three of the tip's offset are those of `tip_residuals`. The three of its
        rotation from the goal's frame are $\sin(\varphi/2)$ times the axis, whose
        squares sum to the misalignment, divided by the square root of the largest
        misalignment with a bonus within 5 cm.
        """
        way = super().residuals(state, action, params, width)
        turn = turn_from(tip_frame(state.arm), state.target.orientation)
        return jnp.concatenate([way, turn / jnp.sqrt(params.aligned[1])])

    def seen(self, state: ArmState, params: Any) -> tuple[Array, ...]:
        """Observed frame of the tip, then position, velocity and frame of the goal."""
        goal = state.target
        # The goal's velocity is zero; it is observed as in Case 1.
        still = jnp.zeros_like(goal.orientation)
        return tip_frame(state.arm), goal.position, still, goal.orientation

    seen_channels = (
        Channel(4, "orientation of the tip: w, x, y, z, w at least 0", "1"),
        Channel(3, "position of the goal: x, y, z", "m"),
        *speed_channels("the goal, which is 0"),
        Channel(4, "orientation of the goal: w, x, y, z, w at least 0", "1"),
    )
    goal_entries = Goals(
        body=(*range(41),),
        achieved=(*TIP, *range(37, 41)),
        desired=(*range(41, 44), *range(48, 52)),
    )

    def goal_reward(
        self,
        achieved: Float[Array, "7"],
        desired: Float[Array, "7"],
        params: Any,
    ) -> Float[Array, ""]:
        """Reward of a position (3) and a quaternion (4); see `reaching_reward`."""
        squared = jnp.sum((achieved[:3] - desired[:3]) ** 2)
        misalignment = 1 - jnp.sum(achieved[3:] * desired[3:]) ** 2
        return reaching_reward(squared, misalignment, params)


def random_goal(key: Key[Array, ""], params: GoalParams) -> Goal:
    """Draws a goal anywhere in the box, its frame at any angle about the vertical."""
    place, turn = jax.random.split(key)
    position = jax.random.uniform(place, (3,), minval=params.lower, maxval=params.upper)
    unit = jax.random.uniform(turn, (), params.lower.dtype, -1.0)
    return Goal(position, frame_at_yaw(params.largest_yaw * unit))


def frame_at_yaw(yaw: Float[Array, ""]) -> Float[Array, "4"]:
    r"""Quaternion (w, x, y, z) of the arm's rest frame turned about the vertical, y.

    It rotates from the world to the material frame. At the yaw $\theta$ [rad] the frame
    is $d_1 = (-\sin\theta, 0, \cos\theta)$, $d_2 = (\cos\theta, 0, \sin\theta)$, d3 up.
    """
    half = jnp.pi / 4 - 0.5 * yaw
    s, c = jnp.sin(half), jnp.cos(half)
    return jnp.sqrt(0.5).astype(yaw.dtype) * jnp.stack([s, s, c, c])


def tip_frame(arm: RodState) -> Float[Array, "4"]:
    """Unit quaternion (w, x, y, z) of the last element, world to material, w >= 0."""
    w, x, y, z = arm.orientations[:, -1]
    sign = jnp.where(w < 0, -1, 1)
    return sign * jnp.stack([w, -x, -y, -z])


def turn_from(frame: Float[Array, "4"], goal: Float[Array, "4"]) -> Float[Array, "3"]:
    """Vector part of the quaternion that rotates one frame into the other [1].

    It is sin(phi/2) times the axis of the rotation by phi, so its squares sum to the
    misalignment. Both frames are unit quaternions (w, x, y, z). A change of sign of
    either only changes the sign of the result.
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
    """Misalignment of the last element, sin^2(phi/2) = 1 - (q . q_goal)^2, 0 to 1."""
    return 1 - jnp.sum(tip_frame(arm) * goal.orientation) ** 2


def reaching_reward(
    distance_squared: Array, misalignment: Array, params: ReachingParams
) -> Array:
    """Reward -d^2 - misalignment^2 / 2, plus the bonuses of the module docstring.

    d^2 is `distance_squared`, of the tip from the goal [m^2].
    """
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
    """Makes the reaching task (Case 2); see the module docstring.

    Args:
        variant: "paper" or "clean".
        n_elements: Elements of the arm, a multiple of 10.
        substeps: Simulation steps per control step of 1.4 ms; by default 7 in
            "paper" and 4 in "clean", or more for more elements than usual.
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    elements, steps = checked_sizes(
        variant, SIZES, n_elements, substeps, episode_length
    )
    return Reaching(variant, elements, steps, episode_length)
