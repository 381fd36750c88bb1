"""One moment of a task as it is drawn: `Environment`s may return it, see `Drawable`."""

from __future__ import annotations

import dataclasses
from typing import Literal

from jaxtyping import Array, Float

from jaxrod.structure import pytree, static

Number = Float[Array, ""] | float
"""One number."""
Point = Float[Array, "3"]
"""Position [m]."""


@pytree
class Snapshot:
    """The rods at one moment, and the objects around them.

    Shapes are those of one moment; `jax.vmap` puts a frame axis first. Everything but
    the nodes and the centres of the spheres stays constant during an episode.
    """

    positions: Float[Array, "*rods 3 n+1"]
    """Nodes of the rod [m]; several rods of one size are stacked along a first axis."""
    radii: Float[Array, "*#rods n"]
    """Radii of the elements [m]."""
    spheres: tuple[tuple[Point, Number], ...] = ()
    """Centre and radius of each sphere [m], for example a target."""
    cylinders: tuple[tuple[Point, Point, Number], ...] = ()
    """Midpoints of both ends and radius of each cylinder [m], for example an
    obstacle."""
    readouts: dict[str, Number] = dataclasses.field(default_factory=dict)
    """Numbers to show with the picture, by their labels."""
    up: Literal["x", "y", "z"] = static(default="z")
    """Axis that points up."""
