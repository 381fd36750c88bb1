r"""Case 1 of the benchmark: a soft arm's tip follows a moving target.

Twelve control values shape the bending couples along the arm, six about each
transverse axis, and are renewed every 1.4 ms. The target flies at 0.5 m/s through a
box around the arm and takes a new heading every 500 control steps. Reward per control
step, at distance $d$ of the tip from the target: $-d^2$, plus 0.5 within 10 cm, plus
1.5 more within 5 cm. An episode lasts 7142 control steps (10 s).

Variants:

- `"paper"`: the published environment in every detail, so that scores can be compared.
- `"clean"`: the same arm with the library's own physics (`jaxrod.envs.arm.clean`):
  elastic loads from a stored energy, a clamp with a second-order error, damping
  integrated exactly, and actuation per metre instead of per element. It has as few
  elements and steps as keep the error of the tip within 1 % of the length under the
  actions of a trained policy (docs/clean_settings.md). When a numerical health flag
  rises the arm is frozen at its last sound state and the episode truncated.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxrod.envs.arm import moving_target
from jaxrod.envs.arm.moving_target import Target, TargetParams
from jaxrod.envs.arm.soft_arm import REFERENCE_ELEMENTS
from jaxrod.envs.protocol import Channel, Goals
from jaxrod.envs.tasks.arm_task import (
    OBSERVED_NODES,
    TIP,
    ArmParams,
    ArmState,
    BenchmarkTask,
    Variant,
    checked_sizes,
    distance_reward,
    speed_and_direction,
    speed_channels,
)

SIZES: dict[Variant, tuple[int, int]] = {
    "paper": (REFERENCE_ELEMENTS, 7),
    "clean": (30, 5),
}
"""Default numbers of elements, and of simulation steps per control step."""
HEADING_STEPS = 500


@dataclasses.dataclass(frozen=True)
class Tracking(BenchmarkTask):
    """Task in which the tip follows a moving target; made by `tracking`."""

    variant: Variant
    n_elements: int
    substeps: int
    episode_length: int = 7142
    name: str = "tracking"

    n_directions = 2
    n_controls = 6
    crash_reward = -1000.0

    observation_size = 3 * OBSERVED_NODES + 4 + 7
    """44 numbers: eleven points of the arm, velocity of the tip, target."""

    def default_params(self) -> ArmParams:
        """Default parameters of the task, in JAX's default precision."""
        arm = self.arm()
        number = functools.partial(jnp.asarray, dtype=arm.rod.radii.dtype)
        target = TargetParams(
            lower=number([-0.6, 0.3, -0.6]),
            upper=number([0.6, 0.9, 0.6]),
            radius=number(0.05),
            speed=number(0.5),
        )
        return ArmParams(**self.common_params(arm), target=target)

    def first_target(self, key: Key[Array, ""], params: Any) -> Target:
        """Draws a target anywhere in its box, with a random heading."""
        return moving_target.start(key, params.target)

    def moved(
        self,
        key: Key[Array, ""] | None,
        state: ArmState,
        action: Float[Array, " action"],
        params: Any,
        control_steps: int = 1,
    ) -> tuple[ArmState, Bool[Array, ""]]:
        """Moves arm and target for control steps under one action.

        With a key the target takes a new heading if the step count is a multiple of
        500; without a key it keeps its heading.

        Returns:
            The state, and whether the arm crashed.
        """
        state, crashed = super().moved(key, state, action, params, control_steps)
        # The published environment tests the walls after every half step.
        tests = 2 * control_steps * self.substeps
        target = moving_target.fly(state.target, params.target, 0.5 * params.dt, tests)
        if key is not None:
            turning = state.steps % HEADING_STEPS == 0
            heading = moving_target.heading(key, params.target.speed)
            velocity = jnp.where(turning, heading, target.velocity)
            target = Target(target.position, velocity)
        return dataclasses.replace(state, target=target), crashed

    def seen(self, state: ArmState, params: Any) -> tuple[Array, ...]:
        """Observed target: its position, then its speed and direction."""
        target = state.target
        return target.position, speed_and_direction(target.velocity)

    seen_channels = (
        Channel(3, "position of the target: x, y, z", "m"),
        *speed_channels("the target"),
    )
    goal_entries = Goals(body=(*range(37),), achieved=TIP, desired=(37, 38, 39))

    def goal_reward(
        self,
        achieved: Float[Array, "3"],
        desired: Float[Array, "3"],
        params: Any,
    ) -> Float[Array, ""]:
        """Reward by the distance of a position from a target; see `distance_reward`."""
        return distance_reward(jnp.sum((achieved - desired) ** 2), params.bonus)


def tracking(
    variant: Variant = "paper",
    *,
    n_elements: int | None = None,
    substeps: int | None = None,
    episode_length: int = 7142,
) -> Tracking:
    """Makes the tracking task (Case 1); see the module docstring.

    Args:
        variant: "paper" or "clean".
        n_elements: Elements of the arm, a multiple of 10; by default 20 in "paper"
            and 30 in "clean".
        substeps: Simulation steps per control step of 1.4 ms; by default 7 in
            "paper" and 5 in "clean", or more for more elements than usual.
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    elements, steps = checked_sizes(
        variant, SIZES, n_elements, substeps, episode_length
    )
    return Tracking(variant, elements, steps, episode_length)
