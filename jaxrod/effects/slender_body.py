r"""PyElastica's slender-body drag, for comparisons.

On an element of current length $\ell$ and radius $r$ of a rod of current length $L$,

$$F = -\frac{4\pi\eta\,\ell}{\ln(L/r)}\,(1 - \tfrac12 t t^T)\,v,$$

with $v$ the mass-weighted mean of its nodes' velocities; half of it acts on each node
(Gazzola et al., R. Soc. Open Sci. 5 (2018) 171628, eq. 4.13). It is a load, so it
limits the step.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect, StabilityBound
from jaxrod.effects.fluids import on_nodes
from jaxrod.geometry import vectors
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array


@pytree
class SlenderBodyDrag(Effect):
    """PyElastica's `SlenderBodyTheory`; see `slender_body_drag`."""

    viscosity: Float[Array, ""]
    """Dynamic viscosity of the fluid [Pa s]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Half of every element's drag on each of its nodes."""
        lengths = motion.lengths
        radii = rod.radii * jnp.sqrt(rod.rest_lengths / lengths)
        tangent = vectors.scale(1 / lengths, motion.edges)
        masses = rod.node_masses
        x, y, z = (
            (masses[1:] * v[1:] + masses[:-1] * v[:-1]) / (masses[1:] + masses[:-1])
            for v in motion.velocity
        )
        along = vectors.scale(0.5 * vectors.dot(tangent, (x, y, z)), tangent)
        size = self._per_length(jnp.sum(lengths), radii) * lengths
        half = vectors.scale(-0.5 * size, vectors.subtract((x, y, z), along))
        return Loads(forces=vectors.pair_sum(half))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Drag across the unstretched rod."""
        return StabilityBound(
            node_drag=on_nodes(rod, self._per_length(rod.length, rod.radii))
        )

    def _per_length(self, length: Array, radii: Array) -> Array:
        """Drag per length and speed across the rod [kg/(m s)]."""
        return 4 * jnp.pi * self.viscosity / jnp.log(length / radii)


def slender_body_drag(viscosity: Numbers) -> SlenderBodyDrag:
    """PyElastica's `SlenderBodyTheory(dynamic_viscosity)`, for comparisons.

    `stokes_drag` is the same except that it does not account for stretch. It does not
    limit the step, and its coefficients can be chosen.

    Args:
        viscosity: Dynamic viscosity of the fluid [Pa s].

    Raises:
        ValueError: If it is not positive.
    """
    return SlenderBodyDrag(as_array("viscosity", viscosity, "Pa s", positive=True))
