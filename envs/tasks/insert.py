r"""A hand pushes the tip of a soft cable into a socket on the floor.

The cable (0.2 m long, 16 mm thick, 40 g) hangs straight and at rest from the hand,
which clamps its upper end. The hand begins up to 0.1 m from the middle along x and y,
and 0.3 m to 0.35 m above the floor. The socket is a pipe that stands on the floor, up
to 0.1 m from the middle along x and y. Its bore is 22 mm wide, its length 50 mm, and it
leans by up to 0.2 of its height along x and along y. Only contact keeps the cable out
of its wall. Actions are velocities of the hand along x, y and z, up to 0.3 m/s, renewed
every 0.1 s. The hand accelerates by 1.5 m/s^2 at most along each axis. It stays within
0.2 m of the middle along x and y, and between 0.15 m and 0.4 m above the floor, and
does not turn. An episode lasts 60 control steps (6 s).

**Success.** An episode is solved if it ends with the tip in the socket for the last
0.5 s without a break: its centre at least 30 mm below the mouth, measured along the
axis of the socket, inside the bore, and the last element within 0.15 rad of this axis.

The reward of a control step is the score after it divided by the number of control
steps of an episode, so the return is the mean score. With the distance $\rho$ of the
tip from the axis, its depth $s$ below the mouth and the angle $\theta$ of the last
element to the axis, the score is

$$\frac{20}{1 + (d/0.1)^2}
  + \frac{1}{1 + (d/0.02)^2}\Bigl(40 + \frac{40}{1 + (\theta/0.15)^2}\Bigr),$$

$$d = \sqrt{\rho^2 + \max(0.035 - s, 0)^2}
  + 2\,\frac{\rho^4}{\rho^4 + 0.008^4}\,\max(s + 0.02, 0).$$

The second part of $d$, in metres, is for a tip that is too low beside the socket.

Observed, in this order, with everything divided by the unit in brackets:

| numbers | what |
|---:|---|
| 3 | vector from the tip to the mouth [0.05 m] |
| 2 | x and y of the socket's axis, from the mouth downwards [0.2] |
| 3 | vector from the hand to the mouth [0.2 m] |
| 3 | coordinates of the hand [0.2 m] |
| 3 | their velocities [0.3 m/s] |
| 3 | direction of the last element [1] |
| 12 | points a quarter, half, three quarters and all along, from the hand [0.2 m] |
| 12 | velocities of these points [0.3 m/s] |

When a numerical health flag rises everything is frozen at its last sound state, the
reward of the step is 0 and the episode is truncated.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import RodState
from jaxrod.envs.checking import check_key, check_variant
from jaxrod.envs.protocol import Channel, Snapshot
from jaxrod.envs.soft_bodies.hand import Hand
from jaxrod.envs.soft_bodies.held_cable import (
    BORE,
    HIGH,
    LENGTH,
    RADIUS,
    WALL,
    HeldCable,
    held_cable,
)
from jaxrod.envs.tasks.arm_task import tip_residuals
from jaxrod.envs.tasks.hand_task import CONTROL_PERIOD, N_POINTS, HandTask
from jaxrod.structure import pytree
from jaxrod.validation import check_count

Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

STEPS_PER_ELEMENT = 52
"""Default number of simulation steps of a control step, per element. The time step is
then about 0.85 of the stability bound."""
SPEED, ACCELERATION = 0.3, 1.5
"""Largest velocity [m/s] and acceleration [m/s^2] of the hand along each axis."""
ASIDE, LOWEST, HIGHEST = 0.2, 0.15, 0.4
"""Largest distance of the hand from the middle along x and y, and its smallest and
largest height above the floor [m]."""
DEEP = 0.03
"""Depth of the tip below the mouth from which it is in the socket [m]."""
STRAIGHT = 0.15
"""Largest angle of the last element to the socket's axis [rad]."""
GOAL = 0.035
"""Depth at which score and cost are best [m]."""
HOVER = 0.02
"""Height above the mouth up to which the tip may be beside the axis [m]."""
ASTRAY = 0.008
"""Distance from the axis from which a tip near the mouth is beside the socket [m]."""
FAR, NEAR = 0.1, 0.02
"""Distances at which the parts of the score are halved [m]."""
CENTRED = 0.005
"""Distance of the tip from the axis that costs a plan about one [m]."""
COST_WIDTH = 0.05
"""Distance beyond which a plan's cost grows linearly [m]."""


@pytree
class InsertParams:
    """Parameters of the insertion task; every number is a traced leaf."""

    body: HeldCable
    """Parameters of the cable and of everything that acts on it."""
    hand: Hand
    """Ranges and limits of the hand's coordinates."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    lower: Float[Array, "3"]
    """Smallest coordinates of the hand at the start [m]."""
    upper: Float[Array, "3"]
    """Largest coordinates of the hand at the start [m]."""
    spread: Float[Array, "2"]
    """Largest distance of the socket's foot from the middle along x and y [m]."""
    lean: Float[Array, "2"]
    """Largest lean of the socket along x and y, as a part of its height [1]."""


