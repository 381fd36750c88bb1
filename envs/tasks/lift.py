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
from jaxrod.envs.checking import action_of_size, check_variant
from jaxrod.envs.protocol import Channel, Snapshot, Step
from jaxrod.envs.soft_bodies.hand import Glide, Hand
from jaxrod.envs.soft_bodies.held_rope import LENGTH, RADIUS, HeldRope, held_rope
from jaxrod.envs.tasks.arm_task import tip_residuals
from jaxrod.structure import pytree
from jaxrod.validation import check_count

Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

CONTROL_PERIOD = 0.1
"""Time between actions [s]."""
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
HELD_STEPS = 5
"""Control steps at the end of an episode during which it must be there."""
FAR = 0.25
"""Distance at which the first part of the score is halved [m]."""
CALM = 0.1
"""Time by which a plan's cost weighs the velocity of the free end [s]."""
ABOVE = 0.1
"""Distance of the hand from the place above the target that costs about one [m]."""
COST_WIDTH = 0.2
"""Distance beyond which a plan's cost grows linearly [m]."""
N_POINTS = 4
"""Number of observed points along the rope."""


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
class Lift:
    """Task in which a hand brings a rope's free end to a target; made by `lift`."""

    n_elements: int
    substeps: int
    episode_length: int = 60
    variant: Variant = "clean"
    name: str = "lift"

    observation_size = 6 + 2 * 3 + 6 * N_POINTS
    """36 numbers: target, hand, points of the rope and their velocities."""

    action_size = 3
    """3 numbers: velocity of the hand along x, y and z."""

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

    control_period = CONTROL_PERIOD
    """Time between actions [s]."""

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

    def step(
        self,
        key: Key[Array, ""],
        state: LiftState,
        action: Float[Array, " action"],
        params: LiftParams,
    ) -> Step:
        """Advances one control step; the hand's velocity follows the action."""
        state, flagged = self.moved(state, action, params)
        distance = _distance(state)
        score = 50 / (1 + (distance / FAR) ** 2) + 50 / (1 + (distance / NEAR) ** 2)
        info = {
            "distance": distance,
            "score": score,
            "success": (state.held >= HELD_STEPS).astype(score.dtype),
            "flagged": flagged,
        }
        return (
            self.observe(state, params),
            state,
            jnp.where(flagged, 0, score / self.episode_length),
            jnp.zeros((), bool),
            (state.steps >= self.episode_length) | flagged,
            info,
        )

    def moved(
        self, state: LiftState, action: Float[Array, " action"], params: LiftParams
    ) -> tuple[LiftState, Bool[Array, ""]]:
        """Returns the state one control step later, and whether a health flag rose."""
        action = action_of_size(action, self.action_size)
        hand, period = params.hand, self.substeps * params.dt
        coordinates, velocity = hand.moved(
            state.coordinates, state.velocity, action, period
        )
        first, first_velocity = _carried(hand, state.coordinates, state.velocity)
        last, last_velocity = _carried(hand, coordinates, velocity)
        path = Glide(first, last, first_velocity, last_velocity, period)
        body, flagged = params.body.advance(state.body, path, params.dt, self.substeps)
        # The hand is frozen with the rope: a NaN action must not reach it.
        after = LiftState(
            body=body,
            coordinates=jnp.where(flagged, state.coordinates, coordinates),
            velocity=jnp.where(flagged, state.velocity, velocity),
            target=state.target,
            held=state.held,
            steps=state.steps + 1,
        )
        there = (_distance(after) <= NEAR) & ~flagged
        held = jnp.where(there, state.held + 1, 0)
        return dataclasses.replace(after, held=held), flagged

    def predict(
        self,
        state: LiftState,
        action: Float[Array, " action"],
        params: LiftParams,
        control_steps: int = 1,
    ) -> LiftState:
        """Predicts the state under a held action; nothing in this task is random.

        Args:
            state: Current state.
            action: In [-1, 1].
            params: Parameters of the task.
            control_steps: Number of control steps for which the action is held.
        """

        def again(state: LiftState, _: None) -> tuple[LiftState, None]:
            return self.moved(state, action, params)[0], None

        return jax.lax.scan(again, state, length=control_steps)[0]

    def residuals(
        self, state: LiftState, action: Float[Array, " action"], params: LiftParams
    ) -> Float[Array, "9"]:
        """Residuals for planners: of the free end, its velocity, and the hand.

        The hand should be above the target by the length of the rope. This gives the
        cost a slope while the free end lies on the floor, whatever the hand does.
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

    def cost(
        self, state: LiftState, action: Float[Array, " action"], params: LiftParams
    ) -> Float[Array, ""]:
        """Smooth cost for planners: sum of the squared residuals [1].

        It is smallest where the free end rests at the target, below the hand.
        """
        return jnp.sum(self.residuals(state, action, params) ** 2)

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
        points = jnp.asarray(self._points()[None], place.dtype)
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

    def _points(self) -> np.ndarray:
        """Weights that interpolate node values at the points, (points, n+1)."""
        nodes = np.linspace(0.0, 1.0, self.n_elements + 1)
        points = np.arange(1, N_POINTS + 1) / N_POINTS
        return np.maximum(1 - self.n_elements * np.abs(points[:, None] - nodes), 0)


def _carried(hand: Hand, coordinates: Array, velocity: Array) -> tuple[Array, Array]:
    """Position and velocity of the held end, world frame [m, m/s]."""
    place, change = jax.jvp(hand.place, (coordinates,), (velocity,))
    return place, change


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
