r"""Active shape: a time-dependent curvature and strain added to a rod's rest shape.

With the active curvature $\kappa_a$ and strain $\sigma_a$ the stored energy of the rod
is taken about the rest shape $\kappa_0 + \kappa_a$, $\sigma_0 + \sigma_a$: the moment
$-B\kappa_a$ and the force $-S\sigma_a$ are added to the elastic ones. This models
growth on one side, swelling and thermal expansion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.actuation.section_load import (
    SectionLoad,
    SectionStrains,
    SectionStress,
    Walls,
    joint_lengths_at_nodes,
    rest_curvatures_at_nodes,
    stiffness_at_nodes,
    transport_bound,
    walls_of,
)
from jaxrod.effects.base import Reach, StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.time import Scheduled, Timed, as_timed, is_schedule
from jaxrod.geometry import vectors
from jaxrod.rods.rod import Rod, middle_places, node_places, resampled_along
from jaxrod.structure import pytree
from jaxrod.validation import check_kind


@pytree
class ActiveShape(SectionLoad):
    """Curvature and strain added to the rest shape of a rod; see `active_shape`.

    Example:
        >>> shape = actuation.active_shape(rod, curvature=(0.0, 2.0, 0.0))
        >>> curled = jaxrod.make_scene(rod, shape)
        >>> round(float(curled.potential_energy(state)), 3)  # B k^2 / 2 times 0.9 m
        0.226
    """

    curvature: Scheduled | None
    """Curvature added at the joint of each node `(3, n + 1)`, or at all joints `(3,)`,
    material frame [1/m]."""
    strain: Scheduled | None
    """Strain added in each element `(3, n)`, or in all `(3,)`, material frame [1]."""
    walls: Walls = ()
    """Walls at ends of the rod into which the curvature continues."""

    reach: ClassVar[Reach] = "neighbours"

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Elastic energy with the added shape, minus that without [J]."""
        total = jnp.zeros((), rod.rest_lengths.dtype)
        if self.curvature is not None:
            curvature, stiffness = _wide(self.curvature), stiffness_at_nodes(rod)
            lengths = joint_lengths_at_nodes(rod, self.walls)[None, :]
            rest = rest_curvatures_at_nodes(rod) * lengths
            turned = vectors.join(strains.rotations) - rest
            own = stiffness * curvature * (0.5 * curvature * lengths - turned)
            total = total + jnp.sum(jnp.where(lengths > 0, own, 0))
        if self.strain is not None:
            strain, lengths = _wide(self.strain), rod.rest_lengths[None, :]
            axis = jnp.zeros_like(rod.rest_strains).at[2].set(1)
            moved = vectors.join(strains.edges) - (axis + rod.rest_strains) * lengths
            stretch = rod.shear_stretch_stiffness * strain
            total = total + jnp.sum(stretch * (0.5 * strain * lengths - moved))
        return total

    def stress(self, rod: Rod, strains: SectionStrains) -> SectionStress:
        """Force and moment that the added shape adds to the elastic ones."""
        force = moment = None
        if self.curvature is not None:
            moment = vectors.split(-stiffness_at_nodes(rod) * _wide(self.curvature))
        if self.strain is not None:
            force = vectors.split(-rod.shear_stretch_stiffness * _wide(self.strain))
        return SectionStress(force, moment)

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness that the stress adds because it turns with the rod."""
        force = moment = None
        if self.curvature is not None:
            bent = stiffness_at_nodes(rod) * _wide(self.curvature)
            moment = vectors.safe_norm(vectors.split(bent))
        if self.strain is not None:
            pulled = rod.shear_stretch_stiffness * _wide(self.strain)
            force = vectors.safe_norm(vectors.split(pulled))
        return transport_bound(rod, force, moment)

    def resampled(self, rod: Rod, new_rod: Rod) -> ActiveShape:
        """The same shape for `new_rod`, interpolated along the rod."""
        return replace(
            self,
            curvature=_resampled(
                self.curvature, node_places(rod), node_places(new_rod)
            ),
            strain=_resampled(self.strain, middle_places(rod), middle_places(new_rod)),
        )


def _wide(values: Array) -> Array:
    """Values as a matrix: three numbers `(3,)` become a column `(3, 1)`."""
    return values[:, None] if values.ndim == 1 else values


def _resampled(values: Any, old: Any, new: Any) -> Any:
    if values is None:
        return None
    if is_schedule(values):
        everywhere = jnp.ndim(values.largest) == 1
        return values if everywhere else values.resampled_along(old, new)
    return values if values.ndim == 1 else resampled_along(values, old, new)


def active_shape(
    rod: Rod,
    *,
    curvature: Timed | None = None,
    strain: Timed | None = None,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> ActiveShape:
    """Adds a curvature and a strain to the rest shape of a rod.

    Args:
        rod: The rod.
        curvature: Curvature added to that at rest, material frame: `(3,)`, or one per
            node `(3, n + 1)`, or a schedule of either [1/m].
        strain: Strain added to that at rest, material frame: `(3,)`, or one per element
            `(3, n)`, or a schedule of either [1].
        into: The `clamp` of an end, or a tuple of two, into whose wall the curvature
            continues.

    Raises:
        ValueError: If both are left out, or one is of the wrong shape.
        TypeError: If `rod` or `into` has the wrong type.

    Example:
        >>> warm = actuation.active_shape(rod, strain=(0.0, 0.0, 0.01))  # 1 % longer
        >>> scene = jaxrod.make_scene(rod, warm)
        >>> longer = replace(state, positions=1.01 * state.positions)
        >>> round(abs(float(scene.potential_energy(longer))), 6)  # this is at rest
        0.0
    """
    check_kind("rod", rod, Rod)
    if curvature is None and strain is None:
        raise ValueError("an active shape needs a curvature in 1/m, a strain, or both")
    n = rod.n_elements
    bent = stretched = None
    if curvature is not None:
        bent = as_timed("curvature", curvature, "1/m", (3,), (3, n + 1))
    if strain is not None:
        stretched = as_timed("strain", strain, "", (3,), (3, n))
    return ActiveShape(bent, stretched, walls_of(into))
