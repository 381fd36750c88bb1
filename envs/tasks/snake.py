r"""A snake crawls as fast as it can in a given direction by muscles along its body.

The snake lies on ground with anisotropic friction: it slides most easily forward, less
easily backward, and least easily sideways. Because of its scales the friction
coefficients have the ratio 1 : 1.5 : 2. Six control values, at equidistant points along
the body, set the moments of its muscles about the vertical, up to 4 mN m. They are
renewed every 50 ms. Between two control steps they change by 0.2 at most, linearly in
time. The reward of a control step is the displacement of the centre of mass along the
heading, in percent of the body's length, so the return of an episode is the distance
covered. An episode lasts 200 control steps (10 s). This is five periods of the gait
that Gazzola et al. (R. Soc. Open Sci. 5 (2018) 171628) found by optimising travelling
waves of moments; it is `scripted_action` here.

The snake begins straight and at rest, along x. The heading is along x too, or with
`turn` up to that angle to either side. Observed, in this order, with x along the
heading and everything divided by the unit in brackets:

| numbers | what |
|---:|---|
| 2 | velocity of the centre of mass along the heading and to its left [0.175 m/s] |
| 2 | cosine and sine of the angle from the heading to the line from tail to head [1] |
| 1 | turning rate of the body, the mean over its elements [1 rad/s] |
| 6 | curvature at the control points, to the left [10/m] |
| 6 | rate of this curvature [31.4/(m s)] |
| 6 | current control values [1] |

When a numerical health flag rises the snake is frozen at its last sound state, the
reward of the step is 0 and the episode is truncated. The snake has no self-contact: the
episode is terminated when its body crosses itself.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import RodState, angular_velocities
from jaxrod.actuation import limit_rate
from jaxrod.actuation.waves import b_spline_basis
from jaxrod.envs.checking import action_of_size, check_key, check_variant
from jaxrod.envs.protocol import Channel, Snapshot, Step
from jaxrod.envs.soft_bodies.snake_body import LENGTH, PERIOD, SnakeBody, snake_body
from jaxrod.envs.tasks.headings import along_heading, check_turn, drawn_heading
from jaxrod.structure import pytree
from jaxrod.validation import check_count


def crosses_itself(nodes: Float[Array, "2 n+1"]) -> Bool[Array, ""]:
    """Whether two non-neighbouring segments cross in their interiors.

    Args:
        nodes: Nodes of the line [m].
    """
    starts, ends = nodes[:, :-1], nodes[:, 1:]
    n = starts.shape[1]
    # Entry (i, j): side of segment i on which the start, or the end, of segment j lies.
    edge = ends - starts
    start_side = _side(edge, starts, starts)
    end_side = _side(edge, starts, ends)
    parted = start_side * end_side < 0
    apart = np.abs(np.arange(n)[:, None] - np.arange(n)[None, :]) > 1
    return jnp.any(parted & parted.T & apart)


def _side(
    edge: Float[Array, "2 n"], start: Float[Array, "2 n"], point: Float[Array, "2 m"]
) -> Float[Array, "n m"]:
    """Side of segment i on which point j lies: cross product edge x (point - start).

    Positive to the left of the segment, negative to its right [m^2].
    """
    x = point[0][None, :] - start[0][:, None]
    y = point[1][None, :] - start[1][:, None]
    return edge[0][:, None] * y - edge[1][:, None] * x


Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

CONTROL_PERIOD = 0.05
"""Time between actions [s]."""
N_CONTROLS = 6
STRONGEST = 4e-3
"""Moment of the muscles at a control point for a control value of one [N m]."""
LARGEST_RATE = 4.0
"""Largest rate of a control value [1/s]."""
STEPS_PER_ELEMENT = 7
"""Default number of simulation steps of a control step, per element. The time step is
then about 0.8 of the stability bound."""
SPEED = LENGTH / PERIOD
"""Unit of the velocity in the observation [m/s]."""
BEND = 10.0
"""Unit of the curvature in the observation [1/m]."""
BEND_RATE = 2 * math.pi / PERIOD * BEND
"""Unit of the rate of curvature in the observation [1/(m s)]."""
GAIT = (3.4e-3, 3.3e-3, 4.2e-3, 2.6e-3, 3.6e-3, 3.5e-3)
"""B-spline coefficients of the moment amplitude of the published gait, head first [N
m]."""


@pytree
class SnakeParams:
    """Parameters of the snake task; every number is a traced leaf."""

    body: SnakeBody
    """Parameters of the snake and of everything that acts on it."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    turn: Float[Array, ""]
    """Largest angle between heading and body at the start, either way [rad]."""


