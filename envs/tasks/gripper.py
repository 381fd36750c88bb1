r"""Three soft fingers on a wrist grasp a ball on a table and lift it.

Four control values are renewed every 0.1 s. The first is the pressure in the chambers
of all fingers, which share one line: from -25 kPa (-1), which opens the fingers, to 125
kPa (1). The other three are the target position of the wrist along x, y and z: up to
0.02 m from the middle to every side, and from 0.11 m (-1) to 0.2 m (1) above the table.
Pressure changes by at most 75 kPa in 0.1 s. The wrist moves at 0.2 m/s at most along
each axis. Both are linear in time over a control step.

The ball (radius 0.03 m, 11 g) begins at rest on the table, up to `spread` from the
middle along x and along y, below the straight fingers. With `lowered` the wrist begins
anywhere on its straight path from the top to the position around the ball. The goal is
to lift the ball 0.07 m above its starting height. The reward of a control step is the
score after it divided by the number of control steps of an episode, so the return is
the mean score:

| points | for |
|---:|---|
| 15 | nearness of the ball to the line between the fingers |
| 20 | with the ball between the fingers, nearness of their tips to its lowest point |
| 20 | with the ball between the fingers, the share of its weight off the table |
| 45 | height of the ball above its starting height, up to 0.07 m |

The line between the fingers is the middle of the gripper, from 0.045 m to 0.085 m below
the wrist. The ball is on it when the wrist is at its lowest, and when it is gripped.

An episode lasts 30 control steps (3 s). Observed, in this order, with everything
divided by the unit in brackets:

| numbers | what |
|---:|---|
| 3 | offset of the ball's centre from the middle of the line between fingers [0.03 m] |
| 3 | the ball's velocity [0.1 m/s] |
| 1 | the ball's height above its starting height [0.07 m] |
| 4 | current control values [1] |
| 9 | finger by finger, position of the tip from the ball's centre [0.03 m] |
| 9 | finger by finger, position of the middle from the ball's centre [0.03 m] |

When a numerical health flag rises everything is frozen at its last sound state, the
reward of the step is 0 and the episode is truncated. Fingers do not touch each other.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxrod.actuation import limit_rate
from jaxrod.envs.checking import action_of_size, check_key, check_variant
from jaxrod.envs.protocol import Channel, Snapshot, Step
from jaxrod.envs.soft_bodies.gripper_body import (
    BALL,
    HIGHEST,
    N_FINGERS,
    SUNK,
    GripperBody,
    gripper_body,
)
from jaxrod.geometry import vectors
from jaxrod.structure import pytree
from jaxrod.systems.stepping.assembly import SystemState
from jaxrod.validation import check_array, check_count

Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

CONTROL_PERIOD = 0.1
"""Time between actions [s]."""
SUCTION = 0.2
"""Suction at a control value of -1, divided by the pressure at a control value of 1;
both are relative to the surroundings [1]."""
SLACK = 2 * SUCTION / (1 + SUCTION) - 1
"""Control value for zero pressure relative to the surroundings [1]."""
RATE = 10.0
"""Largest rate of the pressure's control value [1/s]."""
SPEED = 0.2
"""Largest speed of the wrist along each axis [m/s]."""
STEPS_PER_ELEMENT = 48
"""Default number of simulation steps of a control step, per element of a finger. The
time step is then 0.87 of the stability bound at full pressure."""
LEAST_STEPS = 360
"""Smallest default number of simulation steps of a control step. With fewer than eight
elements the contact of the fingertips limits the time step more than the fingers do."""
LOWEST, ASIDE = 0.11, 0.02
"""Lowest height of the wrist above the table, and its largest displacement along x and
y [m]."""
GRASP, HALF = 0.065, 0.02
"""Distance of the middle of the line between the fingers below the wrist, and half the
line's length [m]."""
NEAR, FAR = 0.005, 0.1
"""Distances of the ball from the line between the fingers at which the score has full
points for nearness, and none [m]."""
OPEN = 0.075
"""Distance of the furthest fingertip from the ball's lowest point at which the score
has no points for closed fingers [m]."""
LIFT = 0.07
"""Height by which the ball is to be lifted [m]."""
BALL_SPEED = 0.1
"""Unit of the ball's velocity in the observation [m/s]."""


