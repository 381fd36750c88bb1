r"""Case 1 of the benchmark: a soft arm's tip follows a moving target.

Twelve control values shape the bending couples along the arm, six about each
transverse axis, and are renewed every 1.4 ms. The target flies at 0.5 m/s through a
box around the arm and takes a new heading every 500 control steps. Reward per control
step, at distance $d$ of the tip from the target: $-d^2$, plus 0.5 within 10 cm, plus
1.5 more within 5 cm. An episode lasts 7142 control steps (10 s).

Variants:

- `"paper"`: the published environment in every detail, so that scores compare.
- `"clean"`: the same arm with the library's own physics: consistent elastic law, a
  wall-accurate clamp, damping integrated exactly, actuation per metre instead of per
  element, and as few elements and steps as keep the tip within 1 % of the length under
  the actions of a trained policy (docs/clean_settings.md), see `jaxrod.envs.arm.clean`.
  When a numerical health flag rises the arm is frozen at its last sound state and the
  episode truncated.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import RodState, control_spline, freeze
from jaxrod.envs.arm import moving_target
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
from jaxrod.envs.arm.moving_target import Target, TargetParams
from jaxrod.envs.arm.scenery import arm_and_target
from jaxrod.envs.arm.soft_arm import LENGTH, REFERENCE_ELEMENTS
from jaxrod.envs.checking import action_of_size
from jaxrod.envs.protocol import Snapshot
from jaxrod.envs.published.arm import published_arm
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.structure import pytree

Variant = Literal["paper", "clean"]
VARIANTS: tuple[Variant, ...] = ("paper", "clean")

SIZES: dict[Variant, tuple[int, int]] = {
    "paper": (REFERENCE_ELEMENTS, 7),
    "clean": (30, 5),
}
"""Default elements and simulation steps per control step."""
N_CONTROLS = 6
HEADING_STEPS = 500
BASE = (0.0, 0.0, 0.0)
AXIS = "y"


@pytree
class TrackingParams:
    """Numbers of the task; every one is a traced leaf."""

    arm: Arm
    """The arm and everything that acts on it."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    target: TargetParams
    """Parameters of the target's motion."""
    bonus: Bonus
    """Distances within which the bonuses are paid."""
    crash_reward: Float[Array, ""]
    """Reward of a step after which the arm is not finite ("paper")."""