@pytree
class SnakeState:
    """State of the snake task."""

    body: RodState
    """State of the snake's body."""
    controls: Float[Array, "6"]
    """Current control values of the muscles, tail to head [1]."""
    heading: Float[Array, "2"]
    """Unit vector along which the snake should move."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Snake:
    """Task in which a snake crawls along a heading; made by `snake`."""

    n_elements: int
    substeps: int
    episode_length: int = 200
    turn: float = 0.0
    variant: Variant = "clean"
    name: str = "snake"

    observation_size = 2 + 2 + 1 + 3 * N_CONTROLS
    """23 numbers: motion, curvatures, their rates, and control values."""

    action_size = N_CONTROLS
    """6 numbers: a commanded control value per control point, tail to head."""

    observation_channels = (
        Channel(
            2,
            "velocity of the centre of mass: along the heading, to its left",
            f"{SPEED:g} m/s",
        ),
        Channel(2, "cosine and sine of the angle from the heading to the body", "1"),
        Channel(1, "turning rate of the body", "rad/s"),
        Channel(N_CONTROLS, "curvatures to the left, tail to head", f"{BEND:g} 1/m"),
        Channel(N_CONTROLS, "rates of these curvatures", f"{BEND_RATE:.3g} 1/(m s)"),
        Channel(N_CONTROLS, "current control values", "1"),
    )
    action_channels = (
        Channel(
            N_CONTROLS,
            "moments of the muscles, tail to head",
            f"{1e3 * STRONGEST:g} mN m",
        ),
    )

    control_period = CONTROL_PERIOD
    """Time between actions [s]."""

    def default_params(self) -> SnakeParams:
        """Default parameters of the task, in JAX's default precision."""
        change = LARGEST_RATE * CONTROL_PERIOD
        body = snake_body(self.n_elements, N_CONTROLS, STRONGEST, change)
        kind = body.rod.radii.dtype
        return SnakeParams(
            body=body,
            dt=jnp.asarray(CONTROL_PERIOD / self.substeps, kind),
            turn=jnp.asarray(self.turn, kind),
        )

    def reset(
        self, key: Key[Array, ""], params: SnakeParams
    ) -> tuple[Float[Array, " observation"], SnakeState]:
        """Starts with the snake straight and at rest, and draws the heading."""
        check_key(key)
        state = SnakeState(
            body=params.body.rest,
            controls=jnp.zeros(N_CONTROLS, params.dt.dtype),
            heading=drawn_heading(key, params.turn),
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state, params), state

    def step(
        self,
        key: Key[Array, ""],
        state: SnakeState,
        action: Float[Array, " action"],
        params: SnakeParams,
    ) -> Step:
        """Advances one control step; control values follow the action, rate-limited."""
        action = action_of_size(action, self.action_size)
        snake = params.body
        controls = limit_rate(
            state.controls, jnp.clip(action, -1, 1), snake.largest_change
        )
        body, flagged = snake.advance(
            state.body, state.controls, controls, params.dt, self.substeps
        )
        way = snake.centre(body) - snake.centre(state.body)
        forward = jnp.sum(way * state.heading)
        steps = state.steps + 1
        state = SnakeState(body, controls, state.heading, steps)
        info = {
            "distance": jnp.sum(snake.centre(body) * state.heading),
            "speed": forward / (self.substeps * params.dt),
            "flagged": flagged,
        }
        return (
            self.observe(state, params),
            state,
            jnp.where(flagged, 0, 100 / snake.rod.length * forward),
            crosses_itself(body.positions[:2]) & ~flagged,
            (steps >= self.episode_length) | flagged,
            info,
        )

    def snapshot(self, state: SnakeState, params: SnakeParams) -> Snapshot:
        """Snapshot of the snake; the readout is the distance along the heading."""
        way = jnp.sum(params.body.centre(state.body) * state.heading)
        return Snapshot(
            positions=state.body.positions,
            radii=params.body.rod.radii,
            readouts={"way along the heading [m]": way},
            up="z",
        )

    def observe(
        self, state: SnakeState, params: SnakeParams
    ) -> Float[Array, " observation"]:
        """Observation vector; the module's table lists its entries."""
        snake, body = params.body, state.body
        along = body.positions[:2, -1] - body.positions[:2, 0]
        # Head and tail may touch: the line between them then has no direction.
        length = jnp.sqrt(jnp.maximum(jnp.sum(along**2), (1e-3 * LENGTH) ** 2))
        length_of_joint = snake.rod.rest_lengths[0]
        every = self.n_elements // (N_CONTROLS + 1)
        spin = jnp.mean(angular_velocities(snake.rod, body)[0])
        bends = snake.bends(body) / BEND, snake.bend_rates(body) / BEND_RATE
        return jnp.concatenate(
            [
                along_heading(snake.centre_velocity(body), state.heading) / SPEED,
                along_heading(along, state.heading) / length,
                spin[None],
                *(bend[every - 1 :: every] / length_of_joint for bend in bends),
                state.controls,
            ]
        )

    def scripted_action(
        self, state: SnakeState, params: SnakeParams
    ) -> Float[Array, " action"]:
        """Scripted baseline: the published gait, straight ahead.

        A wave of moments runs from head to tail, with the snake's length as wavelength
        and a period of two seconds. Its amplitude along the body is the published
        B-spline, and grows from zero during the first period.

        Args:
            state: Current state; only its step count is used.
            params: Traced parameters.
        """
        from_head = 1 - np.arange(1, N_CONTROLS + 1) / (N_CONTROLS + 1)
        sizes = b_spline_basis(len(GAIT), from_head) @ np.asarray(GAIT)
        # Muscles reach their commanded values by the end of the control step.
        periods = (state.steps + 1) * (CONTROL_PERIOD / PERIOD)
        wave = jnp.sin(2 * jnp.pi * (periods - jnp.asarray(from_head)))
        share = jnp.clip(periods, 0, 1) / params.body.strongest
        return (share * jnp.asarray(sizes) * wave).astype(params.dt.dtype)


def snake(
    variant: Variant = "clean",
    *,
    n_elements: int = 21,
    substeps: int | None = None,
    episode_length: int = 200,
    turn: float = 0.0,
) -> Snake:
    """Makes the snake task; see the module docstring.

    Args:
        variant: "clean", the only one: the library's own physics.
        n_elements: Elements, a multiple of 7.
        substeps: Simulation steps per control step of 50 ms; by default 7 per element.
        episode_length: Control steps per episode.
        turn: Largest angle between heading and body at the start, either way, up to pi
            [rad].

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    check_count("n_elements", n_elements, N_CONTROLS + 1)
    if n_elements % (N_CONTROLS + 1):
        raise ValueError(f"n_elements must be a multiple of 7, got {n_elements}")
    steps = STEPS_PER_ELEMENT * n_elements if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    return Snake(n_elements, steps, episode_length, check_turn(turn))
