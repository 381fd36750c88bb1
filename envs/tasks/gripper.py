r"""Three soft fingers on a wrist grasp a ball on a table and lift it.

Six control values, renewed every 50 ms: pressures in the chambers of the three fingers,
which bend them inwards when above 0, and the velocity of the wrist along x, y and z, up
to 0.2 m/s each. Between two control steps they change by 0.5 at most; pressures go in a
straight line, and so does the wrist, which stays within 0.04 m of the middle to every
side and between 0.11 m and 0.2 m above the table.

The ball (radius 0.03 m, 23 g) begins at rest on the table, up to `spread` from the
middle along x and along y, below the open fingers. It is to be brought 0.07 m above
where it lay. The reward of a control step is what the score gains in it, so the return
of an episode is how much higher the score is at its end; it is about 0 at the start,
and about 90 with the ball held up:

| points | for |
|---:|---|
| 20 | nearness of the ball to the point between the fingers, 0.07 m below the wrist |
| 30 | with the ball between the fingers, nearness of their tips to its lowest point |
| 50 | the height of the ball over where it lay, up to 0.07 m |

An episode lasts 80 control steps (4 s). Observed, in this order, everything divided by
the unit in brackets:

| numbers | what |
|---:|---|
| 3 | the ball's centre from the point between the fingers [0.03 m] |
| 3 | its velocity [0.1 m/s] |
| 1 | its height over where it lay [0.07 m] |
| 3 | the wrist from where it was at the start [0.1 m] |
| 3 | its velocity in force [0.2 m/s] |
| 3 | pressures in force [0.1 MPa] |
| 9 | finger by finger, the tip from the ball's centre [0.03 m] |
| 9 | finger by finger, the middle from the ball's centre [0.03 m] |

When a numerical health flag rises all is frozen at its last sound state, the reward of
the step is 0 and the episode is truncated. Fingers do not touch each other.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import limit_rate
from jaxrod.envs.arm.arm_task import check_variant
from jaxrod.envs.snapshot import Snapshot
from jaxrod.envs.soft_bodies.gripper_body import (
    BALL,
    HIGHEST,
    N_FINGERS,
    GripperBody,
    gripper_body,
)
from jaxrod.geometry import vectors
from jaxrod.structure import pytree
from jaxrod.systems.assembly import SystemState
from jaxrod.validation import check_array, check_count

Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

CONTROL_PERIOD = 0.05
"""Time between actions [s]."""
LARGEST_CHANGE = 0.5
"""Of a control value from one control step to the next [1]."""
STEPS_PER_ELEMENT = 24
"""Simulation steps of a control step, per element of a finger: about 0.95 of the
stability bound at full pressure."""
SPEED = 0.2
"""Of the wrist for a control value of one [m/s]."""
LOWEST, ASIDE = 0.11, 0.04
"""Height of the wrist above the table at least, its way to every side at most [m]."""
GRASP = 0.07
"""How far the point between the fingers is below the wrist [m]."""
LIFT = 0.07
"""How far the ball is to be lifted [m]."""
BALL_SPEED = 0.1
"""Unit of the ball's velocity [m/s]."""
WRIST = 0.1
"""Unit of the wrist's displacement [m]."""


@pytree
class GripperParams:
    """Numbers of the task; every one a traced leaf."""

    body: GripperBody
    """The gripper, the ball and all that acts on them."""
    dt: Float[Array, ""]
    """Step of the simulation [s]."""
    spread: Float[Array, ""]
    """Largest distance of the ball from the middle at the start, along x and y [m]."""


