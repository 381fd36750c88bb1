"""A rope on the floor, of which a hand holds one end like a ball joint.

The rope is soft enough to hang: it weighs 0.8 N/m, and bends over 9 cm under its own
weight. Eight elements describe it. Transverse rotary inertia is scaled up
(`jaxrod.scale_inertia`) to about that of a rigid element, so that bending does not
limit the time step.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, DTypeLike, Float

from jaxrod import (
    HealthLimits,
    Rod,
    RodState,
    Scene,
    advance,
    contact,
    driven,
    exponential_damping,
    freeze,
    gravity,
    health,
    make_scene,
    scale_inertia,
    shapes,
    straight_rod,
)
from jaxrod.envs.soft_bodies.hand import Glide
from jaxrod.geometry.rotations import (
    join_quaternion,
    multiply_quaternions,
    split_quaternion,
)
from jaxrod.structure import pytree

LENGTH = 0.5
"""Length of the rope [m]."""
RADIUS = 0.005
"""Radius of the rope [m]."""
DENSITY = 1000.0
"""Density of the rope [kg/m^3]."""
YOUNGS_MODULUS = 1e6
"""Young's modulus of the rope [Pa]."""
GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""
DAMPING = 2.0
"""Damping rate of translation and rotation [1/s]."""
FLOOR_STIFFNESS, FLOOR_DAMPING = 2e4, 20.0
"""Stiffness [N/m^2] and damping [kg/(m s)] of the floor. The rope sinks in by 0.04 mm
at rest."""
FRICTION, FRICTION_DRAG = 0.4, 10.0
"""Friction of the floor [1], and its largest drag at low slip [kg/(m s)]."""
SHARPEST = 3.0
"""Largest angle between neighbouring elements before the rope is frozen [rad]: a rope
may double over."""


@pytree
class HeldRope:
    """Parameters of the rope and of everything that acts on it."""

    scene: Scene
    """The rope, with scaled transverse rotary inertia; its first effect is the hand."""
    rest: RodState
    """State of the rope straight along x and at rest on the floor, its held end at
    x = y = 0."""
    limits: HealthLimits = dataclasses.field(default_factory=HealthLimits)
    """Health limits beyond which the rope is frozen."""

    @property
    def rod(self) -> Rod:
        """Geometry and material of the rope; the held end is its first node."""
        return self.scene.rod

    def lying(self, place: Float[Array, "3"], angle: Float[Array, ""]) -> RodState:
        """State of the rope straight, level and at rest.

        Args:
            place: Position of the held end, world frame [m].
            angle: Angle from x to the rope, about z [rad].
        """
        c, s = jnp.cos(angle), jnp.sin(angle)
        x = self.rest.positions[0]
        way = jnp.stack([c * x, s * x, jnp.zeros_like(x)])
        none = jnp.zeros_like(angle)
        turn = jnp.cos(0.5 * angle), none, none, jnp.sin(0.5 * angle)
        turned = multiply_quaternions(turn, split_quaternion(self.rest.orientations))
        return dataclasses.replace(
            self.rest,
            positions=place[:, None] + way,
            orientations=join_quaternion(turned),
        )

    def driven_along(self, path: Glide) -> Scene:
        """Scene whose held end follows a path."""
        hand: Any
        hand, *others = self.scene.effects
        held = dataclasses.replace(hand, place=path)
        return dataclasses.replace(self.scene, effects=(held, *others))

    def advance(
        self, state: RodState, path: Glide, dt: Array, n_steps: int
    ) -> tuple[RodState, Bool[Array, ""]]:
        """Advances the rope by the simulation steps of one control step.

        Args:
            state: State of the rope.
            path: Path of the held end.
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The state, and whether a health flag rose; if so, the state is unchanged.
        """
        acting = self.driven_along(path)
        moved = advance(acting, state, dt, n_steps)
        at_end = acting.at(n_steps * dt)
        flagged = health(at_end, moved, dt, limits=self.limits).flagged
        return freeze(flagged, state, moved), flagged


def held_rope(n_elements: int) -> HeldRope:
    """Makes the rope, at rest, in JAX's default precision.

    Args:
        n_elements: Number of elements.
    """
    rod, rest = straight_rod(
        n_elements,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNGS_MODULUS,
        start=(0.0, 0.0, RADIUS),
        direction=(1.0, 0.0, 0.0),
    )
    floor = contact(
        shapes.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        stiffness=FLOOR_STIFFNESS,
        damping=FLOOR_DAMPING,
        friction=FRICTION,
        friction_drag=FRICTION_DRAG,
    )
    scene = make_scene(
        rod,
        driven(rest, free_to_turn=True),
        gravity((0.0, 0.0, -GRAVITY)),
        exponential_damping(DAMPING),
        floor,
    )
    limits = limits_of_health(rod.radii.dtype)
    return HeldRope(scene=scale_inertia(scene).scene, rest=rest, limits=limits)


def limits_of_health(kind: DTypeLike) -> HealthLimits:
    """Health limits of a rope that may double over, in a precision."""
    limits = HealthLimits(largest_joint_angle=SHARPEST)
    return jax.tree.map(lambda value: jnp.asarray(value, kind), limits)
