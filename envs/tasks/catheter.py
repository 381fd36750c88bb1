r"""A catheter is steered into one of three branches of a vessel.

The catheter (140 mm long, 4 mm thick) begins straight and at rest in the trunk of the
vessel, whose fork is 20 mm to 30 mm ahead of the tip. Its base is pushed along the
trunk and turned about it, and the last 30 mm bend in one direction, which turns with
the catheter. The branch into which it is to go and the turn of the base are drawn for
each episode, and so is the way to the fork. Actions are three velocities, renewed every
0.1 s: of the base along the trunk (0.05 m/s at most), of its turn (3 rad/s), and of the
angle by which the tip would bend if it were free (2 rad/s). Each reaches its largest
value in 0.2 s at the soonest. The base stays within 90 mm, turns by up to one and a
half turns from the middle, and the angle is 0 to 1.2 rad. An episode lasts 60 control
steps (6 s).

**Success.** An episode is solved if it ends with the tip in its branch for the last
0.5 s without a break: at least 30 mm from the fork, measured along the axis of the
branch, and no farther from this axis than the wall, 4.5 mm.

The reward of a control step is the score after it divided by the number of control
steps of an episode, so the return is the mean score. The goal is the point of the axis
40 mm from the fork. With the distance $d$ of the tip from it, in metres, the score is

$$\frac{50}{1 + (d/0.03)^2} + \frac{50}{1 + (d/0.01)^2}.$$

Observed, in this order, with everything divided by the unit in brackets. Vectors have
three components, one along the trunk, and two across it, which turn with the base:

| numbers | what |
|---:|---|
| 3 | vector from the tip to the goal [0.05 m] |
| 3 | direction of the branch [1] |
| 3 | direction of the last element [1] |
| 3 | direction towards which the tip bends, d1 of the last element [1] |
| 3 | velocity of the tip [0.05 m/s] |
| 3 | way of the base, its turn, and the angle of the tip [0.09 m, 3 pi, 1.2 rad] |
| 3 | their velocities [0.05 m/s, 3 rad/s, 2 rad/s] |

When a numerical health flag rises everything is frozen at its last sound state, the
reward of the step is 0 and the episode is truncated.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import RodState
from jaxrod.envs.checking import check_key, check_variant
from jaxrod.envs.protocol import Channel, Snapshot
from jaxrod.envs.soft_bodies.branching_vessel import (
    BACK,
    BRANCH_LENGTH,
    BRANCH_LUMEN,
    FORK,
    N_BRANCHES,
    branch_directions,
)
from jaxrod.envs.soft_bodies.hand import Hand
from jaxrod.envs.soft_bodies.steered_catheter import (
    FURTHEST,
    MOST_BEND,
    MOST_TURN,
    SteeredCatheter,
    steered_catheter,
)
from jaxrod.envs.tasks.arm_task import tip_residuals
from jaxrod.envs.tasks.hand_task import CONTROL_PERIOD, HandTask
from jaxrod.structure import pytree
from jaxrod.validation import check_count

Variant = Literal["clean"]
VARIANTS: tuple[Variant, ...] = ("clean",)

STEPS_PER_ELEMENT = 50
"""Default number of simulation steps of a control step, per element. The time step is
then below `jaxrod.stable_dt`, which is 0.8 of the stability bound."""
SPEEDS = (0.05, 3.0, 2.0)
"""Largest velocities of the coordinates of the drive [m/s, rad/s, rad/s]."""
RISE = 0.2
"""Time in which a velocity rises from zero to its largest value [s]."""
DEEP = 0.03
"""Distance of the tip from the fork, along the axis of its branch, from which it is in
the branch [m]."""
GOAL = 0.04
"""Distance of the goal from the fork [m]."""
FAR, NEAR = 0.03, 0.01
"""Distances from the goal at which the parts of the score are halved [m]."""
COST_WIDTH = 0.03
"""Distance from the goal beyond which a plan's cost grows linearly [m]."""
AXIS_RADIUS = 0.0005
"""Radius of the lines with which the axes of the vessel are drawn [m]."""


