"""One moment of a task as it is drawn: `Environment`s may return it, see `Drawable`."""

from __future__ import annotations

import dataclasses
from typing import Literal

from jaxtyping import Array, Float

from jaxrod.structure import pytree, static

Number = Float[Array, ""] | float
"""One number."""
Point = Float[Array, "3"]
"""Where something is [m]."""


@pytree
class Snapshot:
    """The rods of one moment and what stands around them.

    Shapes are those of one moment; `jax.vmap` puts frames before them. What is
    neither a node nor the centre of a sphere stays as it is during an episode.
    """

    positions: Float[Array, "*rods 3 n+1"]
    """Nodes of the rod [m]; of several rods of one size, stacked along a first axis."""
    radii: Float[Array, "*#rods n"]
    """Of its elements [m]."""
    spheres: tuple[tuple[Point, Number], ...] = ()
    """Centre and radius of each sphere [m], a target for one."""
    cylinders: tuple[tuple[Point, Point, Number], ...] = ()
    """Middles of both ends and radius of each cylinder [m], an obstacle for one."""
    readouts: dict[str, Number] = dataclasses.field(default_factory=dict)
    """Numbers to show beside them, by what they are called."""
    up: Literal["x", "y", "z"] = static(default="z")
    """The axis that points up."""