@pytree
class GripperState:
    """State of an episode."""

    body: SystemState
    """Fingers and ball."""
    wrist: Float[Array, "3"]
    """Where the wrist is, from where it was at the start [m]."""
    controls: Float[Array, "6"]
    """Control values in force: pressures, then velocities of the wrist [1]."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Gripper:
    """The gripper; see the module. Make one with `gripper`."""

    n_elements: int
    substeps: int
    episode_length: int = 80
    spread: float = 0.01
    variant: Variant = "clean"
    name: str = "gripper"

    @property
    def observation_size(self) -> int:
        """Ball, wrist, control values, tips and middles of the fingers: 34 numbers."""
        return 3 + 3 + 1 + 3 + 3 + N_FINGERS + 6 * N_FINGERS

    @property
    def action_size(self) -> int:
        """Pressure of every finger, velocity of the wrist: 6 numbers."""
        return N_FINGERS + 3

    @property
    def control_period(self) -> float:
        """Time between actions [s]."""
        return CONTROL_PERIOD

    def default_params(self) -> GripperParams:
        """The task's numbers; in JAX's default precision."""
        body = gripper_body(self.n_elements)
        kind = body.most_pressure.dtype
        return GripperParams(
            body=body,
            dt=jnp.asarray(CONTROL_PERIOD / self.substeps, kind),
            spread=jnp.asarray(self.spread, kind),
        )

    def reset(
        self, key: Key[Array, ""], params: GripperParams
    ) -> tuple[Float[Array, " observation"], GripperState]:
        """Fingers open above the ball, the ball somewhere near the middle."""
        kind = params.dt.dtype
        aside = params.spread * jax.random.uniform(key, (2,), kind, -1.0)
        ball = params.body.rest["ball"]
        place = ball.positions + vectors.pad(aside, 0, 1)[:, None]
        state = GripperState(
            body={
                **params.body.rest,
                "ball": dataclasses.replace(ball, positions=place),
            },
            wrist=jnp.zeros(3, kind),
            controls=jnp.zeros(N_FINGERS + 3, kind),
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state), state

    def step(
        self,
        key: Key[Array, ""],
        state: GripperState,
        action: Float[Array, " action"],
        params: GripperParams,
    ) -> tuple[
        Float[Array, " observation"],
        GripperState,
        Float[Array, ""],
        Bool[Array, ""],
        Bool[Array, ""],
        dict[str, Array],
    ]:
        """One control period: control values go to the action, as far as they may."""
        controls = limit_rate(
            state.controls, jnp.clip(action, -1, 1), jnp.asarray(LARGEST_CHANGE)
        )
        n = N_FINGERS
        way = SPEED * self.substeps * params.dt * controls[n:]
        least = jnp.asarray([-ASIDE, -ASIDE, LOWEST - HIGHEST], way.dtype)
        most = jnp.asarray([ASIDE, ASIDE, 0.0], way.dtype)
        wrist = jnp.clip(state.wrist + way, least, most)
        body, flagged = params.body.advance(
            state.body,
            (state.wrist, state.controls[:n]),
            (wrist, controls[:n]),
            params.dt,
            self.substeps,
        )
        before = _score(state)
        steps = state.steps + 1
        state = GripperState(
            body=body,
            wrist=jnp.where(flagged, state.wrist, wrist),
            controls=controls,
            steps=steps,
        )
        info = {
            "height": _height(state),
            "score": _score(state),
            "flagged": flagged,
        }
        return (
            self.observe(state),
            state,
            jnp.where(flagged, 0, _score(state) - before),
            jnp.zeros((), bool),
            (steps >= self.episode_length) | flagged,
            info,
        )

    def snapshot(self, state: GripperState, params: GripperParams) -> Snapshot:
        """Fingers and ball."""
        return Snapshot(
            positions=state.body["fingers"].positions,
            radii=params.body.fingers.rod.radii,
            spheres=((state.body["ball"].positions[:, 0], BALL),),
            readouts={"height of the ball [m]": _height(state)},
            up="z",
        )

    def observe(self, state: GripperState) -> Float[Array, " observation"]:
        """What the module's table lists."""
        ball = state.body["ball"]
        place, nodes = ball.positions[:, 0], state.body["fingers"].positions
        middle = nodes[:, :, self.n_elements // 2]
        return jnp.concatenate(
            [
                (place - _between(state)) / BALL,
                ball.velocities[:, 0] / BALL_SPEED,
                _height(state)[None] / LIFT,
                state.wrist / WRIST,
                state.controls[N_FINGERS:],
                state.controls[:N_FINGERS],
                jnp.ravel(nodes[:, :, -1] - place[None, :]) / BALL,
                jnp.ravel(middle - place[None, :]) / BALL,
            ]
        )

    def scripted_action(
        self, state: GripperState, params: GripperParams
    ) -> Float[Array, " action"]:
        """Down around the ball, close, wait, lift: the baseline to compare with.

        Args:
            state: Of the moment; its clock, the wrist and the ball are looked at.
            params: Traced parameters.
        """
        place = state.body["ball"].positions[:, 0]
        time = state.steps * CONTROL_PERIOD
        closed = jnp.where(time < 1.2, -0.5, 1.0)
        up = jnp.where(time < 2.2, LOWEST - HIGHEST, LOWEST - HIGHEST + 1.3 * LIFT)
        over = jnp.where(time < 1.2, place[:2], state.wrist[:2])
        missing = jnp.append(over, up) - state.wrist
        velocity = jnp.clip(missing / (2 * SPEED * CONTROL_PERIOD), -1, 1)
        return jnp.append(jnp.full(N_FINGERS, closed, place.dtype), velocity)


def _between(state: GripperState) -> Float[Array, "3"]:
    """The point between the fingers, below the wrist [m]."""
    return state.wrist + jnp.asarray([0.0, 0.0, HIGHEST - GRASP], state.wrist.dtype)


def _height(state: GripperState) -> Float[Array, ""]:
    """Of the ball over where it lay [m]."""
    return state.body["ball"].positions[2, 0] - BALL


def _score(state: GripperState) -> Float[Array, ""]:
    """Points, as the module's table gives them."""
    place = state.body["ball"].positions[:, 0]
    apart = vectors.safe_norm(vectors.split(place - _between(state)))
    start = HIGHEST - GRASP - BALL
    lowest = place - jnp.asarray([0.0, 0.0, BALL], place.dtype)
    tips = state.body["fingers"].positions[:, :, -1] - lowest[None, :]
    furthest = jnp.max(vectors.safe_norm(vectors.split(tips.T)))
    lifted = jnp.clip(_height(state) / LIFT, 0, 1)
    # Fingers that close above the ball gain nothing: they could not get around it.
    around = jnp.clip(1.5 - apart / BALL, 0, 1)
    closed = jnp.clip(1 - furthest / (2 * BALL), 0, 1)
    return 20 * (1 - apart / start) + 30 * around * closed + 50 * lifted


def gripper(
    variant: Variant = "clean",
    *,
    n_elements: int = 8,
    substeps: int | None = None,
    episode_length: int = 80,
    spread: float = 0.01,
) -> Gripper:
    """Makes the gripper.

    Args:
        variant: "clean", the only one: the library's own physics.
        n_elements: Elements of every finger, at least 4.
        substeps: Simulation steps per control step of 50 ms; by default 24 per element.
        episode_length: Control steps per episode.
        spread: Largest distance of the ball from the middle at the start, along x and
            along y, up to 0.03 m [m].

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    check_count("n_elements", n_elements, 4)
    steps = STEPS_PER_ELEMENT * n_elements if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    aside = float(check_array("spread", spread, [()], "m", non_negative=True))
    if aside > 0.03:
        raise ValueError(f"spread must be at most 0.03 m, got {aside:g} m")
    return Gripper(n_elements, steps, episode_length, aside)
