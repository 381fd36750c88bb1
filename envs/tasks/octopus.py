r"""An octopus crawls along the sea floor in a given direction by its eight arms.

Every arm has two control values: the curvatures, sideways and upwards, that its muscles
impose, up to 15/m. They are renewed every 0.1 s. Between two control steps they change
by 0.4 at most, linearly in time. The reward of a control step is the displacement of
the head along the heading, in percent of an arm's length, so the return of an episode
is the distance covered. An episode lasts 100 control steps (10 s).

The octopus begins at rest with straight arms, the first at 22.5 degrees from x. The
heading is along x, or with `turn` up to that angle to either side. Observed, in this
order, with x along the heading, z upwards and everything divided by the unit in
brackets:

| numbers | what |
|---:|---|
| 3 | velocity of the head [0.1 m/s] |
| 3 | angular velocity of the head [1 rad/s] |
| 4 | the head's x axis, then its z axis, each along the heading and to its left [1] |
| 1 | height of the head's centre above its height at the start [0.03 m] |
| 24 | arm by arm, position of the tip from the head's centre [0.2 m] |
| 16 | arm by arm, current control values [1] |

When a numerical health flag rises the octopus is frozen at its last sound state, the
reward of the step is 0 and the episode is truncated. Arms touch neither each other nor
the head.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxrod.actuation import limit_rate
from jaxrod.envs.checking import action_of_size, check_key, check_variant
from jaxrod.envs.protocol import Channel, Snapshot, Step
from jaxrod.envs.soft_bodies.octopus_body import (
    HEAD,
    LENGTH,
    N_ARMS,
    OctopusBody,
    octopus_body,
)
from jaxrod.envs.tasks.headings import along_heading, check_turn, drawn_heading
from jaxrod.structure import pytree
from jaxrod.systems.stepping.assembly import SystemState
from jaxrod.validation import check_count

Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

CONTROL_PERIOD = 0.1
"""Time between actions [s]."""
LARGEST_RATE = 4.0
"""Largest rate of a control value [1/s]."""
STEPS_PER_ELEMENT = 7
"""Default number of simulation steps of a control step, per element of an arm. The time
step is then about 0.8 of the stability bound."""
LEAST_STEPS = 37
"""Smallest default number of simulation steps of a control step. With fewer than six
elements the contact of the tips with the floor limits the time step more than the arms
do."""
SPEED = 0.1
"""Unit of the velocities in the observation [m/s]."""
STROKE = (4.0, 1.0, 0.5)
"""Period [s], and amplitudes of the control values sideways and upwards [1], of the
scripted stroke: the best of 24 that were tried, with periods of 1 to 4 s."""


@pytree
class OctopusParams:
    """Parameters of the octopus task; every number is a traced leaf."""

    body: OctopusBody
    """Parameters of the octopus and of everything that acts on it."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    turn: Float[Array, ""]
    """Largest angle of the heading from x, either way [rad]."""
    stroke: Float[Array, "3"]
    """Scripted baseline: period [s], amplitudes sideways and upwards [1]."""


