"""A catheter whose base is pushed and turned, and whose tip bends, in a vessel.

The catheter is a soft rod, 140 mm long and 4 mm thick. It begins on the axis of the
trunk of a branching vessel. It has no weight, as in a liquid of its own density. The
drive has three coordinates: the way of the base along x, its angle about x, and the
angle by which the last 30 mm would bend if they were free. This angle sets the rest
curvature (`jaxrod.actuation.ActiveShape`), towards d1 of the last element.

The wall touches nodes and middles of elements, with friction. Transverse rotary inertia
is scaled up (`jaxrod.scale_inertia`) to about that of a rigid element.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod import (
    RodState,
    Scene,
    contact,
    driven,
    exponential_damping,
    make_scene,
    scale_inertia,
    straight_rod,
)
from jaxrod.actuation import active_shape
from jaxrod.effects.time import Clock, Schedule
from jaxrod.envs.soft_bodies.branching_vessel import vessel_wall
from jaxrod.envs.soft_bodies.hand import Glide
from jaxrod.envs.soft_bodies.held_rope import HeldRope, limits_of_health
from jaxrod.geometry.rotations import (
    join_quaternion,
    multiply_quaternions,
    split_quaternion,
)
from jaxrod.structure import pytree, static

LENGTH = 0.14
"""Length of the catheter [m]."""
RADIUS = 0.002
"""Radius of the catheter [m]."""
DENSITY = 1100.0
"""Density of the catheter [kg/m^3]."""
YOUNGS_MODULUS = 2e6
"""Young's modulus of the catheter [Pa]."""
DAMPING = 30.0
"""Damping rate of translation and rotation [1/s]."""
BENDING_LENGTH = 0.03
"""Length of the tip that bends [m]."""
STIFFNESS, CONTACT_DAMPING = 1e5, 2.0
"""Stiffness [N/m^2] and damping [kg/(m s)] of the wall."""
FRICTION, FRICTION_DRAG = 0.1, 2.0
"""Friction of the wall [1], and its largest drag at low slip [kg/(m s)]."""
FURTHEST, MOST_TURN, MOST_BEND = 0.09, 3 * np.pi, 1.2
"""Largest way of the base [m], its largest angle about x either way [rad], and the
largest angle of the tip [rad]."""


@pytree
class Coordinate(Schedule):
    """One coordinate of the drive along its path, times a constant array."""

    path: Glide
    """Path of all coordinates."""
    factor: Float[Array, "..."]
    """The constant array."""
    index: int = static()
    """Index of the coordinate."""

    def __call__(self, clock: Clock) -> Array:
        """Value at the time of a clock."""
        return self.path(clock).position[self.index] * self.factor

    @property
    def largest(self) -> Array:
        """Larger absolute value at both ends of the path."""
        return self.path.largest.position[self.index] * jnp.abs(self.factor)


@pytree
class SteeredCatheter(HeldRope):
    """Parameters of the catheter and of everything that acts on it.

    The first effects of the scene are the held base, the shape of the tip, and the wall
    of the vessel. `rest` is the catheter straight along x, with its base at zero.
    """

    def placed(self, coordinates: Float[Array, "3"]) -> RodState:
        """State of the catheter straight and at rest.

        Args:
            coordinates: Coordinates of the drive. The angle of the tip must be zero.
        """
        way, angle, _ = coordinates
        none = jnp.zeros_like(angle)
        turn = jnp.cos(0.5 * angle), jnp.sin(0.5 * angle), none, none
        turned = multiply_quaternions(turn, split_quaternion(self.rest.orientations))
        x, y, z = self.rest.positions
        return dataclasses.replace(
            self.rest,
            positions=jnp.stack([x + way, y, z]),
            orientations=join_quaternion(turned),
        )

    def driven_along(self, path: Glide) -> Scene:
        """Scene in which the coordinates of the drive follow a path."""
        held: Any
        shape: Any
        held, shape, *others = self.scene.effects

        def moved(coordinate: Coordinate) -> Coordinate:
            return dataclasses.replace(coordinate, path=path)

        way, angle = moved(held.place.displacement), moved(held.turn.angle)
        held = dataclasses.replace(
            held,
            place=dataclasses.replace(held.place, displacement=way),
            turn=dataclasses.replace(held.turn, angle=angle),
        )
        shape = dataclasses.replace(shape, curvature=moved(shape.curvature))
        return dataclasses.replace(self.scene, effects=(held, shape, *others))


def steered_catheter(n_elements: int) -> SteeredCatheter:
    """Makes the catheter, straight and at rest, in JAX's default precision.

    Args:
        n_elements: Number of elements.
    """
    along = (1.0, 0.0, 0.0)
    rod, rest = straight_rod(
        n_elements,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNGS_MODULUS,
        direction=along,
    )
    kind = rod.radii.dtype
    zero, last = jnp.zeros(3, kind), jnp.asarray([FURTHEST, MOST_TURN, MOST_BEND], kind)
    # The largest values of this path are those for which the scene is made.
    path = Glide(zero, last, zero, zero, jnp.ones((), kind))

    def coordinate(index: int, factor: Any) -> Coordinate:
        return Coordinate(path, jnp.asarray(factor, kind), index)

    scene = make_scene(
        rod,
        driven(
            rest,
            displacement=coordinate(0, along),
            axis=along,
            angle=coordinate(1, 1.0),
        ),
        active_shape(rod, curvature=coordinate(2, _shares(n_elements))),
        contact(
            vessel_wall(),
            stiffness=STIFFNESS,
            damping=CONTACT_DAMPING,
            friction=FRICTION,
            friction_drag=FRICTION_DRAG,
            points_per_element=2,
        ),
        exponential_damping(DAMPING),
    )
    limits = limits_of_health(kind)
    return SteeredCatheter(scene=scale_inertia(scene).scene, rest=rest, limits=limits)


def _shares(n_elements: int) -> np.ndarray:
    """Rest curvature at each node's joint per angle of the tip (3, n+1) [1/m per rad].

    A joint reaches from midpoint to midpoint of adjacent elements, and gets the mean
    over this length.
    """
    nodes = np.linspace(0.0, LENGTH, n_elements + 1)
    middles = 0.5 * (nodes[1:] + nodes[:-1])
    starts, ends = np.append(0.0, middles), np.append(middles, LENGTH)
    bends = ends - np.clip(LENGTH - BENDING_LENGTH, starts, ends)
    none = np.zeros(n_elements + 1)
    return np.stack([none, bends / (ends - starts) / BENDING_LENGTH, none])
