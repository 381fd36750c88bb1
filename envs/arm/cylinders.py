"""The obstacles of the benchmark: fixed cylinders."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.structure import pytree
from jaxrod.validation import Numbers, check_array

OBSERVED_POINTS = 5
"""Number of equidistant observed points of every cylinder, including both ends."""


@pytree
class Cylinders:
    """Fixed round cylinders, whose number is m."""

    starts: Float[Array, "3 m"]
    """Centre of one end of each cylinder [m]."""
    directions: Float[Array, "3 m"]
    """Unit vectors from `starts` to the other end."""
    normals: Float[Array, "3 m"]
    """Unit vectors perpendicular to the cylinders, from which the published broad phase
    computes their bounding boxes; the published maze has wrong ones."""
    lengths: Float[Array, " m"]
    """Lengths of the cylinders [m]."""
    radii: Float[Array, " m"]
    """Radii of the cylinders [m]."""

    @property
    def centres(self) -> Float[Array, "3 m"]:
        """Midpoint of the axis of each cylinder [m]."""
        return self.starts + 0.5 * self.lengths[None, :] * self.directions

    @property
    def ends(self) -> Float[Array, "3 m"]:
        """Centre of the end opposite to `starts` of each cylinder [m]."""
        return self.starts + self.lengths[None, :] * self.directions


def cylinders(
    starts: Numbers,
    directions: Numbers,
    normals: Numbers,
    *,
    length: float,
    radius: float,
) -> Cylinders:
    """Makes cylinders of equal length and radius.

    Args:
        starts: Centre of one end of each cylinder, `(m, 3)` [m].
        directions: Vectors from `starts` to the other end, of any length, `(m, 3)`.
        normals: Unit vectors for the published bounding boxes, `(m, 3)`.
        length: Length of every cylinder [m].
        radius: Radius of every cylinder [m].
    """
    count = len(np.asarray(starts))
    kind = jnp.result_type(float)

    def column(name: str, value: Numbers, *, unit_length: bool = False) -> Array:
        checked = check_array(name, value, [(count, 3)], "m")
        if unit_length:
            checked = checked / np.linalg.norm(checked, axis=1, keepdims=True)
        return jnp.asarray(checked.T, kind)

    return Cylinders(
        starts=column("starts", starts),
        directions=column("directions", directions, unit_length=True),
        normals=column("normals", normals),
        lengths=jnp.full(count, length, kind),
        radii=jnp.full(count, radius, kind),
    )


def points_along(
    starts: Float[Array, "3 m"], cylinders: Cylinders
) -> Float[Array, " 15m"]:
    """Five equidistant points from each start along the cylinder's direction [m].

    Both ends are included. The result is flat: cylinder by cylinder, point by point,
    x, y, z.
    """
    parts = jnp.linspace(0, 1, OBSERVED_POINTS, dtype=starts.dtype)
    along = cylinders.lengths[None, :] * cylinders.directions
    points = starts[:, :, None] + along[:, :, None] * parts[None, None, :]
    return jnp.ravel(jnp.transpose(points, (1, 2, 0)))
