r"""A hand holds one end of a rope on the floor and brings the free end to a target.

The rope (0.5 m long, 39 g) begins straight and at rest on the floor, in any direction.
The hand begins on the floor too, up to 0.1 m from the middle along x and y. The target
is a point up to 0.2 m from the middle along x and y, and 0.05 m to 0.3 m above the
floor, so that nearly all of the rope must leave it. Actions are velocities of the hand
along x, y and z, up to 0.5 m/s, renewed every 0.1 s. The hand accelerates by 2.5 m/s^2
at most along each axis. It stays within 0.4 m of the middle along x and y, and below
0.9 m. An episode lasts 60 control steps (6 s).

**Success.** An episode is solved if it ends with the free end at the target: within 5 %
of the rope's length (0.025 m), for the last 0.5 s without a break.

The reward of a control step is the score after it divided by the number of control
steps of an episode, so the return is the mean score. With the distance $d$ of the free
end from the target, in metres, the score is

$$\frac{50}{1 + (d/0.25)^2} + \frac{50}{1 + (d/0.025)^2}.$$

Observed, in this order, with everything divided by the unit in brackets:

| numbers | what |
|---:|---|
| 3 | vector from the free end to the target [0.1 m] |
| 3 | vector from the hand to the target [0.5 m] |
| 3 | coordinates of the hand [1 m] |
| 3 | their velocities [0.5 m/s] |
| 12 | points a quarter, half, three quarters and all along, from the hand [0.5 m] |
| 12 | velocities of these points [0.5 m/s] |

When a numerical health flag rises everything is frozen at its last sound state, the
reward of the step is 0 and the episode is truncated.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import RodState
from jaxrod.envs.checking import check_key, check_variant
from jaxrod.envs.protocol import Channel, Snapshot
from jaxrod.envs.soft_bodies.hand import Hand
from jaxrod.envs.soft_bodies.held_rope import LENGTH, RADIUS, HeldRope, held_rope
from jaxrod.envs.tasks.arm_task import tip_residuals
from jaxrod.envs.tasks.hand_task import CONTROL_PERIOD, N_POINTS, HandTask
from jaxrod.structure import pytree
from jaxrod.validation import check_count

Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

STEPS_PER_ELEMENT = 12
"""Default number of simulation steps of a control step, per element. The time step is
then about 0.8 of the stability bound."""
LEAST_STEPS = 80
"""Smallest default number of simulation steps of a control step. With fewer than seven
elements the contact with the floor limits the time step more than the rope does."""
SPEED, ACCELERATION = 0.5, 2.5
"""Largest velocity [m/s] and acceleration [m/s^2] of the hand along each axis."""
ASIDE, HIGHEST = 0.4, 0.9
"""Largest distance of the hand from the middle along x and y, and its largest height
above the floor [m]."""
NEAR = 0.05 * LENGTH
"""Distance of the free end from the target within which it is there [m]."""
FAR = 0.25
"""Distance at which the first part of the score is halved [m]."""
CALM = 0.1
"""Time by which a plan's cost weighs the velocity of the free end [s]."""
ABOVE = 0.1
"""Distance of the hand from the place above the target that costs about one [m]."""
COST_WIDTH = 0.2
"""Distance beyond which a plan's cost grows linearly [m]."""


