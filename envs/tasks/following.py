r"""A soft arm's tip follows a moving target by commanded curvatures of the arm.

Each of the five segments of the arm has an angle about both transverse axes: the angle
by which the segment would bend if it were free. An action changes these ten angles by
0.05 rad at most, within 2 rad either way, linearly in time during the control step of
0.1 s. The target flies at 0.5 m/s through a box and takes a new heading with
probability 0.025 at every control step. Reward per control step, at distance $d$ of the
tip from the target: $-d^2$, plus 0.5 within 10 cm, plus 1.5 more within 5 cm. An
episode lasts 500 control steps (50 s).

This is the task "follow" of Choi and Tong (arXiv 2511.06667). Reward and box are those
of `tracking`. Arm, angles and their limits, target and duration are those of the paper.
The dynamics and the damping are this library's (docs/tasks.md). Observed, in this
order:

| numbers | what |
|---:|---|
| 15 | ends of the segments: x of each, then y, then z [m] |
| 15 | velocities of these ends [m/s] |
| 10 | angles of the segments about d1, then about d2 [rad] |
| 3 | the target's position [m] |
| 3 | the target's velocity [m/s] |
| 3 | vector from the tip to the target [m] |

When a numerical health flag rises the arm is frozen at its last sound state and the
episode is truncated. The arm has no self-contact.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import RodState
from jaxrod.envs.arm import moving_target
from jaxrod.envs.arm.moving_target import Target, TargetParams, wander
from jaxrod.envs.checking import action_of_size, check_key, check_variant
from jaxrod.envs.protocol import Channel, Snapshot
from jaxrod.envs.soft_bodies.curved_arm import N_SEGMENTS, CurvedArm, curved_arm
from jaxrod.envs.tasks.arm_task import ArmTask, Bonus
from jaxrod.structure import pytree
from jaxrod.validation import check_count

Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

CONTROL_PERIOD = 0.1
"""Time between actions [s]."""
LARGEST_CHANGE = 0.05
"""Largest change of an angle in a control step [rad]."""
STEPS_PER_ELEMENT = 15
"""Default number of simulation steps of a control step, per element. The time step is
then 0.74 of the stability bound of the straight arm, and 0.84 of the bound with all
segments bent as far as possible."""


@pytree
class FollowingParams:
    """Parameters of the following task; every number is a traced leaf."""

    arm: CurvedArm
    """Parameters of the arm and of everything that acts on it."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    target: TargetParams
    """Parameters of the target's motion."""
    chance: Float[Array, ""]
    """Probability of a new heading in a control step [1]."""
    bonus: Bonus
    """Distances from the target at which the reward has its bonuses."""


