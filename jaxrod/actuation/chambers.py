r"""Chambers under pressure inside a rod: energy $-p V$.

A plain chamber of cross-sectional area $A$ has the volume $A \Lambda$, where the length
$\Lambda$ of its axis changes with stretch and bending. It pushes along the rod with
$p A$ and bends it with $p A$ times its offset. A chamber may be wound with inextensible
fibres at the angle $\alpha$ to its axis. It then has the volume of a cylinder in which
a fibre of length $b$ turns by $\Phi$ over a length $\Lambda$,

$$V = \pi \Lambda\,\frac{b^2 - \Lambda^2}{\Phi^2},$$

so that, at the rest shape, it pushes with $p\pi r^2 (1 - 2\cot^2\alpha)$ and unwinds
with the moment $2 p \pi r^3 \cot\alpha$ (Bishop-Moser and Kota, 2015).
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.actuation.fibre_path import FibrePath, fibre_path
from jaxrod.actuation.section_load import (
    SectionLoad,
    SectionStrains,
    Walls,
    section_bound,
    together,
    transport_bound,
    walls_of,
)
from jaxrod.effects.base import Reach, StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.time import Scheduled, Timed, as_timed
from jaxrod.geometry import vectors
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, check_kind


@pytree
class Chamber(SectionLoad):
    """Chambers of constant cross-section; see `chamber`.

    Example:
        >>> inflated = actuation.chamber(rod, pressure=2e4, area=1e-4)
        >>> longer = replace(state, positions=1.1 * state.positions)
        >>> round(float(inflated.energy(rod, longer)), 3)  # -pressure * new volume [J]
        -0.2
    """

    reach: ClassVar[Reach] = "second neighbours"
    path: FibrePath
    """Axes of the chambers."""
    area: Float[Array, "k"]
    """Cross-sectional area of each chamber [m^2]."""
    pressure: Scheduled
    """Pressure above that outside, one number or one per chamber `(k,)` [Pa]."""
    walls: Walls = ()
    """Walls at ends of the rod into which the chambers continue."""

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Minus pressure times the increase of volume over that at rest [J]."""
        length = vectors.safe_norm(self.path.segments(strains))
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        return -jnp.sum(self._push[:, None] * (length - rest))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness of axial forces, which turn with the chambers."""
        shape = (self.path.count, rod.n_elements + 1)
        push = jnp.broadcast_to(jnp.abs(self._push)[:, None], shape)
        return self.path.bound(rod, push, jnp.zeros_like(push), pulls=False)

    def resampled(self, rod: Rod, new_rod: Rod) -> Chamber:
        """The same chambers in `new_rod`, which has another number of elements."""
        return replace(self, path=self.path.resampled(rod, new_rod))

    @property
    def _push(self) -> Array:
        """Axial force of each chamber: pressure times area, positive if it pushes."""
        return self.pressure * self.area


@pytree
class WoundChamber(SectionLoad):
    """Chambers wound with fibres at an angle; see `wound_chamber`.

    Example:
        >>> wound = actuation.wound_chamber(rod, 1e5, radius=0.005, angle=0.4)
        >>> along = wound.loads(rod, motion).forces[0]
        >>> round(float(along[0]), 1), round(float(along[-1]), 1)  # it shortens the rod
        (80.0, -80.0)
    """

    reach: ClassVar[Reach] = "second neighbours"
    path: FibrePath
    """Axes of the chambers."""
    radius: Float[Array, "k"]
    """Radius of the cross-section of each chamber [m]."""
    angle: Float[Array, "k"]
    """Angle of the fibres to the axis of each chamber, right-handed if positive
    [rad]."""
    pressure: Scheduled
    """Pressure above that outside, one number or one per chamber `(k,)` [Pa]."""
    walls: Walls = ()
    """Walls at ends of the rod into which the chambers continue."""

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Minus pressure times the increase of volume over that at rest [J]."""
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        length = vectors.safe_norm(self.path.segments(strains))
        turns = jnp.tan(self.angle)[:, None] * rest / self.radius[:, None]
        fibre = rest / jnp.cos(self.angle)[:, None]
        inverse = self._turns_at_rest(rod)
        twist = strains.rotations[2][None, :] - inverse
        wound = jnp.pi * length * (fibre**2 - length**2) / (turns + twist) ** 2
        volume = wound - jnp.pi * (self.radius**2)[:, None] * rest
        return -jnp.sum(self._pressure[:, None] * volume)

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness of the axial force and the moment, near rest."""
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        cot = jnp.abs(1 / jnp.tan(self.angle))[:, None]
        r = self.radius[:, None]
        load = jnp.pi * jnp.abs(self._pressure)[:, None] * r**2
        push = jnp.broadcast_to(load * jnp.abs(1 - 2 * cot**2), rest.shape)
        # Second derivatives of the volume by length, by twist and mixed. The mixed one
        # is split between length and twist with the radius as lever.
        by_length = 6 * load * cot**2 / rest
        by_twist = 6 * load * r**2 * cot**2 / rest
        mixed = 2 * load * r * jnp.abs(cot * (1 - 3 * cot**2)) / rest
        turning = jnp.sum(by_twist + mixed * r, axis=0)
        moment = jnp.sum(2 * load * r * cot + 0 * rest, axis=0)
        return together(
            self.path.bound(rod, push, by_length + mixed / r, pulls=False),
            section_bound(rod, turning=turning),
            transport_bound(rod, moment=moment),
        )

    def resampled(self, rod: Rod, new_rod: Rod) -> WoundChamber:
        """The same chambers in `new_rod`, which has another number of elements."""
        return replace(self, path=self.path.resampled(rod, new_rod))

    def _turns_at_rest(self, rod: Rod) -> Array:
        """Twist of the joint at each node of the unstressed rod `(1, n + 1)` [rad]."""
        rest = rod.rest_curvatures[2] * rod.joint_lengths
        return vectors.pad(rest, 1, 1)[None, :]

    @property
    def _pressure(self) -> Array:
        """Pressure in each chamber above that outside `(k,)` [Pa]."""
        return jnp.broadcast_to(self.pressure, self.radius.shape)


def chamber(
    rod: Rod,
    pressure: Timed,
    area: Numbers,
    *,
    offsets: Numbers | None = None,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> Chamber:
    """Chambers under pressure with constant cross-section, all along a rod.

    Args:
        rod: The rod.
        pressure: Pressure above that outside, one number, one per chamber `(k,)`, or a
            schedule of either [Pa]; a negative one is suction.
        area: Cross-sectional area, above 0, one number or one per chamber `(k,)` [m^2].
        offsets: Offset of the axis along d1 and d2 `(2,)`; one per chamber `(k, 2)`; or
            also per node `(k, 2, n + 1)` [m]. On the centreline by default.
        into: The `clamp` of an end, or a tuple of two, into whose wall the chambers
            continue.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape.
        TypeError: If `rod` or `into` has the wrong type.

    Example:
        >>> offsets = [[0.01, 0.0], [-0.01, 0.0]]  # along d1
        >>> pair = actuation.chamber(rod, [2e4, 0.0], area=1e-4, offsets=offsets)
        >>> about_d2 = pair.loads(rod, motion).couples[1]
        >>> round(float(about_d2[0]), 3)  # pressure, area, offset [N m]
        0.02
    """
    check_kind("rod", rod, Rod)
    path = fibre_path(rod, offsets)
    shapes: list[tuple[int, ...]] = [(), (path.count,)]
    kind = rod.rest_lengths.dtype
    size = as_array("area", area, "m^2", shapes, positive=True, dtype=kind)
    return Chamber(
        path=path,
        area=jnp.broadcast_to(size, (path.count,)),
        pressure=as_timed("pressure", pressure, "Pa", *shapes),
        walls=walls_of(into),
    )


def wound_chamber(
    rod: Rod,
    pressure: Timed,
    radius: Numbers,
    angle: Numbers,
    *,
    offsets: Numbers | None = None,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> WoundChamber:
    """Chambers whose wall is wound with inextensible fibres.

    Above 54.7 degrees they lengthen a rod, below they shorten it. One family of fibres
    also twists it. For two families of opposite angles use two chambers with half the
    pressure each.

    Args:
        rod: The rod.
        pressure: Pressure above that outside, one number, one per chamber `(k,)`, or a
            schedule of either [Pa].
        radius: Radius of the cross-section, above 0, one number or one per chamber
            `(k,)` [m].
        angle: Angle of the fibres to the axis, right-handed if positive; its size is
            between 0 and a quarter turn; one number or one per chamber `(k,)` [rad].
        offsets: Offset of the axis along d1 and d2, as for `chamber` [m].
        into: The `clamp` of an end, or a tuple of two, into whose wall the chambers
            continue.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape.
        TypeError: If `rod` or `into` has the wrong type.

    Example:
        >>> steep = actuation.wound_chamber(rod, 1e5, radius=0.005, angle=1.2)
        >>> flat = actuation.wound_chamber(rod, 1e5, radius=0.005, angle=0.4)
        >>> bool(steep.loads(rod, motion).forces[0][-1] > 0)  # it lengthens the rod
        True
        >>> bool(flat.loads(rod, motion).forces[0][-1] > 0)
        False
    """
    check_kind("rod", rod, Rod)
    path = fibre_path(rod, offsets)
    shapes: list[tuple[int, ...]] = [(), (path.count,)]
    kind = rod.rest_lengths.dtype
    wide = as_array("radius", radius, "m", shapes, positive=True, dtype=kind)
    turn = as_array(
        "angle", angle, "rad", shapes, at_most=float(np.pi / 2 - 1e-3), dtype=kind
    )
    size = as_array(
        "size of angle", jnp.abs(turn), "rad", shapes, positive=True, dtype=kind
    )
    as_array("size of angle", size, "rad", shapes, at_most=float(np.pi / 2 - 1e-3))
    return WoundChamber(
        path=path,
        radius=jnp.broadcast_to(wide, (path.count,)),
        angle=jnp.broadcast_to(turn, (path.count,)),
        pressure=as_timed("pressure", pressure, "Pa", *shapes),
        walls=walls_of(into),
    )
