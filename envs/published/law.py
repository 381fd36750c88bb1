r"""The soft arm of the published benchmark, its first Elastica's settings included.

What differs from PyElastica 1.0: shear modulus E/1.5 and shear correction 4/3;
explicit viscous forces and couples per current length,
$f = -\nu\, \bar v\, \ell$ and $c = -\nu\, \omega\, \ell$; muscles that add a couple to
every element, whatever its length, read off a spline at the element's far end in
current arc length. These belong to the benchmark and are kept out of the simulator.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import (
    ControlSpline,
    Effect,
    ElementCouples,
    Loads,
    Motion,
    Rod,
    RodState,
    StabilityBound,
)
from jaxrod.geometry import vectors
from jaxrod.structure import pytree


@pytree
class ViscousDrag(Effect):
    """Viscous force and couple per current length; PyElastica mode only."""

    viscosity: Float[Array, ""]
    """Force per length and speed [kg/(m s)], and couple per length and spin."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Drag of each element, its force shared half and half by its nodes."""
        drag = -self.viscosity * motion.lengths
        x, y, z = motion.velocity
        means = (0.5 * (x[1:] + x[:-1]), 0.5 * (y[1:] + y[:-1]), 0.5 * (z[1:] + z[:-1]))
        return Loads(
            forces=vectors.pair_sum(vectors.scale(0.5 * drag, means)),
            # In PyElastica mode the spin is the material-frame angular velocity.
            couples=vectors.scale(drag, motion.spin),
        )

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Explicit drag, of the rod at its rest length."""
        drag = self.viscosity * rod.rest_lengths
        nodes = 0.5 * (vectors.pad(drag, 0, 1) + vectors.pad(drag, 1, 0))
        return StabilityBound(node_drag=nodes, element_drag=drag)


def muscle_couples(
    rod: Rod,
    state: RodState,
    spline: ControlSpline,
    controls: Float[Array, "3 n_controls"],
    torque_per_element: Array,
    dt: Array,
) -> ElementCouples:
    """Couples of the published muscles during one control step.

    The spline is read at the far ends of the elements in current arc length, as it
    is in the middle of the first step after the controls changed.

    Args:
        rod: The arm.
        state: Its state when the controls change.
        spline: Through the control points, in rest arc length.
        controls: Control values [1] about d1, d2 and d3.
        torque_per_element: Couple for a control value of one [N m].
        dt: Step size [s].
    """
    positions = state.positions + 0.5 * dt * state.velocities
    edges = positions[:, 1:] - positions[:, :-1]
    lengths = jnp.sqrt(jnp.sum(edges**2, axis=0))
    return ElementCouples(torque_per_element * spline(controls, jnp.cumsum(lengths)))