@pytree
class LiftParams:
    """Parameters of the lift task; every number is a traced leaf."""

    body: HeldRope
    """Parameters of the rope and of everything that acts on it."""
    hand: Hand
    """Ranges and limits of the hand's coordinates."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    start: Float[Array, "2"]
    """Largest distance of the hand from the middle at the start, along x and y [m]."""
    lower: Float[Array, "3"]
    """Smallest coordinates of the target [m]."""
    upper: Float[Array, "3"]
    """Largest coordinates of the target [m]."""


@pytree
class LiftState:
    """State of the lift task."""

    body: RodState
    """State of the rope."""
    coordinates: Float[Array, " coordinates"]
    """Coordinates of the hand."""
    velocity: Float[Array, " coordinates"]
    """Their velocities."""
    target: Float[Array, "3"]
    """Position to which the free end is to be brought [m]."""
    held: Int[Array, ""]
    """Control steps for which the free end has been at the target without a break."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Lift(HandTask):
    """Task in which a hand brings a rope's free end to a target; made by `lift`."""

    variant: Variant = "clean"
    name: str = "lift"

    observation_size = 6 + 2 * 3 + 6 * N_POINTS
    """36 numbers: target, hand, points of the rope and their velocities."""

    observation_channels = (
        Channel(3, "vector from the free end to the target: x, y, z", "0.1 m"),
        Channel(3, "vector from the hand to the target: x, y, z", f"{LENGTH:g} m"),
        Channel(3, "position of the hand: x, y, z", "m"),
        Channel(3, "velocity of the hand: x, y, z", f"{SPEED:g} m/s"),
        Channel(
            3 * N_POINTS,
            "points of the rope, from the hand: x of each, then y, then z",
            f"{LENGTH:g} m",
        ),
        Channel(
            3 * N_POINTS,
            "velocities of these points: x of each, then y, then z",
            f"{SPEED:g} m/s",
        ),
    )
    action_channels = (Channel(3, "velocity of the hand: x, y, z", f"{SPEED:g} m/s"),)

    def default_params(self) -> LiftParams:
        """Default parameters of the task, in JAX's default precision."""
        body = held_rope(self.n_elements)
        kind = body.rod.radii.dtype

        def numbers(*values: float) -> Array:
            return jnp.asarray(values, kind)

        return LiftParams(
            body=body,
            hand=Hand(
                lower=numbers(-ASIDE, -ASIDE, RADIUS),
                upper=numbers(ASIDE, ASIDE, HIGHEST),
                speed=numbers(SPEED, SPEED, SPEED),
                acceleration=numbers(ACCELERATION, ACCELERATION, ACCELERATION),
            ),
            dt=jnp.asarray(CONTROL_PERIOD / self.substeps, kind),
            start=numbers(0.1, 0.1),
            lower=numbers(-0.2, -0.2, 0.05),
            upper=numbers(0.2, 0.2, 0.3),
        )

    def reset(
        self, key: Key[Array, ""], params: LiftParams
    ) -> tuple[Float[Array, " observation"], LiftState]:
        """Starts with the rope straight on the floor, and draws the target."""
        check_key(key)
        kind = params.dt.dtype
        start_key, angle_key, target_key = jax.random.split(key, 3)
        aside = params.start * jax.random.uniform(start_key, (2,), kind, -1.0)
        point = jnp.concatenate([aside, jnp.asarray([RADIUS], kind)])
        coordinates = params.hand.reaching(point)
        angle = jax.random.uniform(angle_key, (), kind, -np.pi, np.pi)
        share = jax.random.uniform(target_key, (3,), kind)
        state = LiftState(
            body=params.body.lying(params.hand.place(coordinates), angle),
            coordinates=coordinates,
            velocity=jnp.zeros_like(coordinates),
            target=params.lower + share * (params.upper - params.lower),
            held=jnp.zeros((), jnp.int32),
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state, params), state

    def is_there(self, state: LiftState, params: LiftParams) -> Bool[Array, ""]:
        """Whether the free end is at the target."""
        del params
        return _distance(state) <= NEAR

    def judged(
        self, state: LiftState, params: LiftParams
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Score, and the distance of the free end from the target [m]."""
        del params
        distance = _distance(state)
        score = 50 / (1 + (distance / FAR) ** 2) + 50 / (1 + (distance / NEAR) ** 2)
        return score, {"distance": distance}

    def residuals(
        self, state: LiftState, action: Float[Array, " action"], params: LiftParams
    ) -> Float[Array, "9"]:
        """Residuals for planners: of the free end, its velocity, and the hand.

        The hand should be above the target by the length of the rope. This gives the
        cost a slope while the free end lies on the floor, whatever the hand does. It is
        smallest where the free end rests at the target, below the hand.
        """
        del action
        body, length = state.body, jnp.asarray([0.0, 0.0, LENGTH], params.dt.dtype)
        above = body.positions[:, 0] - state.target - length
        return jnp.concatenate(
            [
                tip_residuals(body.tip - state.target, NEAR, COST_WIDTH),
                CALM / NEAR * body.velocities[:, -1],
                tip_residuals(above, ABOVE, COST_WIDTH),
            ]
        )

    def snapshot(self, state: LiftState, params: LiftParams) -> Snapshot:
        """Snapshot of rope, hand and target, whose radius is the distance `NEAR`."""
        return Snapshot(
            positions=state.body.positions,
            radii=params.body.rod.radii,
            spheres=(
                (state.target, NEAR),
                (state.body.positions[:, 0], 2 * RADIUS),
            ),
            readouts={"distance to target [m]": _distance(state)},
            up="z",
        )

    def observe(
        self, state: LiftState, params: LiftParams
    ) -> Float[Array, " observation"]:
        """Observation vector; the module's table lists its entries."""
        place = state.body.positions[:, 0]
        points = self.points(place.dtype)
        along = state.body.positions - place[:, None]
        velocities = state.body.velocities
        return jnp.concatenate(
            [
                (state.target - state.body.tip) / 0.1,
                (state.target - place) / LENGTH,
                state.coordinates,
                state.velocity / SPEED,
                jnp.ravel(jnp.sum(along[:, None] * points, axis=-1)) / LENGTH,
                jnp.ravel(jnp.sum(velocities[:, None] * points, axis=-1)) / SPEED,
            ]
        )


def _distance(state: LiftState) -> Float[Array, ""]:
    """Distance of the free end from the target [m]."""
    squared = jnp.sum((state.body.tip - state.target) ** 2)
    return jnp.sqrt(jnp.maximum(squared, 1e-12))


def lift(
    variant: Variant = "clean",
    *,
    n_elements: int = 8,
    substeps: int | None = None,
    episode_length: int = 60,
) -> Lift:
    """Makes the task of lifting a rope; see the module docstring.

    Args:
        variant: "clean", the only one: the library's own physics.
        n_elements: Elements of the rope, at least 4.
        substeps: Simulation steps per control step of 0.1 s; by default 12 per element,
            and at least 80.
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    check_count("n_elements", n_elements, N_POINTS)
    usual = max(STEPS_PER_ELEMENT * n_elements, LEAST_STEPS)
    steps = usual if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    return Lift(n_elements, steps, episode_length)