@pytree
class FollowingState:
    """State of the following task."""

    arm: RodState
    """State of the arm."""
    angles: Float[Array, "2 segments"]
    """Commanded angles of the segments about d1 and d2: their bend without loads
    [rad]."""
    target: Target
    """Position and velocity of the target."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Following(ArmTask):
    """Task in which a curved arm's tip follows a target; made by `following`."""

    n_elements: int
    substeps: int
    episode_length: int = 500
    variant: Variant = "clean"
    name: str = "following"

    control_period = CONTROL_PERIOD

    observation_size = 6 * N_SEGMENTS + 2 * N_SEGMENTS + 9
    """49 numbers: five points of the arm, their velocities, ten angles, target."""

    action_size = 2 * N_SEGMENTS
    """10 numbers: changes of the segments' angles, five about d1, then d2."""

    observation_channels = (
        Channel(3 * N_SEGMENTS, "ends of the segments: x, then y, then z", "m"),
        Channel(3 * N_SEGMENTS, "velocities of these ends: x, then y, then z", "m/s"),
        Channel(2 * N_SEGMENTS, "angles of the segments: about d1, then d2", "rad"),
        Channel(3, "position of the target: x, y, z", "m"),
        Channel(3, "velocity of the target: x, y, z", "m/s"),
        Channel(3, "vector from the tip to the target: x, y, z", "m"),
    )
    action_channels = (
        Channel(
            2 * N_SEGMENTS,
            "changes of the segments' angles: about d1, then d2",
            f"{LARGEST_CHANGE} rad",
        ),
    )

    def default_params(self) -> FollowingParams:
        """Default parameters of the task, in JAX's default precision."""
        arm = curved_arm(self.n_elements, LARGEST_CHANGE)

        def numbers(value: float | list[float]) -> Array:
            return jnp.asarray(value, arm.rod.radii.dtype)

        return FollowingParams(
            arm=arm,
            dt=numbers(CONTROL_PERIOD / self.substeps),
            target=TargetParams(
                lower=numbers([-0.6, -0.6, 0.3]),
                upper=numbers([0.6, 0.6, 0.9]),
                radius=numbers(0.0),
                speed=numbers(0.5),
            ),
            chance=numbers(0.025),
            bonus=Bonus(near=numbers(0.10), touching=numbers(0.05)),
        )

    def reset(
        self, key: Key[Array, ""], params: FollowingParams
    ) -> tuple[Float[Array, " observation"], FollowingState]:
        """Starts with the arm upright and at rest, and a random target in the box."""
        check_key(key)
        state = FollowingState(
            arm=params.arm.rest,
            angles=jnp.zeros((2, N_SEGMENTS), params.dt.dtype),
            target=moving_target.start(key, params.target),
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state, params), state

    def moved(
        self,
        key: Key[Array, ""] | None,
        state: FollowingState,
        action: Float[Array, " action"],
        params: FollowingParams,
    ) -> tuple[FollowingState, Bool[Array, ""]]:
        """Returns the state one control step later, and whether a health flag rose.

        Without a key the target keeps its heading.
        """
        action = action_of_size(action, self.action_size)
        angles = params.arm.turned(state.angles, action)
        arm, flagged = params.arm.advance(
            state.arm, state.angles, angles, params.dt, self.substeps
        )
        # The angles are frozen with the arm: a NaN action must not reach them.
        angles = jnp.where(flagged, state.angles, angles)
        target = wander(
            key,
            state.target,
            params.target,
            params.chance,
            self.substeps * params.dt,
        )
        return FollowingState(arm, angles, target, state.steps + 1), flagged

    def snapshot(self, state: FollowingState, params: FollowingParams) -> Snapshot:
        """Snapshot of arm and target, whose radius is the bonus distance `touching`."""
        return dataclasses.replace(
            super().snapshot(state, params),
            spheres=((state.target.position, params.bonus.touching),),
            up="z",
        )

    def observe(
        self, state: FollowingState, params: FollowingParams
    ) -> Float[Array, " observation"]:
        """Observation vector; the module's table lists its entries."""
        ends = jnp.asarray(self._ends()[None], state.angles.dtype)
        return jnp.concatenate(
            [
                jnp.ravel(jnp.sum(state.arm.positions[:, None] * ends, axis=-1)),
                jnp.ravel(jnp.sum(state.arm.velocities[:, None] * ends, axis=-1)),
                jnp.ravel(state.angles),
                state.target.position,
                state.target.velocity,
                state.target.position - state.arm.tip,
            ]
        )

    def _ends(self) -> np.ndarray:
        """Weights that interpolate node values at segment ends, (segments, n+1)."""
        nodes = np.linspace(0.0, 1.0, self.n_elements + 1)
        ends = np.arange(1, N_SEGMENTS + 1) / N_SEGMENTS
        return np.maximum(1 - self.n_elements * np.abs(ends[:, None] - nodes), 0)


def following(
    variant: Variant = "clean",
    *,
    n_elements: int = 12,
    substeps: int | None = None,
    episode_length: int = 500,
) -> Following:
    """Makes the task of following a target; see the module docstring.

    Args:
        variant: "clean", the only one: the library's own physics.
        n_elements: Elements of the arm, at least 5.
        substeps: Simulation steps per control step of 0.1 s; by default 15 per element.
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    check_count("n_elements", n_elements, N_SEGMENTS)
    steps = STEPS_PER_ELEMENT * n_elements if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    return Following(n_elements, steps, episode_length)
