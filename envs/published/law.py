r"""The drag of the first Elastica, which the published benchmark used.

Explicit viscous forces and couples per current length, $f = -\nu\, \bar v\, \ell$ and
$c = -\nu\, \omega\, \ell$. PyElastica 1.0 has no such drag. It belongs to the benchmark
and is kept out of the simulator.
"""

from __future__ import annotations

from jaxtyping import Array, Float

from jaxrod import Effect, Loads, Motion, Rod, StabilityBound
from jaxrod.geometry import vectors
from jaxrod.structure import pytree


@pytree
class ViscousDrag(Effect):
    """Viscous force and couple per current length; PyElastica mode only."""

    viscosity: Float[Array, ""]
    """Force per length and speed [kg/(m s)], and couple per length and spin."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Drag of each element; its two nodes share the force equally."""
        drag = -self.viscosity * motion.lengths
        x, y, z = motion.velocity
        means = (0.5 * (x[1:] + x[:-1]), 0.5 * (y[1:] + y[:-1]), 0.5 * (z[1:] + z[:-1]))
        return Loads(
            forces=vectors.pair_sum(vectors.scale(0.5 * drag, means)),
            # In PyElastica mode the spin is the material-frame angular velocity.
            couples=vectors.scale(drag, motion.spin),
        )

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound of explicit drag, for the rod at its rest length."""
        drag = self.viscosity * rod.rest_lengths
        nodes = 0.5 * (vectors.pad(drag, 0, 1) + vectors.pad(drag, 1, 0))
        return StabilityBound(node_drag=nodes, element_drag=drag)
