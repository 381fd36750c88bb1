r"""Hysteresis of bending, as in wire ropes and cables: friction after Dahl.

The wires of a rope slip past each other while it bends. To the elastic moment this adds
a moment $m$ that follows the curvature $\kappa$ with the stiffness $\sigma$ as long as
they stick, and is at most $m_c$ when all of them slip. In a plane it is Dahl's law,
with the exponent one; in space it is the same law for the vector of both components,
which prefers no direction:

$$\frac{dm}{d\kappa} = \sigma\Bigl(1 - \frac{m}{m_c}\,\mathrm{sgn}\,\dot\kappa\Bigr),
  \qquad dm = \sigma\Bigl(d\kappa - \frac{m}{m_c}\,|d\kappa|\Bigr).$$

Time does not appear in it: the moment depends on the path of the curvature, and not on
the speed. Along a straight path of length $a = |\Delta\kappa|$ the solution is

$$m \to m\,e^{-x} + \sigma\,\frac{1 - e^{-x}}{x}\,\Delta\kappa, \qquad
  x = \frac{\sigma a}{m_c},$$

so steps may be of any size as long as the curvature does not turn back within one. In
cycles between $-\kappa_a$ and $\kappa_a$ the moment settles on a loop that ends at
$\pm m_c\tanh x_a$ with $x_a = \sigma\kappa_a/m_c$, and has the area

$$4\,m_c\,\kappa_a\Bigl(1 - \frac{\tanh x_a}{x_a}\Bigr).$$

$m^2/2\sigma$ is stored and $m^2\,|d\kappa|/m_c$ is lost, both per length.

Source: Dahl, Solid friction damping of mechanical vibrations, AIAA Journal 14 (1976).
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.actuation.section_load import (
    SectionStrains,
    SectionStress,
    Walls,
    rest_curvatures_at_nodes,
    section_bound,
    together,
    transport_bound,
    walls_of,
)
from jaxrod.effects.base import StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.geometry import vectors
from jaxrod.materials.law import Material, bent
from jaxrod.rods.drag import mean_decay
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import memory, pytree
from jaxrod.validation import Numbers, as_array, check_kind


@pytree
class BendingHysteresis(Material):
    """Friction between the wires of a rod that bends; see `bending_hysteresis`.

    Example:
        >>> wires = materials.bending_hysteresis(rod, stiffness=0.2, slip_moment=0.05)
        >>> wires.moment.shape, round(float(wires.slip_moment), 3)
        ((3, 11), 0.05)
    """

    stiffness: Float[Array, ""]
    r"""Bending stiffness that wires add while they stick, $\sigma$ [N m^2]."""
    slip_moment: Float[Array, ""]
    """Largest moment of friction $m_c$, while all wires slip [N m]."""
    curvature: Float[Array, "3 n+1"] = memory()
    """Curvature of the joint at each node after the last step, about d1 and d2
    [1/m]."""
    moment: Float[Array, "3 n+1"] = memory()
    """Moment of friction of the joint at each node after the last step, about d1 and d2
    [N m]."""
    walls: Walls = ()
    """Walls at ends of the rod into which the wires continue."""

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Energy of wires that stick: squared moment over twice the stiffness [J]."""
        now = self.measures(rod, strains)
        moment = self._moment(now.curvature)
        return 0.5 * jnp.sum(now.lengths[None, :] * moment**2) / self.stiffness

    def stress(self, rod: Rod, strains: SectionStrains) -> SectionStress:
        """Moment of friction."""
        curvature = self.measures(rod, strains).curvature
        return SectionStress(moment=vectors.split(self._moment(curvature)))

    def after_step(self, rod: Rod, motion: Motion, dt: Array) -> BendingHysteresis:
        """The wires after the curvature has changed to that of `motion`."""
        curvature = self.seen(rod, motion).curvature
        return replace(self, curvature=curvature, moment=self._moment(curvature))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound of twice the stiffness, that of bending back when all wires slip."""
        turning = self.turning_stiffness(rod, 2 * self.stiffness)
        slips = jnp.broadcast_to(self.slip_moment, turning.shape)
        return together(
            section_bound(rod, turning=turning), transport_bound(rod, moment=slips)
        )

    def _moment(self, curvature: Array) -> Array:
        """Moment of friction after a straight path to a curvature `(3, n + 1)`."""
        change = bent(curvature - self.curvature)
        size = self.stiffness / self.slip_moment * vectors.safe_norm(change)
        kept, gain = jnp.exp(-size), self.stiffness * mean_decay(size)
        return kept[None, :] * self.moment + gain[None, :] * vectors.join(change)


def bending_hysteresis(
    rod: Rod,
    *,
    stiffness: Numbers,
    slip_moment: Numbers,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> BendingHysteresis:
    r"""Hysteresis of wire ropes and cables: friction of bending, after Dahl.

    It adds the moment $m$ to the elastic one, with $dm = \sigma (d\kappa - m\,|d\kappa|
    / m_c)$. Bending is stiffer by $\sigma$ where it begins or turns back, and loses
    energy in proportion to the path of the curvature, however slow it is. Twist, shear
    and stretch stay elastic. The wires begin without moment in the rest shape.

    Args:
        rod: The rod, with the bending stiffness of wires that slip.
        stiffness: Bending stiffness that wires add while they stick, $\sigma$ [N m^2].
        slip_moment: Moment of friction while all wires slip, $m_c$ [N m].
        into: The `clamp` of an end, or a tuple of two, into which the wires continue.

    Raises:
        ValueError: If a number is not positive, or two clamps are at the same end.
        TypeError: If `rod` or `into` is of another type.

    Source: Dahl, Solid friction damping of mechanical vibrations, AIAA Journal 14
    (1976).

    Example:
        >>> wires = materials.bending_hysteresis(rod, stiffness=0.2, slip_moment=0.05)
        >>> scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity(), wires)
        >>> after = jaxrod.advance(scene, state, jaxrod.stable_dt(scene).dt, 100)
        >>> bool(jnp.max(jnp.abs(after.memory[2]["moment"])) < 0.05)
        True
    """
    check_kind("rod", rod, Rod)
    dtype = rod.rest_lengths.dtype
    curvature = rest_curvatures_at_nodes(rod)
    return BendingHysteresis(
        as_array("stiffness", stiffness, "N m^2", positive=True, dtype=dtype),
        as_array("slip_moment", slip_moment, "N m", positive=True, dtype=dtype),
        curvature,
        jnp.zeros_like(curvature),
        walls_of(into),
    )