@pytree
class TrackingState:
    """State of an episode."""

    arm: RodState
    """The arm."""
    muscles: Any
    """Memory of its muscles."""
    target: Target
    """The target."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Tracking(CostOfResiduals):
    """The tracking task; see the module docstring. Make one with `tracking`."""

    variant: Variant
    n_elements: int
    substeps: int
    episode_length: int = 7142
    name: str = "tracking"

    plane: ClassVar[PlaneName | None] = None
    """Plane of motion: none."""

    @property
    def observation_size(self) -> int:
        """Eleven points of the arm, the tip's velocity, the target: 44 numbers."""
        return 3 * OBSERVED_NODES + 4 + 7

    @property
    def action_size(self) -> int:
        """Six control values about d1, then six about d2."""
        return 2 * N_CONTROLS

    @property
    def control_period(self) -> float:
        """Time between actions [s]."""
        return CONTROL_PERIOD

    def control_points(self) -> int:
        """Number of control points."""
        return N_CONTROLS

    def default_params(self) -> TrackingParams:
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

        return TrackingParams(
            arm=arm,
            dt=numbers(CONTROL_PERIOD / self.substeps),
            target=TargetParams(
                lower=numbers([-0.6, 0.3, -0.6]),
                upper=numbers([0.6, 0.9, 0.6]),
                radius=numbers(0.05),
                speed=numbers(0.5),
            ),
            bonus=Bonus(near=numbers(0.10), touching=numbers(0.05)),
            crash_reward=numbers(-1000.0),
        )

    def reset(
        self, key: Key[Array, ""], params: TrackingParams
    ) -> tuple[Float[Array, " observation"], TrackingState]:
        """Starts with the arm straight and at rest, the target anywhere in its box."""
        target = moving_target.start(key, params.target)
        state = TrackingState(
            arm=params.arm.rest,
            muscles=params.arm.relaxed(),
            target=target,
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state), state

    def step(
        self,
        key: Key[Array, ""],
        state: TrackingState,
        action: Float[Array, " action"],
        params: TrackingParams,
    ) -> tuple[
        Float[Array, " observation"],
        TrackingState,
        Float[Array, ""],
        Bool[Array, ""],
        Bool[Array, ""],
        dict[str, Array],
    ]:
        """Advances one control step: the couples of the action act for 1.4 ms."""
        before = state.arm
        state, crashed = self._moved(state, action, params, 1)
        arm, target = state.arm, state.target
        turning = state.steps % HEADING_STEPS == 0
        velocity = jnp.where(
            turning, moving_target.heading(key, params.target.speed), target.velocity
        )
        state = dataclasses.replace(state, target=Target(target.position, velocity))

        distance_squared = jnp.sum((arm.tip - target.position) ** 2)
        reward = distance_reward(distance_squared, params.bonus)
        timeout = state.steps >= self.episode_length
        observation = self.observe(state)
        if self.variant == "paper":
            reward = jnp.where(crashed, params.crash_reward, reward)
            observation = jnp.where(crashed, 0, observation)
            terminated, truncated = crashed, timeout
        else:
            terminated, truncated = jnp.zeros((), bool), timeout | crashed
        sound = freeze(crashed, before, arm)
        info = {
            "distance": shown_distance(sound, target.position),
            "flagged": crashed,
        }
        return observation, state, reward, terminated, truncated, info

    def predict(
        self,
        state: TrackingState,
        action: Float[Array, " action"],
        params: TrackingParams,
        control_steps: int = 1,
    ) -> TrackingState:
        """Predicts the state under one action; the target keeps its current velocity.

        Between two changes of heading this equals `step`; new headings are not
        foreseen.

        Args:
            state: Current state.
            action: In [-1, 1].
            params: Numbers of the task.
            control_steps: Number of control steps for which the action is held.
        """
        return self._moved(state, action, params, control_steps)[0]

    def residuals(
        self,
        state: TrackingState,
        action: Float[Array, " action"],
        params: TrackingParams,
        width: float = COST_WIDTH,
    ) -> Float[Array, "3"]:
        """Residuals for planners, from the tip's offset; see `tip_residuals`."""
        del action
        return tip_residuals(
            state.arm.tip - state.target.position, params.bonus.touching, width
        )

    def _moved(
        self,
        state: TrackingState,
        action: Float[Array, " action"],
        params: TrackingParams,
        control_steps: int,
    ) -> tuple[TrackingState, Bool[Array, ""]]:
        """Returns the state without a new heading, and whether the arm crashed."""
        action = action_of_size(action, self.action_size)
        bends = jnp.reshape(action, (2, N_CONTROLS))
        controls = jnp.concatenate([bends, jnp.zeros_like(bends[:1])])
        substeps = control_steps * self.substeps
        arm, muscles, crashed = params.arm.advance(
            state.arm, state.muscles, controls, params.dt, substeps
        )
        # The published environment tests the walls after every half step.
        target = moving_target.fly(
            state.target, params.target, 0.5 * params.dt, 2 * substeps
        )
        steps = state.steps + control_steps
        return TrackingState(arm, muscles, target, steps), crashed

    def snapshot(self, state: TrackingState, params: TrackingParams) -> Snapshot:
        """The arm and the target."""
        target, radius = state.target.position, params.target.radius
        return arm_and_target(params.arm.rod, state.arm, target, radius)

    def observe(self, state: TrackingState) -> Float[Array, " observation"]:
        """Points of the arm, speed and direction of the tip, and of the target."""
        return jnp.concatenate(
            [
                observed_points(state.arm),
                speed_and_direction(state.arm.velocities[:, -1]),
                state.target.position,
                speed_and_direction(state.target.velocity),
            ]
        )


def tracking(
    variant: Variant = "paper",
    *,
    n_elements: int | None = None,
    substeps: int | None = None,
    episode_length: int = 7142,
) -> Tracking:
    """Makes the tracking task.

    Args:
        variant: "paper" or "clean".
        n_elements: Elements of the arm, a multiple of 10; by default 20 in "paper"
            and 30 in "clean".
        substeps: Simulation steps per control step of 1.4 ms; by default 7 in
            "paper" and 5 in "clean".
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    elements, steps = SIZES[variant]
    elements = elements if n_elements is None else n_elements
    steps = steps if substeps is None else substeps
    check_sizes(elements, steps, episode_length)
    return Tracking(variant, elements, steps, episode_length)
