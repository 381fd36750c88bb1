r"""Flat ground under a rod that lies on it: anisotropic friction, nothing else.

A rod that moves in the plane of the ground always presses on it with its weight per
length. So the friction of `jaxrod.contact` with `friction=(forward, backward,
sideways)` has a known normal force, and the motion is planar. This takes a third of the
work of a rod in space that rests on a stiff ground, and there is no vertical vibration
to resolve.
"""

from __future__ import annotations

from jaxtyping import Array, Float

from jaxrod import Effect, Loads, Rod, StabilityBound
from jaxrod.contacts.contact_law import directional_friction_force
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.structure import pytree


@pytree
class FlatGround(Effect):
    """Friction of a rod that lies on flat ground with its full weight."""

    weight: Float[Array, ""]
    """Normal force per length of rod [N/m]."""
    friction: Float[Array, "3"]
    """Coefficients forward (along d3), backward and sideways [1]."""
    friction_drag: Float[Array, ""]
    """Largest friction per length and slip speed [kg/(m s)]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Friction on the nodes, with the mean direction of the adjacent elements."""
        axis = _at_nodes(directors(motion.orientation)[2])
        density = directional_friction_force(
            self.weight, motion.velocity, axis, self.friction, self.friction_drag
        )
        return Loads(forces=vectors.scale(_lengths(rod), density))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound from the drag at the onset of slip."""
        return StabilityBound(node_drag=self.friction_drag * _lengths(rod))


def _lengths(rod: Rod) -> Array:
    """Length of rod that belongs to each node [m]."""
    half = 0.5 * rod.rest_lengths
    return vectors.pad(half, 0, 1) + vectors.pad(half, 1, 0)


def _at_nodes(axis: Vec3) -> Vec3:
    """Unit vectors at the nodes, halfway between those of the adjacent elements."""
    x, y, z = (vectors.pad(c, 0, 1) + vectors.pad(c, 1, 0) for c in axis)
    size = vectors.safe_norm((x, y, z))
    return vectors.scale(1 / size, (x, y, z))
