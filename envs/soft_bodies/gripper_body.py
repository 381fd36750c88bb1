r"""A gripper of three soft fingers, a ball and the table it lies on.

The fingers hang from a wrist whose position is commanded. They are of soft silicone,
and form one member of the system: a stack of equal rods. A chamber on the outer side of
each finger bends it inwards under pressure and outwards under suction. The ball is a
rigid body. Fingers touch the ball and the table, and the ball touches the table, all
with friction.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

import jaxrod
from jaxrod import HealthLimits, RodState, Scene
from jaxrod.schedules import Ramp
from jaxrod.structure import pytree
from jaxrod.systems.stepping.assembly import SystemState
from jaxrod.systems.system import System

N_FINGERS = 3
LENGTH = 0.1
"""Length of a finger [m]."""
RADIUS = 0.008
"""Radius of a finger [m]."""
DENSITY = 1100.0
"""Density of a finger [kg/m^3]."""
YOUNGS_MODULUS = 5e5
"""Young's modulus of a finger [Pa]."""
BASE = 0.05
"""Horizontal distance of the fingers' roots from the middle of the wrist [m]."""
AREA, OFFSET = 4e-5, 5e-3
"""Cross-section of a chamber [m^2], and its distance from the finger's axis [m]."""
MOST_PRESSURE = 1.25e5
"""Largest pressure in the chambers [Pa]: a free finger bends to 15/m, 1.5 rad over its
length."""
RATE = 15.0
"""Exponential damping rate of the fingers [1/s]."""
BALL = 0.03
"""Radius of the ball [m]."""
BALL_DENSITY = 100.0
"""Density of the ball [kg/m^3]."""
GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""
FRICTION = 0.8
"""Friction coefficient of fingers, ball and table [1]."""
STIFFNESS, DAMPING, FRICTION_DRAG = 4e4, 4.0, 4.0
"""Contact of fingers and ball, per length of a finger: stiffness [N/m^2], damping
[kg/(m s)], and largest friction per slip speed [kg/(m s)]. When random actions press
the ball into the table with about 1 N, the tips sink into the ball by less than 0.8 of
their radius. With 5e3 N/m^2 their centreline entered the ball."""
TABLE_STIFFNESS = 500.0
"""Stiffness of the contact of ball and table [N/m]."""
SUNK = 4 / 3 * math.pi * BALL**3 * BALL_DENSITY * GRAVITY / TABLE_STIFFNESS
"""Indentation of the table under the full weight of the ball, m g / k [m]."""
HIGHEST = 0.2
"""Largest height of the wrist above the table, which it has in the state `rest` [m]."""