@pytree
class InsertState:
    """State of the insertion task."""

    body: RodState
    """State of the cable."""
    coordinates: Float[Array, " coordinates"]
    """Coordinates of the hand."""
    velocity: Float[Array, " coordinates"]
    """Their velocities."""
    mouth: Float[Array, "3"]
    """Centre of the socket's upper end [m]."""
    inwards: Float[Array, "3"]
    """Unit vector along the socket's axis, from the mouth downwards."""
    held: Int[Array, ""]
    """Control steps for which the tip has been in the socket without a break."""
    steps: Int[Array, ""]
    """Control steps since reset."""


class Place(NamedTuple):
    """The tip as seen from the socket."""

    depth: Float[Array, ""]
    """Depth of the tip below the mouth, along the axis [m]."""
    across: Float[Array, "3"]
    """Vector from the axis to the tip [m]."""
    offset: Float[Array, ""]
    """Length of this vector [m]."""
    angle: Float[Array, ""]
    """Angle of the last element to the axis [rad]."""


@dataclasses.dataclass(frozen=True)
class Insert(HandTask):
    """Task in which a hand pushes a cable into a socket; made by `insert`."""

    variant: Variant = "clean"
    name: str = "insert"

    observation_size = 17 + 6 * N_POINTS
    """41 numbers: socket, hand, points of the cable and their velocities."""

    observation_channels = (
        Channel(3, "vector from the tip to the mouth: x, y, z", "0.05 m"),
        Channel(2, "axis of the socket, from the mouth downwards: x, y", "0.2"),
        Channel(3, "vector from the hand to the mouth: x, y, z", f"{LENGTH:g} m"),
        Channel(3, "position of the hand: x, y, z", f"{LENGTH:g} m"),
        Channel(3, "velocity of the hand: x, y, z", f"{SPEED:g} m/s"),
        Channel(3, "direction of the last element: x, y, z", "1"),
        Channel(
            3 * N_POINTS,
            "points of the cable, from the hand: x of each, then y, then z",
            f"{LENGTH:g} m",
        ),
        Channel(
            3 * N_POINTS,
            "velocities of these points: x of each, then y, then z",
            f"{SPEED:g} m/s",
        ),
    )
    action_channels = (Channel(3, "velocity of the hand: x, y, z", f"{SPEED:g} m/s"),)

    def default_params(self) -> InsertParams:
        """Default parameters of the task, in JAX's default precision."""
        body = held_cable(self.n_elements)
        kind = body.rod.radii.dtype

        def numbers(*values: float) -> Array:
            return jnp.asarray(values, kind)

        return InsertParams(
            body=body,
            hand=Hand(
                lower=numbers(-ASIDE, -ASIDE, LOWEST),
                upper=numbers(ASIDE, ASIDE, HIGHEST),
                speed=numbers(SPEED, SPEED, SPEED),
                acceleration=numbers(ACCELERATION, ACCELERATION, ACCELERATION),
            ),
            dt=jnp.asarray(CONTROL_PERIOD / self.substeps, kind),
            lower=numbers(-0.1, -0.1, 0.3),
            upper=numbers(0.1, 0.1, 0.35),
            spread=numbers(0.1, 0.1),
            lean=numbers(0.2, 0.2),
        )

    def reset(
        self, key: Key[Array, ""], params: InsertParams
    ) -> tuple[Float[Array, " observation"], InsertState]:
        """Starts with the cable straight down and at rest, and draws the socket."""
        check_key(key)
        kind = params.dt.dtype
        start_key, foot_key, lean_key = jax.random.split(key, 3)
        share = jax.random.uniform(start_key, (3,), kind)
        point = params.lower + share * (params.upper - params.lower)
        coordinates = params.hand.reaching(point)
        foot = params.spread * jax.random.uniform(foot_key, (2,), kind, -1.0)
        lean = params.lean * jax.random.uniform(lean_key, (2,), kind, -1.0)
        upwards = jnp.concatenate([lean, jnp.ones(1, kind)])
        upwards = upwards / jnp.sqrt(jnp.sum(upwards**2))
        state = InsertState(
            body=params.body.hanging(params.hand.place(coordinates)),
            coordinates=coordinates,
            velocity=jnp.zeros_like(coordinates),
            mouth=jnp.concatenate([foot, jnp.zeros(1, kind)]) + HIGH * upwards,
            inwards=-upwards,
            held=jnp.zeros((), jnp.int32),
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state, params), state

    def body_in(self, state: InsertState, params: InsertParams) -> HeldCable:
        """The cable, and the socket where it stands in this episode."""
        return params.body.above(state.mouth, state.inwards)

    def is_there(self, state: InsertState, params: InsertParams) -> Bool[Array, ""]:
        """Whether the tip is in the socket, deep and straight enough."""
        del params
        seen = _place(state)
        inside = (seen.offset <= BORE) & (seen.depth <= HIGH)
        return inside & (seen.depth >= DEEP) & (seen.angle <= STRAIGHT)

    def judged(
        self, state: InsertState, params: InsertParams
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Score, and depth, offset and angle of the tip in the socket [m, m, rad]."""
        del params
        seen = _place(state)
        ahead = jnp.maximum(GOAL - seen.depth, 0)
        way = jnp.sqrt(seen.offset**2 + ahead**2) + 2 * _beside(seen)
        near = 1 / (1 + (way / NEAR) ** 2)
        aligned = 1 / (1 + (seen.angle / STRAIGHT) ** 2)
        score = 20 / (1 + (way / FAR) ** 2) + near * (40 + 40 * aligned)
        told = {"depth": seen.depth, "offset": seen.offset, "angle": seen.angle}
        return score, told

    def residuals(
        self, state: InsertState, action: Float[Array, " action"], params: InsertParams
    ) -> Float[Array, "7"]:
        """Residuals for planners: offset, depth, tip beside the socket, and direction.

        The cost is smallest where the tip is straight in the socket.
        """
        del action, params
        seen = _place(state)
        ahead = (GOAL - seen.depth) * state.inwards
        last = state.body.directors[2, :, -1] - state.inwards
        return jnp.concatenate(
            [
                tip_residuals(seen.across, CENTRED, COST_WIDTH)
                + tip_residuals(ahead, 2 * CENTRED, COST_WIDTH),
                _beside(seen)[None] / CENTRED,
                last / STRAIGHT,
            ]
        )

    def snapshot(self, state: InsertState, params: InsertParams) -> Snapshot:
        """Snapshot of cable, hand, and socket, whose outer surface is a cylinder."""
        seen = _place(state)
        foot = state.mouth + HIGH * state.inwards
        return Snapshot(
            positions=state.body.positions,
            radii=params.body.rod.radii,
            spheres=((state.body.positions[:, 0], 2 * RADIUS),),
            cylinders=((foot, state.mouth, BORE + WALL),),
            readouts={"depth in the socket [m]": seen.depth},
            up="z",
        )

    def observe(
        self, state: InsertState, params: InsertParams
    ) -> Float[Array, " observation"]:
        """Observation vector; the module's table lists its entries."""
        del params
        place = state.body.positions[:, 0]
        points = self.points(place.dtype)
        along = state.body.positions - place[:, None]
        velocities = state.body.velocities
        return jnp.concatenate(
            [
                (state.mouth - state.body.tip) / 0.05,
                state.inwards[:2] / 0.2,
                (state.mouth - place) / LENGTH,
                state.coordinates / LENGTH,
                state.velocity / SPEED,
                state.body.directors[2, :, -1],
                jnp.ravel(jnp.sum(along[:, None] * points, axis=-1)) / LENGTH,
                jnp.ravel(jnp.sum(velocities[:, None] * points, axis=-1)) / SPEED,
            ]
        )


def _place(state: InsertState) -> Place:
    """The tip as seen from the socket."""
    way = state.body.tip - state.mouth
    depth = jnp.sum(way * state.inwards)
    across = way - depth * state.inwards
    offset = jnp.sqrt(jnp.maximum(jnp.sum(across**2), 1e-12))
    # The chord of the two unit vectors: a cosine near one has no precision left.
    apart = state.body.directors[2, :, -1] - state.inwards
    chord = jnp.sqrt(jnp.maximum(jnp.sum(apart**2), 1e-12))
    angle = 2 * jnp.arcsin(jnp.minimum(0.5 * chord, 0.999))
    return Place(depth, across, offset, angle)


def _beside(seen: Place) -> Float[Array, ""]:
    """Part of the way by which the tip is too low beside the socket [m]."""
    fourth = seen.offset**4
    return fourth / (fourth + ASTRAY**4) * jnp.maximum(seen.depth + HOVER, 0)


def insert(
    variant: Variant = "clean",
    *,
    n_elements: int = 6,
    substeps: int | None = None,
    episode_length: int = 60,
) -> Insert:
    """Makes the task of pushing a cable into a socket; see the module docstring.

    Args:
        variant: "clean", the only one: the library's own physics.
        n_elements: Elements of the cable, at least 6: contact points half an element
            apart must not let the wall of the socket slip through between them.
        substeps: Simulation steps per control step of 0.1 s; by default 52 per element.
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    check_count("n_elements", n_elements, 6)
    steps = STEPS_PER_ELEMENT * n_elements if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    return Insert(n_elements, steps, episode_length)
