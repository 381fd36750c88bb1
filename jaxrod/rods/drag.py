r"""Drag of the fluid around a rod: decay rates of velocities, and loads.

Relative to the fluid, which flows at $u$, a node moves at $w = v - u$, with the
component $w_\parallel$ along the rod and $w_\perp$ perpendicular to it. Drag alone
gives

$$\dot w_\parallel = -(g_\parallel + q_\parallel |w_\parallel|)\, w_\parallel, \qquad
  \dot w_\perp = -(g_\perp + q_\perp |w_\perp|)\, w_\perp.$$

Angular momenta decay at constant rates of their own, one about the axis of an element
and one perpendicular to it.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree


@pytree
class Drag:
    """Decay rates by which the surrounding fluid slows a rod down, at one moment.

    Each rate is a single number, or one per node; for `turning`, one per element.

    Example:
        >>> drag = fluids.stokes_drag(along=0.1, across=0.2).drag(rod, motion)
        >>> round(float(drag.across[5] / drag.along[5]), 3), drag.grows_with_speed
        (2.0, False)
    """

    along: Array
    r"""Decay rate $g_\parallel$ of velocities along the rod [1/s]."""
    across: Array
    r"""Decay rate $g_\perp$ of velocities perpendicular to the rod [1/s]."""
    along_per_speed: Array | None = None
    r"""Increase $q_\parallel$ of `along` per speed along the rod [1/m]."""
    across_per_speed: Array | None = None
    r"""Increase $q_\perp$ of `across` per speed perpendicular to the rod [1/m]."""
    turning: tuple[Array, Array] | None = None
    """Decay rates of angular momenta about d3, and about d1 and d2 [1/s]."""
    flow: Vec3 | None = None
    """Velocity of the fluid at the nodes, world frame [m/s]; `None` for a fluid at
    rest."""

    @property
    def grows_with_speed(self) -> bool:
        """Whether the drag has rates per speed, even if their values are zero."""
        return (self.along_per_speed, self.across_per_speed) != (None, None)


def mean_decay(exponent: Array) -> Array:
    """Mean of exp(-s) for s from 0 to `exponent`: (1 - exp(-x)) / x, at zero 1 [1].

    The exponent is at least zero.
    """
    # The series is used where the quotient loses digits.
    small = exponent < 1e-2
    series = 1 - exponent * (
        1 / 2 - exponent * (1 / 6 - exponent * (1 / 24 - exponent / 120))
    )
    quotient = -jnp.expm1(-exponent) / jnp.where(small, 1, exponent)
    return jnp.where(small, series, quotient)


def node_tangents(motion: Motion) -> Vec3:
    """Unit vectors along the rod at the nodes: directions of the mean edges there."""
    around = vectors.pair_sum(motion.edges)
    return vectors.scale(1 / vectors.safe_norm(around), around)


def relative_velocity(motion: Motion, drag: Drag) -> Vec3:
    """Velocities of the nodes minus those of the fluid there, world frame [m/s]."""
    if drag.flow is None:
        return motion.velocity
    return vectors.subtract(motion.velocity, drag.flow)


def drag_loads(rod: Rod, motion: Motion, drag: Drag) -> Loads:
    """Drag as forces and couples, for methods that treat drag as an explicit load.

    Args:
        rod: The rod.
        motion: Its configuration and rates.
        drag: Rates at this moment, as the hook `drag` of an effect gives them.

    Returns:
        Forces on nodes, world frame [N], and couples on elements, material frame
        [N m].

    Example:
        >>> zero = jnp.zeros(11)
        >>> rising = replace(motion, velocity=(zero, zero, zero + 1.0))
        >>> drag = fluids.stokes_drag(along=0.1, across=0.2).drag(rod, rising)
        >>> force = fluids.drag_loads(rod, rising, drag).forces[2]
        >>> round(float(force.sum()), 3)  # 0.2 kg/(m s), 1 m/s, 1 m [N]
        -0.2
    """
    tangent, relative = node_tangents(motion), relative_velocity(motion, drag)
    speed = vectors.dot(tangent, relative)
    across = vectors.subtract(relative, vectors.scale(speed, tangent))
    slow, sideways = drag.along, drag.across
    if drag.along_per_speed is not None:
        slow = slow + drag.along_per_speed * jnp.abs(speed)
    if drag.across_per_speed is not None:
        sideways = sideways + drag.across_per_speed * vectors.safe_norm(across)
    masses = rod.node_masses
    forces = vectors.add(
        vectors.scale(-masses * slow * speed, tangent),
        vectors.scale(-masses * sideways, across),
    )
    if drag.turning is None:
        return Loads(forces)
    about, tilting = drag.turning
    frame = directors(motion.orientation)
    a, b, c = to_material(frame, motion.angular_velocities(rod))
    one, two, three = vectors.split(rod.principal_inertias)
    return Loads(forces, (-tilting * one * a, -tilting * two * b, -about * three * c))