@pytree
class GripperBody:
    """Parameters of the gripper, of the ball and of everything that acts on them."""

    system: System
    """Members "fingers" and "ball"; the first two effects of the fingers are the wrist
    and the chambers."""
    rest: dict[str, RodState | jaxrod.systems.BodyState]
    """States at rest: fingers straight down, the ball below them on the table."""
    most_pressure: Float[Array, ""]
    """Pressure in a chamber per control value of the chamber [Pa]."""
    limits: HealthLimits = dataclasses.field(default_factory=HealthLimits)
    """Health limits beyond which everything is frozen."""

    @property
    def fingers(self) -> Scene:
        """Scene of the fingers; every leaf has a leading axis over the three."""
        fingers: Any = self.system.members["fingers"]
        return fingers

    def advance(
        self,
        state: SystemState,
        before: tuple[Float[Array, "3"], Float[Array, "3"]],
        after: tuple[Float[Array, "3"], Float[Array, "3"]],
        dt: Array,
        n_steps: int,
    ) -> tuple[SystemState, Bool[Array, ""]]:
        """Advances fingers and ball by the simulation steps of one control step.

        Args:
            state: State of fingers and ball.
            before: Displacement of the wrist from its place in `rest` [m], and control
                values of the chambers [1], as the control step begins.
            after: The same as it ends; linear in time in between.
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The state, and whether a health flag rose; if so, the state is unchanged.
        """
        duration = jnp.broadcast_to(n_steps * dt, (N_FINGERS,))
        moving = [
            Ramp(first, last, jnp.zeros_like(duration), duration)
            for first, last in zip(self._told(*before), self._told(*after), strict=True)
        ]
        acting = self._acting(*moving)
        moved = jaxrod.advance(acting, state, dt, n_steps)
        at_end = acting.at(n_steps * dt)
        flagged = jaxrod.health(at_end, moved, dt, limits=self.limits).flagged
        return jaxrod.freeze(flagged, state, moved), flagged

    def _told(self, wrist: Array, controls: Array) -> tuple[Array, Array]:
        """Converts wrist displacement and control values to those of each finger.

        Returns:
            Displacement of every finger's root [m], and pressure in its chamber [Pa].
        """
        roots = jnp.broadcast_to(wrist, (N_FINGERS, 3))
        return roots, self.most_pressure * controls

    def _acting(self, wrist: Ramp, pressure: Ramp) -> System:
        """System whose wrist displacement [m] and chamber pressures [Pa] are ramps."""
        driven: Any
        chamber: Any
        driven, chamber, *others = self.fingers.effects
        effects = (
            dataclasses.replace(
                driven, place=dataclasses.replace(driven.place, displacement=wrist)
            ),
            dataclasses.replace(chamber, pressure=pressure),
            *others,
        )
        fingers = dataclasses.replace(self.fingers, effects=effects)
        members = {**self.system.members, "fingers": fingers}
        return dataclasses.replace(self.system, members=members)


def gripper_body(n_elements: int) -> GripperBody:
    """Makes gripper and ball, at rest, in JAX's default precision.

    Args:
        n_elements: Number of elements of every finger.
    """
    angles = 2 * jnp.pi * jnp.arange(N_FINGERS) / N_FINGERS
    table = jaxrod.shapes.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    weight = jaxrod.gravity((0.0, 0.0, -GRAVITY))

    def finger(angle: Array) -> tuple[Scene, RodState]:
        outwards = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])
        rod, state = jaxrod.straight_rod(
            n_elements,
            length=LENGTH,
            radius=RADIUS,
            density=DENSITY,
            youngs_modulus=YOUNGS_MODULUS,
            start=BASE * outwards + jnp.asarray([0.0, 0.0, HIGHEST]),
            direction=(0.0, 0.0, -1.0),
            normal=outwards,
        )
        effects = (
            jaxrod.driven(state),
            jaxrod.actuation.chamber(rod, 0.0, AREA, offsets=(OFFSET, 0.0)),
            weight,
            jaxrod.exponential_damping(RATE),
            jaxrod.contact(
                table,
                stiffness=5e3,
                damping=10.0,
                friction=FRICTION,
                friction_drag=10.0,
            ),
        )
        return jaxrod.make_scene(rod, *effects), state

    fingers, of_fingers = jax.vmap(finger)(angles)
    ball, of_ball = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.0, 0.0, BALL), BALL),
        density=BALL_DENSITY,
        effects=(weight, jaxrod.exponential_damping(0.2, 1.0)),
    )
    rest: dict[str, RodState | jaxrod.systems.BodyState] = {
        "fingers": of_fingers,
        "ball": of_ball,
    }
    system = jaxrod.make_system(
        {"fingers": fingers, "ball": ball},
        jaxrod.systems.body_contact(
            "fingers",
            "ball",
            stiffness=STIFFNESS,
            damping=DAMPING,
            friction=FRICTION,
            friction_drag=FRICTION_DRAG,
        ),
        jaxrod.systems.rigid_contact(
            "ball",
            fixed=table,
            stiffness=TABLE_STIFFNESS,
            damping=1.0,
            friction=FRICTION,
            friction_drag=1.0,
        ),
        state=rest,
    )
    kind = angles.dtype
    return GripperBody(
        system=system,
        rest=rest,
        most_pressure=jnp.asarray(MOST_PRESSURE, kind),
        limits=jax.tree.map(lambda value: jnp.asarray(value, kind), HealthLimits()),
    )
