r"""Standard linear solid: an elastic rod beside a branch that relaxes.

The branch is a spring in series with a dashpot (Maxwell). Its spring has $r$ times the
stiffness of the rod, and its dashpot lets go within the relaxation time $\tau$. With
the strain $e$ (any of the six) and the strain $v$ of the dashpot,

$$s = K_\infty\,(e - e_0) + r K_\infty\,(e - v), \qquad \tau\,\dot v = e - v.$$

A strain that is held has the relaxation modulus $K_\infty (1 + r e^{-t/\tau})$; a load
that is held creeps with the time $(1 + r)\,\tau$; at the angular frequency $\omega$ the
storage and loss moduli are

$$K' = K_\infty\Bigl(1 + \frac{r\,\omega^2\tau^2}{1 + \omega^2\tau^2}\Bigr), \qquad
  K'' = \frac{K_\infty\,r\,\omega\tau}{1 + \omega^2\tau^2}.$$

A step of size $h$ knows the strain $e$ in its middle. There the spring of the branch
has the strain $g\,(e - v)$ with $g = (1 - e^{-h/\tau})\,\tau/h$, and at the end of the
step $v$ has become $e + e^{-h/\tau}(v - e)$. Eliminating $v$ gives the recursion

$$w_{k+1} = e^{-h/\tau} w_k + g\,(e_{k+1} - e_k)$$

for the strain $w$ of the spring from middle to middle: the exact solution for a strain
that changes linearly between them. It is of second order, the branch never gains
energy, and any $\tau$ is stable at the step of the rod with both springs.

Source: Christensen, Theory of Viscoelasticity (1982), chapter 1; Simo and Hughes,
Computational Inelasticity (1998), section 10.3, for the recursion.
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
    stiffness_at_nodes,
    walls_of,
)
from jaxrod.effects.base import StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.geometry import vectors
from jaxrod.materials.law import Material
from jaxrod.rods.drag import mean_decay
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import memory, pytree
from jaxrod.validation import Numbers, as_array, check_kind


@pytree
class StandardLinearSolid(Material):
    """Spring and dashpot parallel to the elastic rod; see `standard_linear_solid`.

    Example:
        >>> branch = materials.standard_linear_solid(
        ...     rod, stiffness_ratio=0.5, relaxation_time=0.1
        ... )
        >>> longer = replace(state, positions=1.01 * state.positions)
        >>> fresh = jaxrod.make_scene(rod, branch).potential_energy(longer)
        >>> round(float(fresh / jaxrod.stored_energy(rod, longer)), 3)
        1.5
    """

    stiffness_ratio: Float[Array, ""]
    """Stiffness of the branch over that of the rod [1]."""
    relaxation_time: Float[Array, ""]
    """Viscosity of the dashpot over the stiffness of the branch [s]."""
    curvature: Float[Array, "3 n+1"] = memory()
    """Curvature and twist of the dashpot at each node, material frame [1/m]."""
    strain: Float[Array, "3 n"] = memory()
    """Shear and stretch of the dashpot in each element, material frame [1]."""
    walls: Walls = ()
    """Walls at ends of the rod into which the material continues."""
    elapsed: Float[Array, ""] | float = 0.0
    """Time since the dashpot had the strains of the memory; zero outside of a step
    [s]."""

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Energy of the spring of the branch [J]."""
        now = self.measures(rod, strains)
        bent, strained = now.curvature - self.curvature, now.strain - self.strain
        bending = now.lengths[None, :] * stiffness_at_nodes(rod) * bent**2
        stretching = rod.rest_lengths[None, :] * rod.shear_stretch_stiffness
        stretching = stretching * strained**2
        return 0.5 * self.stiffness_ratio * (jnp.sum(bending) + jnp.sum(stretching))

    def stress(self, rod: Rod, strains: SectionStrains) -> SectionStress:
        """Force and moment of the spring of the branch."""
        now = self.measures(rod, strains)
        kept = mean_decay(2 * self.elapsed / self.relaxation_time)
        ratio = kept * self.stiffness_ratio
        moment = ratio * stiffness_at_nodes(rod) * (now.curvature - self.curvature)
        force = ratio * rod.shear_stretch_stiffness * (now.strain - self.strain)
        return SectionStress(vectors.split(force), vectors.split(moment))

    def during_step(self, elapsed: Array) -> StandardLinearSolid:
        """The branch a time `elapsed` after the beginning of a step [s]."""
        return replace(self, elapsed=elapsed)

    def after_step(self, rod: Rod, motion: Motion, dt: Array) -> StandardLinearSolid:
        """The branch after a step, with strains of the dashpot that have followed."""
        now, kept = self.seen(rod, motion), jnp.exp(-dt / self.relaxation_time)
        return replace(
            self,
            curvature=now.curvature + kept * (self.curvature - now.curvature),
            strain=now.strain + kept * (self.strain - now.strain),
        )

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound of the stiffness of the branch, as if the dashpot did not move."""
        shear = jnp.maximum(*rod.shear_stretch_stiffness[:2])
        bending = jnp.max(stiffness_at_nodes(rod), axis=0)
        ratio = self.stiffness_ratio
        return section_bound(
            rod,
            stretch=ratio * rod.shear_stretch_stiffness[2] / rod.rest_lengths,
            shear=ratio * shear / rod.rest_lengths,
            turning=ratio * self.turning_stiffness(rod, bending),
        )


def standard_linear_solid(
    rod: Rod,
    *,
    stiffness_ratio: Numbers,
    relaxation_time: Numbers,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> StandardLinearSolid:
    r"""Material that relaxes: a branch of spring and dashpot beside the elastic rod.

    A strain is at first resisted by $1 + r$ times the stiffness of the rod, and after
    a long time by the rod alone: $K(t) = K_\infty (1 + r e^{-t/\tau})$, for bending,
    twist, shear and stretch alike. Several such effects in a scene are a generalised
    Maxwell solid (Prony series). The dashpots begin in the rest shape of the rod.

    Args:
        rod: The rod, with the stiffness that remains after a long time.
        stiffness_ratio: Stiffness of the branch over that of the rod, $r$ [1].
        relaxation_time: Time in which a held stress of the branch falls to 1/e, $\tau$
            [s].
        into: The `clamp` of an end, or a tuple of two, whose joint relaxes, too.

    Raises:
        ValueError: If a number is not positive, or two clamps are at the same end.
        TypeError: If `rod` or `into` is of another type.

    Source: Christensen, Theory of Viscoelasticity (1982), chapter 1.

    Example:
        >>> wall = jaxrod.clamp(state)
        >>> branch = materials.standard_linear_solid(
        ...     rod, stiffness_ratio=2.0, relaxation_time=0.05, into=wall
        ... )
        >>> scene = jaxrod.make_scene(rod, wall, jaxrod.gravity(), branch)
        >>> dt = jaxrod.stable_dt(scene).dt
        >>> after = jaxrod.advance(scene, state, dt, 100)
        >>> after.memory[2]["curvature"].shape
        (3, 11)
    """
    check_kind("rod", rod, Rod)
    dtype = rod.rest_lengths.dtype
    return StandardLinearSolid(
        as_array("stiffness_ratio", stiffness_ratio, "", positive=True, dtype=dtype),
        as_array("relaxation_time", relaxation_time, "s", positive=True, dtype=dtype),
        rest_curvatures_at_nodes(rod),
        rod.rest_strains,
        walls_of(into),
        jnp.zeros((), dtype),
    )
