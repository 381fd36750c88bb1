"""Actuation: couples along a rod, shaped by a spline through a few control values."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect
from jaxrod.effects.control_splines import ControlSpline, ElementAverages
from jaxrod.effects.time import (
    Clock,
    Schedule,
    Timed,
    as_timed,
    at_clock,
    at_largest,
    depends_on_time,
)
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix, skew
from jaxrod.geometry.rotations import directors, to_world
from jaxrod.rods.along_rod import interpolated
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, check_kind, numeric


@pytree
class ElementCouples(Effect):
    """Given couples on all elements, turning with them. The channel of control."""

    couples: Float[Array, "3 n"]
    """Couples, material frame [N m]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Couples on the elements."""
        return Loads(couples=(self.couples[0], self.couples[1], self.couples[2]))

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix:
        """Tangent of couples that turn with the elements."""
        couples = vectors.split(self.couples)
        return skew(to_world(directors(motion.orientation), couples))

    @property
    def twists(self) -> str:
        """Name of the couples, all of which turn with the elements."""
        return "couples in the material frame"

    def resampled(self, rod: Rod, new_rod: Rod) -> ElementCouples:
        """Couples of the same density per rest length, interpolated between middles."""
        density = interpolated(
            np.asarray(self.couples / rod.rest_lengths[None, :]),
            np.asarray(rod.arc_length_midpoints),
            np.asarray(new_rod.arc_length_midpoints),
        )
        lengths = new_rod.rest_lengths[None, :]
        return ElementCouples(jnp.asarray(density, lengths.dtype) * lengths)


@pytree
class SplineCouples(Schedule):
    """Couples in proportion to a spline whose values or density depend on time."""

    averages: ElementAverages
    """The spline's averages over the elements."""
    controls: Any
    """Control values about d1, d2, d3 `(3, n_controls)`, or a schedule of them [1]."""
    couple_density: Any
    """Couple per rest length for a control value of one, or a schedule of it; one
    number or three [N m/m]."""
    lengths: Float[Array, " n"]
    """Rest lengths of the elements [m]."""

    def __call__(self, clock: Clock) -> Float[Array, "3 n"]:
        """Couples at a time [N m]."""
        controls, density = at_clock((self.controls, self.couple_density), clock)
        return _couples(self.averages, controls, density, self.lengths)

    @property
    def largest(self) -> Float[Array, "3 n"]:
        """Couples when all controls are largest and their absolute values add [N m]."""
        averages, controls, density = jax.tree.map(
            jnp.abs, (self.averages, *at_largest((self.controls, self.couple_density)))
        )
        return _couples(averages, controls, density, self.lengths)


def _couples(
    averages: ElementAverages, controls: Array, density: Array, lengths: Array
) -> Float[Array, "3 n"]:
    """Couples on the elements [N m]."""
    per_length = jnp.broadcast_to(density, (3,))[:, None] * averages(controls)
    return per_length * lengths[None, :]


def spline_couples(
    rod: Rod,
    spline: ControlSpline | ElementAverages,
    controls: Timed,
    couple_density: Timed,
) -> ElementCouples:
    """Couples distributed along the rod in proportion to a spline, per rest length.

    The form does not depend on the resolution: the couple on an element is the integral
    of the density over it, so refining the rod does not change the load.

    Args:
        rod: The rod.
        spline: Spline from `control_spline`; or its averages over the elements of this
            rod, `spline.averaged(rod)`, if controls change often.
        controls: Control values [1] about d1, d2 (bending) and d3 (twist)
            `(3, n_controls)`, or a schedule of them.
        couple_density: Couple per rest length for a control value of one [N m/m];
            one number, or one per direction `(3,)`, or a schedule of either.

    Returns:
        An effect to list in a scene.

    Raises:
        ValueError: If an argument is not finite or of the wrong shape.
    """
    check_kind("rod", rod, Rod)
    check_kind("spline", spline, (ControlSpline, ElementAverages))
    kind = rod.rest_lengths.dtype
    shape = (3, spline.n_controls)
    values = as_timed("controls", controls, "", shape, dtype=kind)
    density = as_timed("couple_density", couple_density, "N m/m", (), (3,), dtype=kind)
    averages = spline.averaged(rod)
    if not depends_on_time((values, density)):
        return ElementCouples(_couples(averages, values, density, rod.rest_lengths))
    timed: Any = SplineCouples(averages, values, density, rod.rest_lengths)
    return ElementCouples(timed)


def limit_rate(
    applied: Numbers,
    commanded: Numbers,
    largest_change: Numbers,
) -> Float[Array, "*shape"]:
    """Moves applied control values towards the commanded ones at a limited rate.

    Args:
        applied: Values that the actuator applies now.
        commanded: Values that it should apply.
        largest_change: Largest change of any value, in the unit of the values:
            the actuator's rate times the time since the last call.

    Returns:
        Values that the actuator applies next.

    Raises:
        ValueError: If `largest_change` is negative.
    """
    now, wanted = numeric("applied", applied), numeric("commanded", commanded)
    given = applied, commanded
    arrays = [value for value in given if isinstance(value, np.ndarray | jax.Array)]
    kind = jnp.result_type(*arrays, float)
    if wanted.shape != now.shape:
        raise ValueError(
            f"commanded must have shape {now.shape}, as applied has, got {wanted.shape}"
        )
    allowed = [(), now.shape]
    bound = as_array(
        "largest_change", largest_change, "", allowed, non_negative=True, dtype=kind
    )
    # Commands that are not finite are data, for `health` to find.
    with np.errstate(over="ignore"):
        now, wanted = jnp.asarray(now, kind), jnp.asarray(wanted, kind)
    return now + jnp.clip(wanted - now, -bound, bound)
