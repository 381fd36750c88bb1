r"""Drag of a fluid on a rod: linear (Stokes), or quadratic in the speed.

Per length of rod, with the velocity relative to the flow along the rod ($w_\parallel$)
and across it ($w_\perp$), the force is

$$f = -\zeta_\parallel w_\parallel - \zeta_\perp w_\perp, \qquad
  f = -\tfrac12\rho\, 2r\,[c_\perp |w_\perp| w_\perp + \pi c_\parallel |w_\parallel|
  w_\parallel],$$

and the couple about the rod's axis is $-\zeta_\omega\omega_3$. This is resistive-force
theory: the rod does not change the flow, and its parts do not interact through it.
Explicit steps of the consistent law solve drag together with the loads
(`jaxrod.methods.drag_kick`), so it never limits the step.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect, Reach, StabilityBound
from jaxrod.effects.flows import Flow, as_flow
from jaxrod.effects.time import Timed
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.drag import Drag, drag_loads
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, is_traced, numeric


@pytree
class FluidDrag(Effect):
    """Base of drag in a fluid that may flow."""

    flow: Flow | None
    """Velocity of the fluid; `None` for a fluid at rest."""

    reach: ClassVar[Reach] = "neighbours"

    @abstractmethod
    def drag(self, rod: Rod, motion: Motion) -> Drag:
        """Rates of decay along and across the rod."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Drag as forces and couples, for methods that do not solve it."""
        return drag_loads(rod, motion, self.drag(rod, motion))

    def flow_at(self, motion: Motion) -> Vec3 | None:
        """Velocity of the fluid at the nodes [m/s]."""
        return None if self.flow is None else self.flow.at(motion.position)