@pytree
class GripperParams:
    """Parameters of the gripper task; every number is a traced leaf."""

    body: GripperBody
    """Parameters of gripper, ball and everything that acts on them."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    spread: Float[Array, ""]
    """Largest offset of the ball from the middle at the start, along x and y [m]."""
    lowered: Float[Array, ""]
    """Largest share of the wrist's path down to the ball that is already covered at the
    start: with 0 it starts at the top, with 1 anywhere on the path [1]."""


@pytree
class GripperState:
    """State of the gripper task."""

    body: SystemState
    """States of fingers and ball."""
    controls: Float[Array, "4"]
    """Current control values: pressure, then position of the wrist [1]."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Gripper:
    """Task in which soft fingers grasp a ball and lift it; made by `gripper`."""

    n_elements: int
    substeps: int
    episode_length: int = 30
    spread: float = 0.01
    lowered: float = 1.0
    variant: Variant = "clean"
    name: str = "gripper"

    observation_size = 3 + 3 + 1 + 4 + 6 * N_FINGERS
    """29 numbers: ball, control values, tips and middles of the fingers."""

    action_size = 4
    """4 numbers: pressure of all chambers, position of the wrist along x, y and z."""

    observation_channels = (
        Channel(
            3,
            "offset of the ball's centre from the middle of the line between fingers",
            f"{BALL:g} m",
        ),
        Channel(3, "velocity of the ball: x, y, z", f"{BALL_SPEED:g} m/s"),
        Channel(1, "height of the ball above its start", f"{LIFT:g} m"),
        Channel(4, "current control values", "1"),
        Channel(
            3 * N_FINGERS,
            "finger by finger, position of the tip from the ball's centre",
            f"{BALL:g} m",
        ),
        Channel(
            3 * N_FINGERS,
            "finger by finger, position of the middle from the ball's centre",
            f"{BALL:g} m",
        ),
    )
    action_channels = (
        Channel(1, "pressure, from -25 kPa (-1) to 125 kPa (1)", "1"),
        Channel(2, "position of the wrist along x and y", "0.02 m"),
        Channel(1, "height of the wrist, from 0.11 m (-1) to 0.2 m (1)", "1"),
    )

    control_period = CONTROL_PERIOD
    """Time between actions [s]."""

    def default_params(self) -> GripperParams:
        """Default parameters of the task, in JAX's default precision."""
        body = gripper_body(self.n_elements)
        kind = body.most_pressure.dtype
        return GripperParams(
            body=body,
            dt=jnp.asarray(CONTROL_PERIOD / self.substeps, kind),
            spread=jnp.asarray(self.spread, kind),
            lowered=jnp.asarray(self.lowered, kind),
        )

    def reset(
        self, key: Key[Array, ""], params: GripperParams
    ) -> tuple[Float[Array, " observation"], GripperState]:
        """Starts with straight fingers above or around the ball, near the middle."""
        check_key(key)
        kind = params.dt.dtype
        aside_key, height_key = jax.random.split(key)
        aside = params.spread * jax.random.uniform(aside_key, (2,), kind, -1.0)
        lowered = params.lowered * jax.random.uniform(height_key, (), kind)
        # The start is on a straight line to the place around the ball, so that the
        # gripper cannot touch the ball.
        top = jnp.asarray([SLACK, 0.0, 0.0, 1.0], kind)
        around = jnp.concatenate([top[:1], aside / ASIDE, -top[3:]])
        controls = top + lowered * (around - top)
        ball, fingers = params.body.rest["ball"], params.body.rest["fingers"]
        hanging = fingers.positions + _told(controls)[0][None, :, None]
        place = ball.positions + vectors.pad(aside, 0, 1)[:, None]
        state = GripperState(
            body={
                "fingers": dataclasses.replace(fingers, positions=hanging),
                "ball": dataclasses.replace(ball, positions=place),
            },
            controls=controls,
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state), state

    def step(
        self,
        key: Key[Array, ""],
        state: GripperState,
        action: Float[Array, " action"],
        params: GripperParams,
    ) -> Step:
        """Advances one control step; control values follow the action, rate-limited."""
        action = action_of_size(action, self.action_size)
        period = self.substeps * params.dt
        fastest = jnp.asarray([RATE, *(SPEED / way for way in _REACH)], period.dtype)
        controls = limit_rate(state.controls, jnp.clip(action, -1, 1), fastest * period)
        body, flagged = params.body.advance(
            state.body, _told(state.controls), _told(controls), params.dt, self.substeps
        )
        steps = state.steps + 1
        state = GripperState(
            body=body,
            controls=jnp.where(flagged, state.controls, controls),
            steps=steps,
        )
        info = {
            "height": _height(state),
            "borne": _borne(state),
            "score": _score(state),
            "flagged": flagged,
        }
        return (
            self.observe(state),
            state,
            jnp.where(flagged, 0, _score(state) / self.episode_length),
            jnp.zeros((), bool),
            (steps >= self.episode_length) | flagged,
            info,
        )

    def snapshot(self, state: GripperState, params: GripperParams) -> Snapshot:
        """Snapshot of fingers and ball, with the ball's height as a readout."""
        return Snapshot(
            positions=state.body["fingers"].positions,
            radii=params.body.fingers.rod.radii,
            spheres=((state.body["ball"].positions[:, 0], BALL),),
            readouts={"height of the ball [m]": _height(state)},
            up="z",
        )

    def observe(self, state: GripperState) -> Float[Array, " observation"]:
        """Observation vector; the module's table lists its entries."""
        ball = state.body["ball"]
        place, nodes = ball.positions[:, 0], state.body["fingers"].positions
        middle = nodes[:, :, self.n_elements // 2]
        return jnp.concatenate(
            [
                (place - _between(state)) / BALL,
                ball.velocities[:, 0] / BALL_SPEED,
                _height(state)[None] / LIFT,
                state.controls,
                jnp.ravel(nodes[:, :, -1] - place[None, :]) / BALL,
                jnp.ravel(middle - place[None, :]) / BALL,
            ]
        )

    def scripted_action(
        self, state: GripperState, params: GripperParams
    ) -> Float[Array, " action"]:
        """Scripted baseline: lowers open fingers around the ball, closes them, lifts.

        Args:
            state: Current state; only step count, wrist and ball are used.
            params: Traced parameters.
        """
        place = state.body["ball"].positions[:, 0]
        time = state.steps * CONTROL_PERIOD
        pressure = jnp.where(time < 0.8, -1.0, 1.0)
        height = jnp.where(time < 1.6, -1.0, 1.0)
        aside = jnp.where(time < 0.8, place[:2] / ASIDE, state.controls[1:3])
        return jnp.concatenate([pressure[None], aside, height[None]])


_REACH = ASIDE, ASIDE, (HIGHEST - LOWEST) / 2
"""Displacement of the wrist per control value, along x, y and z [m]."""


def _told(
    controls: Float[Array, "4"],
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Physical quantities of control values, as `GripperBody.advance` takes them.

    Returns:
        Displacement of the wrist from its highest position [m], and the pressure of
        each chamber divided by the largest pressure [1].
    """
    top = jnp.asarray([0.0, 0.0, 1.0], controls.dtype)
    wrist = (controls[1:] - top) * jnp.asarray(_REACH, controls.dtype)
    pressure = (1 + SUCTION) / 2 * (controls[0] + 1) - SUCTION
    return wrist, jnp.broadcast_to(pressure, (N_FINGERS,))


def _between(state: GripperState) -> Float[Array, "3"]:
    """Position of the middle of the line between the fingers, below the wrist [m]."""
    wrist, _ = _told(state.controls)
    return wrist + jnp.asarray([0.0, 0.0, HIGHEST - GRASP], wrist.dtype)


def _height(state: GripperState) -> Float[Array, ""]:
    """Height of the ball above its starting height [m]."""
    return state.body["ball"].positions[2, 0] - BALL


def _borne(state: GripperState) -> Float[Array, ""]:
    """Share of the ball's weight that the table does not carry, 0 to 1 [1].

    It is 1 + height / SUNK, from the ball's indentation of the table. It rises as the
    fingers grip the ball below its middle, and is zero if they press the ball down.
    """
    return jnp.clip(1 + _height(state) / SUNK, 0, 1)


def _score(state: GripperState) -> Float[Array, ""]:
    """Score of a state, 0 to 100 points, by the table in the module docstring."""
    place = state.body["ball"].positions[:, 0]
    x, y, z = vectors.split(place - _between(state))
    apart = vectors.safe_norm((x, y, z - jnp.clip(z, -HALF, HALF)))
    lowest = place - jnp.asarray([0.0, 0.0, BALL], place.dtype)
    tips = state.body["fingers"].positions[:, :, -1] - lowest[None, :]
    furthest = jnp.max(vectors.safe_norm(vectors.split(tips.T)))
    lifted = jnp.clip(_height(state) / LIFT, 0, 1)
    near = 1 - jnp.clip((apart - NEAR) / (FAR - NEAR), 0, 1)
    # Fingers that close above the ball get no points, because they could not reach
    # around it.
    around = 1 - jnp.clip((apart - NEAR) / BALL, 0, 1)
    closed = jnp.clip(1 - furthest / OPEN, 0, 1)
    grip = around * (closed + _borne(state))
    return 15 * near + 20 * grip + 45 * lifted


def gripper(
    variant: Variant = "clean",
    *,
    n_elements: int = 8,
    substeps: int | None = None,
    episode_length: int = 30,
    spread: float = 0.01,
    lowered: float = 1.0,
) -> Gripper:
    """Makes the gripper task; see the module docstring.

    Args:
        variant: "clean", the only one: the library's own physics.
        n_elements: Elements of every finger, at least 4.
        substeps: Simulation steps per control step of 0.1 s; by default 48 per element,
            and at least 360.
        episode_length: Control steps per episode.
        spread: Largest distance of the ball from the middle at the start, along x and
            along y, up to 0.02 m [m].
        lowered: Largest share of the wrist's path down to the ball that is already
            covered at the start, at most 1. The share is drawn uniformly from 0 to
            this.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    check_count("n_elements", n_elements, 4)
    usual = max(STEPS_PER_ELEMENT * n_elements, LEAST_STEPS)
    steps = usual if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    aside = float(check_array("spread", spread, [()], "m", non_negative=True))
    if aside > ASIDE:
        raise ValueError(f"spread must be at most 0.02 m, got {aside:g} m")
    down = float(check_array("lowered", lowered, [()], "", non_negative=True))
    if down > 1:
        raise ValueError(f"lowered must be at most 1, got {down:g}")
    return Gripper(n_elements, steps, episode_length, aside, down)
