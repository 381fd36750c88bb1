r"""Plastic bending: a rod that keeps a set where its moment has exceeded a limit.

The curvature is the sum of that at rest $\kappa_0$, an elastic part and the set $p$;
the moment is $B(\kappa - \kappa_0 - p)$. With $q = B(\kappa - \kappa_0 - p/(1 - h))$,
the moment without that of hardening, the rod is elastic while $|q| \le m_y$. Beyond, it
yields along $q$, and its stiffness is $hB$: $h = 0$ is perfectly plastic. Both
components of bending yield together, so no direction is preferred. Given the curvature,
the set follows in closed form (return mapping):

$$p \to p + (1 - h)\,\frac{\max(|q| - m_y,\,0)}{B}\,\frac{q}{|q|}.$$

A rod bent once to $\kappa > \kappa_y = m_y/B$ has the moment
$m_y + hB(\kappa - \kappa_y)$ and, unloaded, the set
$(1 - h)(\kappa - \kappa_y)$. Elastic bending and hardening store energy,
and yielding loses $m_y\,|dp|$ per length.

Source: Simo and Hughes, Computational Inelasticity (1998), sections 1.2 to 1.4.
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
    stiffness_at_nodes,
    transport_bound,
    walls_of,
)
from jaxrod.effects.base import StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.geometry import vectors
from jaxrod.materials.law import Material, bent
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import memory, pytree
from jaxrod.validation import Numbers, as_array, check_kind


@pytree
class PlasticBending(Material):
    """Set that a rod keeps where it was bent too far; see `plastic_bending`.

    Example:
        >>> yields = materials.plastic_bending(rod, yield_moment=0.1)
        >>> yields.set.shape, float(yields.hardening)
        ((3, 11), 0.0)
    """

    yield_moment: Float[Array, ""]
    """Moment above which the rod yields, $m_y$ [N m]."""
    hardening: Float[Array, ""]
    """Bending stiffness while the rod yields over the elastic one, $h$ [1]."""
    set: Float[Array, "3 n+1"] = memory()
    """Plastic curvature of the joint at each node, about d1 and d2 [1/m]."""
    walls: Walls = ()
    """Walls at ends of the rod whose joints yield, too."""

    def check(self, rod: Rod) -> None:
        """Raises ValueError if the sections of the rod are not round."""
        if not rod.is_round:
            raise ValueError(
                "plastic_bending needs round sections: its law does not hold for a rod "
                "that is stiffer about one axis than about the other"
            )

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Energy with the set and of hardening, minus that of an elastic rod [J]."""
        now = self.measures(rod, strains)
        set_ = self._set(rod, now.curvature)
        elastic = bent(now.curvature - rest_curvatures_at_nodes(rod))
        energy = set_ * (0.5 * set_ / (1 - self.hardening) - vectors.join(elastic))
        return jnp.sum((now.lengths * self._stiffness(rod))[None, :] * energy)

    def stress(self, rod: Rod, strains: SectionStrains) -> SectionStress:
        """Moment that the set takes from the elastic one."""
        set_ = self._set(rod, self.measures(rod, strains).curvature)
        lost = vectors.scale(-self._stiffness(rod), vectors.split(set_))
        return SectionStress(moment=lost)

    def after_step(self, rod: Rod, motion: Motion, dt: Array) -> PlasticBending:
        """The material with the set that the curvature of `motion` leaves."""
        return replace(self, set=self._set(rod, self.seen(rod, motion).curvature))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness that the moment adds because it turns with the rod."""
        size = vectors.safe_norm(vectors.split(self.set))
        return transport_bound(rod, moment=self._stiffness(rod) * size)

    def _stiffness(self, rod: Rod) -> Array:
        """Bending stiffness of the joint at each node [N m^2]."""
        return stiffness_at_nodes(rod)[0]

    def _set(self, rod: Rod, curvature: Array) -> Array:
        """Set that remains after bending to a curvature `(3, n + 1)` [1/m]."""
        soft = 1 - self.hardening
        elastic = curvature - rest_curvatures_at_nodes(rod) - self.set / soft
        there = bent(elastic)
        size = vectors.safe_norm(there)
        limit = self.yield_moment / self._stiffness(rod)
        beyond = size > limit
        share = jnp.where(beyond, 1 - limit / jnp.where(beyond, size, 1), 0)
        return self.set + (soft * share)[None, :] * vectors.join(there)


def plastic_bending(
    rod: Rod,
    *,
    yield_moment: Numbers,
    hardening: Numbers = 0.0,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> PlasticBending:
    r"""Plastic set: a rod that stays bent where its moment has exceeded a limit.

    Up to the moment $m_y$ the rod is elastic; beyond it bends with $h$ times its
    stiffness, and keeps the difference as a set. Twist, shear and stretch stay elastic.
    Derivatives are exact on either side of the limit; at the limit itself they jump.

    Args:
        rod: The rod, with its elastic stiffness and round sections.
        yield_moment: Moment above which it yields, $m_y$ [N m].
        hardening: Bending stiffness beyond, over the elastic one: from 0, perfectly
            plastic, to below 1, $h$ [1].
        into: The `clamp` of an end, or a tuple of two, whose joint yields, too.

    Raises:
        ValueError: If a number is out of range, or two clamps are at the same end.
            `make_scene` raises it if sections are not round.
        TypeError: If `rod` or `into` is of another type.

    Source: Simo and Hughes, Computational Inelasticity (1998), sections 1.2 to 1.4.

    Example:
        >>> yields = materials.plastic_bending(rod, yield_moment=0.1, hardening=0.2)
        >>> wall, pull = jaxrod.clamp(state), jaxrod.end_load((0.0, 0.0, -0.3))
        >>> loaded = jaxrod.make_scene(rod, wall, yields, pull)
        >>> bent = jaxrod.equilibrium(loaded, state).state
        >>> free = replace(loaded, effects=(wall, yields, jaxrod.end_load((0.0,) * 3)))
        >>> left = jaxrod.equilibrium(free, bent).state
        >>> bool(left.tip[2] < -0.01)
        True
    """
    check_kind("rod", rod, Rod)
    dtype = rod.rest_lengths.dtype
    largest = 1 - float(jnp.finfo(dtype).eps)
    return PlasticBending(
        as_array("yield_moment", yield_moment, "N m", positive=True, dtype=dtype),
        as_array(
            "hardening",
            hardening,
            "",
            non_negative=True,
            at_most=largest,
            dtype=dtype,
        ),
        jnp.zeros_like(rest_curvatures_at_nodes(rod)),
        walls_of(into),
    )
