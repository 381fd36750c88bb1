"""Motion without symmetries, on which effects are tested numerically."""

from __future__ import annotations

import jax.numpy as jnp

from jaxrod.effects.directions import frame_along
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod


def trial_motion(rod: Rod) -> Motion:
    """Unstretched rod with irregular directions of elements and irregular rates.

    The angular momentum of each element is perpendicular to the element.
    """
    k = jnp.arange(rod.n_elements, dtype=rod.rest_lengths.dtype)
    x, y, z = jnp.cos(1.1 * k + 0.3), jnp.sin(1.7 * k + 0.7), jnp.cos(0.6 * k - 0.5)
    direction = vectors.scale(1 / jnp.sqrt(x * x + y * y + z * z), (x, y, z))
    position = _summed(vectors.scale(rod.rest_lengths, direction))
    return Motion(
        position=position,
        orientation=frame_along(direction),
        velocity=(position[1], position[2], position[0]),
        spin=vectors.cross(direction, vectors.scale(rod.inertias[0], (y, z, x))),
    )


def _summed(edges: Vec3) -> Vec3:
    x, y, z = (vectors.pad(jnp.cumsum(c), 1, 0) for c in edges)
    return x, y, z
