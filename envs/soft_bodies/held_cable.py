"""A soft cable that hangs from a hand, which clamps its upper end, above a socket.

The socket is a pipe that stands on the floor and may lean. The cable touches floor and
socket with friction, at the nodes and in the middles of its elements. Its tip is a ball
to the socket, and so finds the way over a rim that it hits with less than half of its
thickness. Transverse rotary inertia is scaled up (`jaxrod.scale_inertia`) to about that
of a rigid element.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxtyping import Array, Float

from jaxrod import (
    RodState,
    contact,
    driven,
    exponential_damping,
    gravity,
    make_scene,
    scale_inertia,
    shapes,
    straight_rod,
)
from jaxrod.envs.soft_bodies.held_rope import GRAVITY, HeldRope, limits_of_health
from jaxrod.structure import pytree

LENGTH = 0.2
"""Length of the cable [m]."""
RADIUS = 0.008
"""Radius of the cable [m]."""
DENSITY = 1000.0
"""Density of the cable [kg/m^3]."""
YOUNGS_MODULUS = 4e6
"""Young's modulus of the cable [Pa]."""
DAMPING = 4.0
"""Damping rate of translation and rotation [1/s]."""
BORE, WALL, HIGH = 0.011, 0.01, 0.05
"""Radius of the socket's bore, thickness of its wall, and its length [m]."""
STIFFNESS, CONTACT_DAMPING = 2e5, 30.0
"""Stiffness [N/m^2] and damping [kg/(m s)] of socket and floor."""
FRICTION, FRICTION_DRAG = 0.2, 20.0
"""Friction of socket and floor [1], and its largest drag at low slip [kg/(m s)]."""


@pytree
class HeldCable(HeldRope):
    """Parameters of the cable and of everything that acts on it.

    The first effect of the scene is the hand, the second is the socket.
    """

    def hanging(self, place: Float[Array, "3"]) -> RodState:
        """State of the cable straight down and at rest.

        Args:
            place: Position of the held end, world frame [m].
        """
        offset = place - self.rest.positions[:, 0]
        return dataclasses.replace(
            self.rest, positions=self.rest.positions + offset[:, None]
        )

    def above(self, mouth: Float[Array, "3"], inwards: Float[Array, "3"]) -> HeldCable:
        """The same cable with the socket at another place.

        Args:
            mouth: Centre of the socket's upper end, world frame [m].
            inwards: Unit vector along the socket's axis, from the mouth downwards.
        """
        touch: Any
        hand, touch, *others = self.scene.effects
        body = dataclasses.replace(touch.body, start=mouth, end=mouth + HIGH * inwards)
        there = dataclasses.replace(touch, body=body)
        scene = dataclasses.replace(self.scene, effects=(hand, there, *others))
        return dataclasses.replace(self, scene=scene)


def held_cable(n_elements: int) -> HeldCable:
    """Makes the cable, at rest, in JAX's default precision.

    Args:
        n_elements: Number of elements.
    """
    rod, rest = straight_rod(
        n_elements,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNGS_MODULUS,
        start=(0.0, 0.0, 2 * LENGTH),
        direction=(0.0, 0.0, -1.0),
    )
    law: dict[str, Any] = {
        "stiffness": STIFFNESS,
        "damping": CONTACT_DAMPING,
        "friction": FRICTION,
        "friction_drag": FRICTION_DRAG,
        "points_per_element": 2,
    }
    scene = make_scene(
        rod,
        driven(rest),
        contact(shapes.pipe((0.0, 0.0, HIGH), (0.0, 0.0, 0.0), BORE, WALL), **law),
        contact(shapes.plane((0.0, 0.0, 0.0)), **law),
        gravity((0.0, 0.0, -GRAVITY)),
        exponential_damping(DAMPING),
    )
    limits = limits_of_health(rod.radii.dtype)
    return HeldCable(scene=scale_inertia(scene).scene, rest=rest, limits=limits)
