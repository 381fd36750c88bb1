"""Base class of materials with memory: stress depends on the history of strains.

The strain measures are those of the rod: curvature and twist of joints, shear and
stretch of elements. The memory is one array per measure, and the stress is added to the
elastic one.
"""

from __future__ import annotations

from typing import ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.actuation.section_load import (
    SectionLoad,
    SectionStrains,
    joint_lengths_at_nodes,
)
from jaxrod.effects.base import Reach
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree


@pytree
class Measures:
    """Strains of a rod, from which the laws of materials follow."""

    curvature: Array
    """Curvature and twist of the joint at each node `(3, n + 1)`, material frame; zero
    at free ends [1/m]."""
    strain: Array
    """Shear and stretch of each element `(3, n)`, material frame [1]."""
    lengths: Array
    """Rest length of the joint at each node `(n + 1,)`; zero at free ends [m]."""


class Material(SectionLoad):
    """Base class of materials with memory.

    A subclass is a pytree with a field `walls`.
    """

    # The moment of a joint depends on its own rotation alone, and the force of an
    # element on its own strain alone.
    reach: ClassVar[Reach] = "neighbours"

    @property
    def stirred(self) -> Self:
        """The material itself: its memory follows the strains of the rod."""
        return self

    def measures(self, rod: Rod, strains: SectionStrains) -> Measures:
        """Curvatures and strains of the rod, and the rest lengths of its joints."""
        lengths = joint_lengths_at_nodes(rod, self.walls)
        there = lengths > 0
        inverse = jnp.where(there, 1 / jnp.where(there, lengths, 1), 0)
        across1, across2, along = vectors.scale(1 / rod.rest_lengths, strains.edges)
        return Measures(
            vectors.join(vectors.scale(inverse, strains.rotations)),
            vectors.join((across1, across2, along - 1)),
            lengths,
        )

    def turning_stiffness(self, rod: Rod, bending: Array) -> Array:
        """Stiffness of the joint at each node, from that of bending [N m]."""
        lengths = joint_lengths_at_nodes(rod, self.walls)
        there = lengths > 0
        return jnp.where(there, bending / jnp.where(there, lengths, 1), 0)

    def seen(self, rod: Rod, motion: Motion) -> Measures:
        """Curvatures and strains of the rod in a motion."""
        return self.measures(rod, self._strains(motion)[0])


def bent(curvature: Array) -> Vec3:
    """Curvature without twist, as components; `(3, n + 1)` in the material frame."""
    return curvature[0], curvature[1], jnp.zeros_like(curvature[2])