@pytree
class OctopusState:
    """State of the octopus task."""

    body: SystemState
    """States of arms and head."""
    controls: Float[Array, "8 2"]
    """Current control values of each arm, sideways and upwards [1]."""
    heading: Float[Array, "2"]
    """Unit vector along which the octopus should move."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Octopus:
    """Task in which an octopus crawls along a heading; made by `octopus`."""

    n_elements: int
    substeps: int
    episode_length: int = 100
    turn: float = 0.0
    variant: Variant = "clean"
    name: str = "octopus"

    observation_size = 3 + 3 + 4 + 1 + 3 * N_ARMS + 2 * N_ARMS
    """51 numbers: motion and orientation of the head, tips of the arms, control
    values."""

    action_size = 2 * N_ARMS
    """16 numbers: commanded curvatures of each arm, sideways and upwards."""

    observation_channels = (
        Channel(
            3,
            "velocity of the head: along the heading, to its left, up",
            f"{SPEED:g} m/s",
        ),
        Channel(3, "angular velocity of the head, in the same axes", "rad/s"),
        Channel(4, "x axis, then z axis of the head: along the heading, left", "1"),
        Channel(1, "height of the head above its start", f"{HEAD:g} m"),
        Channel(
            3 * N_ARMS,
            "arm by arm, position of the tip from the head's centre, in the same axes",
            f"{LENGTH:g} m",
        ),
        Channel(2 * N_ARMS, "current control values", "1"),
    )
    action_channels = (
        Channel(
            2 * N_ARMS,
            "arm by arm, curvature of the muscles: sideways, upwards",
            "15 1/m",
        ),
    )

    control_period = CONTROL_PERIOD
    """Time between actions [s]."""

    def default_params(self) -> OctopusParams:
        """Default parameters of the task, in JAX's default precision."""
        body = octopus_body(self.n_elements, LARGEST_RATE * CONTROL_PERIOD)
        kind = body.angles.dtype
        return OctopusParams(
            body=body,
            dt=jnp.asarray(CONTROL_PERIOD / self.substeps, kind),
            turn=jnp.asarray(self.turn, kind),
            stroke=jnp.asarray(STROKE, kind),
        )

    def reset(
        self, key: Key[Array, ""], params: OctopusParams
    ) -> tuple[Float[Array, " observation"], OctopusState]:
        """Starts with the octopus at rest, and draws the heading."""
        check_key(key)
        state = OctopusState(
            body=params.body.rest,
            controls=jnp.zeros((N_ARMS, 2), params.dt.dtype),
            heading=drawn_heading(key, params.turn),
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state), state

    def step(
        self,
        key: Key[Array, ""],
        state: OctopusState,
        action: Float[Array, " action"],
        params: OctopusParams,
    ) -> Step:
        """Advances one control step; control values follow the action, rate-limited."""
        action = action_of_size(action, self.action_size)
        wanted = jnp.reshape(jnp.clip(action, -1, 1), (N_ARMS, 2))
        controls = limit_rate(state.controls, wanted, params.body.largest_change)
        body, flagged = params.body.advance(
            state.body, state.controls, controls, params.dt, self.substeps
        )
        way = body["head"].positions[:2, 0] - state.body["head"].positions[:2, 0]
        forward = jnp.sum(way * state.heading)
        steps = state.steps + 1
        state = OctopusState(body, controls, state.heading, steps)
        info = {
            "distance": jnp.sum(body["head"].positions[:2, 0] * state.heading),
            "speed": forward / (self.substeps * params.dt),
            "flagged": flagged,
        }
        return (
            self.observe(state),
            state,
            jnp.where(flagged, 0, 100 / LENGTH * forward),
            jnp.zeros((), bool),
            (steps >= self.episode_length) | flagged,
            info,
        )

    def snapshot(self, state: OctopusState, params: OctopusParams) -> Snapshot:
        """Snapshot of arms and head; the readout is the distance along the heading."""
        place = state.body["head"].positions[:, 0]
        way = jnp.sum(place[:2] * state.heading)
        return Snapshot(
            positions=state.body["arms"].positions,
            radii=params.body.arms.rod.radii,
            spheres=((place, HEAD),),
            readouts={"way along the heading [m]": way},
            up="z",
        )

    def observe(self, state: OctopusState) -> Float[Array, " observation"]:
        """Observation vector; the module's table lists its entries."""
        head, arms, heading = state.body["head"], state.body["arms"], state.heading
        place, axes = head.positions[:, 0], head.directors[..., 0]
        tips = (arms.positions[:, :, -1] - place[None, :]).T
        return jnp.concatenate(
            [
                along_heading(head.velocities[:, 0], heading) / SPEED,
                along_heading(head.angular_velocities[:, 0], heading),
                along_heading(axes[0], heading)[:2],
                along_heading(axes[2], heading)[:2],
                place[2:] / HEAD - 1,
                jnp.ravel(along_heading(tips, heading).T) / LENGTH,
                jnp.ravel(state.controls),
            ]
        )

    def scripted_action(
        self, state: OctopusState, params: OctopusParams
    ) -> Float[Array, " action"]:
        """Scripted baseline: arms row backwards on the floor, and forwards above it.

        All arms have the same period. The amplitude of an arm's sideways sweep is in
        proportion to how far it points to the side of the heading. The stroke only goes
        straight ahead.

        Args:
            state: Current state; only step count and heading are used.
            params: Traced parameters.
        """
        period, sideways, upwards = params.stroke
        along, left = state.heading
        angles = params.body.angles
        to_left = along * jnp.sin(angles) - left * jnp.cos(angles)
        phase = 2 * jnp.pi * (state.steps + 1) * (CONTROL_PERIOD / period)
        sweep = sideways * to_left * jnp.sin(phase)
        lift = -upwards * jnp.cos(phase) * jnp.ones_like(angles)
        return jnp.ravel(jnp.stack([sweep, lift], axis=1))


def octopus(
    variant: Variant = "clean",
    *,
    n_elements: int = 6,
    substeps: int | None = None,
    episode_length: int = 100,
    turn: float = 0.0,
) -> Octopus:
    """Makes the octopus task; see the module docstring.

    Args:
        variant: "clean", the only one: the library's own physics.
        n_elements: Elements of every arm, at least 3.
        substeps: Simulation steps per control step of 0.1 s; by default 7 per element,
            and at least 37.
        episode_length: Control steps per episode.
        turn: Largest angle of the heading from x, either way, up to pi [rad].

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    check_count("n_elements", n_elements, 3)
    usual = max(STEPS_PER_ELEMENT * n_elements, LEAST_STEPS)
    steps = usual if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    return Octopus(n_elements, steps, episode_length, check_turn(turn))