@pytree
class CatheterParams:
    """Parameters of the catheter task; every number is a traced leaf."""

    body: SteeredCatheter
    """Parameters of the catheter and of everything that acts on it."""
    hand: Hand
    """Ranges and limits of the coordinates of the drive."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    ahead: Float[Array, ""]
    """Largest way of the base at the start [m]."""
    turned: Float[Array, ""]
    """Largest turn of the base at the start, either way [rad]."""
    fork: Float[Array, "3"]
    """Position of the fork [m]."""
    branches: Float[Array, "3 branches"]
    """Unit vectors along the branches, from the fork."""


@pytree
class CatheterState:
    """State of the catheter task."""

    body: RodState
    """State of the catheter."""
    coordinates: Float[Array, " coordinates"]
    """Coordinates of the drive: way and turn of the base, and angle of the tip."""
    velocity: Float[Array, " coordinates"]
    """Their velocities."""
    branch: Float[Array, "3"]
    """Unit vector along the branch that was drawn."""
    held: Int[Array, ""]
    """Control steps for which the tip has been in the branch without a break."""
    steps: Int[Array, ""]
    """Control steps since reset."""


class Place(NamedTuple):
    """The tip as seen from the branch that was drawn."""

    depth: Float[Array, ""]
    """Distance of the tip from the fork, along the axis of the branch [m]."""
    offset: Float[Array, ""]
    """Distance of the tip from this axis [m]."""
    distance: Float[Array, ""]
    """Distance of the tip from the goal [m]."""


@dataclasses.dataclass(frozen=True)
class Catheter(HandTask):
    """Task in which a catheter is steered into a branch; made by `catheter`."""

    variant: Variant = "clean"
    name: str = "catheter"

    observation_size = 21
    """21 numbers: goal, branch, tip, its velocity, drive and its velocity."""

    observation_channels = (
        Channel(3, "vector from the tip to the goal: along, across, across", "0.05 m"),
        Channel(3, "direction of the branch: along, across, across", "1"),
        Channel(3, "direction of the last element: along, across, across", "1"),
        Channel(3, "direction of bending of the tip: along, across, across", "1"),
        Channel(3, "velocity of the tip: along, across, across", f"{SPEEDS[0]:g} m/s"),
        Channel(1, "way of the base", f"{FURTHEST:g} m"),
        Channel(1, "turn of the base", "3 pi rad"),
        Channel(1, "angle of the tip", f"{MOST_BEND:g} rad"),
        Channel(1, "velocity of the base", f"{SPEEDS[0]:g} m/s"),
        Channel(1, "velocity of its turn", f"{SPEEDS[1]:g} rad/s"),
        Channel(1, "velocity of the tip's angle", f"{SPEEDS[2]:g} rad/s"),
    )
    action_channels = (
        Channel(1, "velocity of the base", f"{SPEEDS[0]:g} m/s"),
        Channel(1, "velocity of its turn", f"{SPEEDS[1]:g} rad/s"),
        Channel(1, "velocity of the tip's angle", f"{SPEEDS[2]:g} rad/s"),
    )

    def default_params(self) -> CatheterParams:
        """Default parameters of the task, in JAX's default precision."""
        body = steered_catheter(self.n_elements)
        kind = body.rod.radii.dtype

        def numbers(*values: float) -> Array:
            return jnp.asarray(values, kind)

        return CatheterParams(
            body=body,
            hand=Hand(
                lower=numbers(0.0, -MOST_TURN, 0.0),
                upper=numbers(FURTHEST, MOST_TURN, MOST_BEND),
                speed=numbers(*SPEEDS),
                acceleration=numbers(*(speed / RISE for speed in SPEEDS)),
            ),
            dt=jnp.asarray(CONTROL_PERIOD / self.substeps, kind),
            ahead=jnp.asarray(0.01, kind),
            turned=jnp.asarray(np.pi, kind),
            fork=numbers(FORK, 0.0, 0.0),
            branches=jnp.asarray(branch_directions(), kind),
        )

    def reset(
        self, key: Key[Array, ""], params: CatheterParams
    ) -> tuple[Float[Array, " observation"], CatheterState]:
        """Starts with the catheter straight and at rest, and draws the branch."""
        check_key(key)
        kind = params.dt.dtype
        way_key, turn_key, branch_key = jax.random.split(key, 3)
        way = params.ahead * jax.random.uniform(way_key, (), kind)
        turn = params.turned * jax.random.uniform(turn_key, (), kind, -1.0)
        coordinates = jnp.stack([way, turn, jnp.zeros((), kind)])
        chosen = jax.random.randint(branch_key, (), 0, N_BRANCHES)
        is_chosen = jnp.arange(N_BRANCHES) == chosen
        state = CatheterState(
            body=params.body.placed(coordinates),
            coordinates=coordinates,
            velocity=jnp.zeros_like(coordinates),
            branch=jnp.sum(jnp.where(is_chosen, params.branches, 0), axis=1),
            held=jnp.zeros((), jnp.int32),
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state, params), state

    def is_there(self, state: CatheterState, params: CatheterParams) -> Bool[Array, ""]:
        """Whether the tip is in the branch that was drawn, deep enough."""
        seen = _place(state, params)
        return (seen.depth >= DEEP) & (seen.offset <= BRANCH_LUMEN)

    def judged(
        self, state: CatheterState, params: CatheterParams
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Score, and depth, offset and distance of the tip from the goal [m]."""
        seen = _place(state, params)
        near = 50 / (1 + (seen.distance / NEAR) ** 2)
        return near + 50 / (1 + (seen.distance / FAR) ** 2), seen._asdict()

    def residuals(
        self,
        state: CatheterState,
        action: Float[Array, " action"],
        params: CatheterParams,
    ) -> Float[Array, "3"]:
        """Residuals for planners: of the tip, relative to the goal."""
        del action
        return tip_residuals(_to_goal(state, params), NEAR, COST_WIDTH)

    def snapshot(self, state: CatheterState, params: CatheterParams) -> Snapshot:
        """Snapshot of the catheter, the goal, and the axes of the vessel."""
        seen, fork = _place(state, params), params.fork
        ends = [fork + BRANCH_LENGTH * params.branches[:, k] for k in range(N_BRANCHES)]
        back = fork + jnp.asarray([BACK - FORK, 0.0, 0.0], fork.dtype)
        return Snapshot(
            positions=state.body.positions,
            radii=params.body.rod.radii,
            spheres=((fork + GOAL * state.branch, 0.5 * BRANCH_LUMEN),),
            cylinders=tuple((fork, end, AXIS_RADIUS) for end in [back, *ends]),
            readouts={"distance to goal [mm]": 1e3 * seen.distance},
            up="z",
        )

    def observe(
        self, state: CatheterState, params: CatheterParams
    ) -> Float[Array, " observation"]:
        """Observation vector; the module's table lists its entries."""
        body, hand = state.body, params.hand
        cos, sin = jnp.cos(state.coordinates[1]), jnp.sin(state.coordinates[1])

        def turned(vector: Array) -> Array:
            x, y, z = vector
            return jnp.stack([x, cos * y + sin * z, cos * z - sin * y])

        return jnp.concatenate(
            [
                turned(_to_goal(state, params)) / 0.05,
                turned(state.branch),
                turned(body.directors[2, :, -1]),
                turned(body.directors[0, :, -1]),
                turned(body.velocities[:, -1]) / SPEEDS[0],
                state.coordinates / hand.upper,
                state.velocity / hand.speed,
            ]
        )


def _to_goal(state: CatheterState, params: CatheterParams) -> Float[Array, "3"]:
    """Vector from the tip to the goal [m]."""
    return params.fork + GOAL * state.branch - state.body.tip


def _place(state: CatheterState, params: CatheterParams) -> Place:
    """The tip as seen from the branch that was drawn."""
    way = state.body.tip - params.fork
    depth = jnp.sum(way * state.branch)
    across = way - depth * state.branch
    offset = jnp.sqrt(jnp.maximum(jnp.sum(across**2), 1e-12))
    left = _to_goal(state, params)
    return Place(depth, offset, jnp.sqrt(jnp.maximum(jnp.sum(left**2), 1e-12)))


def catheter(
    variant: Variant = "clean",
    *,
    n_elements: int = 12,
    substeps: int | None = None,
    episode_length: int = 60,
) -> Catheter:
    """Makes the task of steering a catheter; see the module docstring.

    Args:
        variant: "clean", the only one: the library's own physics.
        n_elements: Elements of the catheter, at least 12: contact points half an
            element apart must not let the edges of the fork in between them.
        substeps: Simulation steps per control step of 0.1 s; by default 50 per element.
        episode_length: Control steps per episode.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    check_count("n_elements", n_elements, 12)
    steps = STEPS_PER_ELEMENT * n_elements if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    return Catheter(n_elements, steps, episode_length)