@pytree
class StokesDrag(FluidDrag):
    """Drag in proportion to the speed; see `stokes_drag`."""

    along: Float[Array, "*n"]
    """Force per length and speed along the rod [kg/(m s)]."""
    across: Float[Array, "*n"]
    """Force per length and speed across the rod [kg/(m s)]."""
    turning: Float[Array, "*n"] | None
    """Couple per length and angular velocity about the axis [kg m/s]."""

    reach: ClassVar[Reach] = "neighbours"

    def drag(self, rod: Rod, motion: Motion) -> Drag:
        """Drag coefficients of nodes and elements, over mass or rotary inertia."""
        masses, turning = rod.node_masses, None
        if self.turning is not None:
            about = self.turning / rod.rotary_inertia[1]
            turning = about, jnp.zeros_like(about)
        return Drag(
            along=on_nodes(rod, self.along) / masses,
            across=on_nodes(rod, self.across) / masses,
            turning=turning,
            flow=self.flow_at(motion),
        )

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Largest drag coefficients of nodes and elements."""
        turning = self.turning
        return StabilityBound(
            node_drag=on_nodes(rod, jnp.maximum(self.along, self.across)),
            element_drag=None if turning is None else turning * rod.rest_lengths,
        )

    def resampled(self, rod: Rod, new_rod: Rod) -> StokesDrag:
        """The same drag if its coefficients are uniform along the rod.

        Raises:
            ValueError: If they differ from element to element.
        """
        if any(map(jnp.ndim, jax.tree.leaves(replace(self, flow=None)))):
            raise ValueError(
                "stokes_drag with numbers per element cannot be taken to another "
                "number of elements"
            )
        return self


@pytree
class QuadraticDrag(FluidDrag):
    """Drag in proportion to the square of the speed; see `quadratic_drag`."""

    density: Float[Array, ""]
    """Density of the fluid [kg/m^3]."""
    across: Float[Array, ""]
    """Drag coefficient across the rod, referred to its frontal area [1]."""
    along: Float[Array, ""]
    """Friction coefficient along the rod, referred to its surface [1]."""

    reach: ClassVar[Reach] = "neighbours"

    def drag(self, rod: Rod, motion: Motion) -> Drag:
        """Drag per speed of the nodes, over their masses."""
        area = on_nodes(rod, self.density * rod.radii) / rod.node_masses
        still = jnp.zeros_like(self.density)
        return Drag(
            along=still,
            across=still,
            along_per_speed=jnp.pi * self.along * area,
            across_per_speed=self.across * area,
            flow=self.flow_at(motion),
        )


def on_nodes(rod: Rod, per_length: Array) -> Array:
    """Quantity per length of the elements, integrated and shared by their nodes."""
    half = 0.5 * per_length * rod.rest_lengths
    return vectors.pad(half, 0, 1) + vectors.pad(half, 1, 0)


# Factories that users call. They check their arguments and explain errors.


def stokes_drag(
    along: Numbers,
    across: Numbers,
    turning: Numbers = 0.0,
    *,
    flow: Flow | Timed | None = None,
) -> StokesDrag:
    """Drag in proportion to the speed, as in viscous fluid.

    `stokes_drag(*slender_cylinder(viscosity, length, radius))` is the drag of a thin
    rod in an unbounded fluid.

    Args:
        along: Force per length and speed along the rod, at least 0, one number or one
            per element `(n,)` [kg/(m s)].
        across: Force per length and speed across the rod, in the same form [kg/(m s)].
        turning: Couple per length and angular velocity about the axis [kg m/s]. If it
            is known to be 0 it is left out, as `torsion_free()` requires.
        flow: Velocity of the fluid, world frame `(3,)`, a schedule of it, or a
            `jaxrod.fluids.flow_field` [m/s]; at rest by default. Its vorticity is
            neglected in the couple.

    Returns:
        An effect to list in a scene; a scene may have one effect with drag.

    Raises:
        ValueError: If a number is out of range.
    """
    turns = _coefficient("turning", turning, "kg m/s")
    known_zero = not is_traced(turns) and not np.any(turns)
    return StokesDrag(
        flow=as_flow(flow),
        along=_coefficient("along", along, "kg/(m s)"),
        across=_coefficient("across", across, "kg/(m s)"),
        turning=None if known_zero else turns,
    )


def slender_cylinder(
    viscosity: Numbers, length: Numbers, radius: Numbers
) -> tuple[Array, Array, Array]:
    r"""Drag coefficients of a long straight cylinder in a viscous fluid.

    $$\zeta_\parallel = \frac{2\pi\eta}{\ln(L/r) - 0.807}, \quad
      \zeta_\perp = \frac{4\pi\eta}{\ln(L/r) + 0.193}, \quad
      \zeta_\omega = 4\pi\eta r^2,$$

    G. K. Batchelor, J. Fluid Mech. 44 (1970) 419, to first order in the inverse of the
    logarithm.

    Args:
        viscosity: Dynamic viscosity of the fluid [Pa s].
        length: Length of the cylinder, at least ten times its radius [m].
        radius: Radius of the cylinder [m].

    Returns:
        Coefficients along, across and of rotation, as `stokes_drag` takes them.

    Raises:
        ValueError: If a number is not positive, or the cylinder is not slender.
    """
    eta = as_array("viscosity", viscosity, "Pa s", positive=True)
    long = as_array("length", length, "m", positive=True)
    thin = as_array("radius", radius, "m", positive=True)
    if not is_traced(long, thin) and not float(long) >= 10 * float(thin):
        raise ValueError(
            "length must be at least 10 times radius for a slender cylinder, got "
            f"{float(long):.3g} m and {float(thin):.3g} m"
        )
    slenderness = jnp.log(long / thin)
    turning = 4 * jnp.pi * eta * thin**2
    if not is_traced(turning) and not jnp.finfo(turning.dtype).tiny <= turning:
        raise ValueError(
            "radius must not be so small that the drag of turning is lost in "
            f"{turning.dtype}, got {float(thin):.3g} m"
        )
    return (
        2 * jnp.pi * eta / (slenderness - 0.807),
        4 * jnp.pi * eta / (slenderness + 0.193),
        turning,
    )


def quadratic_drag(
    density: Numbers,
    *,
    across: Numbers = 1.0,
    along: Numbers = 0.0,
    flow: Flow | Timed | None = None,
) -> QuadraticDrag:
    r"""Drag quadratic in the speed, as in water at higher Reynolds numbers.

    $$f = -\tfrac12\rho\,2r\,[c_\perp |w_\perp| w_\perp + \pi c_\parallel |w_\parallel|
      w_\parallel]$$

    per length of a round rod of radius $r$, the same in all directions across it. The
    radii are `rod.radii`.

    Args:
        density: Density of the fluid [kg/m^3].
        across: Drag coefficient across the rod, referred to its frontal area [1].
        along: Friction coefficient along the rod, referred to its surface [1]. A
            fiftieth of `across` fits the arm of an octopus (Yekutieli et al.,
            J. Neurophysiol. 94 (2005) 1443).
        flow: Velocity of the fluid, as in `stokes_drag`.

    Returns:
        An effect to list in a scene; a scene may have one effect with drag.

    Raises:
        ValueError: If a number is out of range.
    """
    return QuadraticDrag(
        flow=as_flow(flow),
        density=as_array("density", density, "kg/m^3", positive=True),
        across=as_array("across", across, "", non_negative=True),
        along=as_array("along", along, "", non_negative=True),
    )


def _coefficient(name: str, value: Numbers, unit: str) -> Array:
    """Checks a coefficient: one number, or one per element."""
    given = numeric(name, value, unit)
    if given.ndim > 1:
        raise ValueError(
            f"{name} must be one number or one per element, got shape {given.shape}"
        )
    return as_array(name, given, unit, [given.shape], non_negative=True)
