r"""Actuation: couples along a rod, shaped by a spline through a few control values.

The spline is the interpolating cubic with not-a-knot ends through the control values
at the control points and through zero at both ends of the rod. It overshoots between
control points: with six equidistant ones it reaches 1.67 times the largest value.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod import vectors
from jaxrod._pytree import pytree
from jaxrod._validation import Numbers, check_array
from jaxrod.effects import Effect
from jaxrod.interpolation import interpolated
from jaxrod.motion import Loads, Motion
from jaxrod.rod import Rod
from jaxrod.rotations import directors, to_world
from jaxrod.tangents import Matrix, skew


@pytree
class ElementCouples(Effect):
    """A given couple on every element, turning with it. The channel of control."""

    couples: Float[Array, "3 n"]
    """Material frame [N m]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """The couples as they are."""
        return Loads(couples=(self.couples[0], self.couples[1], self.couples[2]))

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix:
        """They turn with the elements."""
        couples = vectors.split(self.couples)
        return skew(to_world(directors(motion.orientation), couples))

    @property
    def twists(self) -> str:
        """All of it."""
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
class ControlSpline:
    """A cubic spline that is linear in its control values.

    Called with control values `(..., n_controls)` and positions `(m,)` [m] it gives
    the spline's values `(..., m)`, in the unit of the control values. Beyond the
    ends the outer cubics go on.
    """

    breaks: Float[Array, " pieces-1"]
    """Where one cubic ends and the next begins [m]."""
    origins: Float[Array, " pieces"]
    """Where each cubic's local coordinate is zero [m]."""
    coefficients: Float[Array, "pieces 4 n_controls"]
    """Coefficient of each power of the local coordinate, per unit of each control."""

    @property
    def n_controls(self) -> int:
        """Number of control values."""
        return self.coefficients.shape[-1]

    def __call__(
        self, controls: Float[Array, "*batch n_controls"], points: Float[Array, " m"]
    ) -> Float[Array, "*batch m"]:
        """Values of the spline at the given arc lengths [m]."""
        return _combined(self.basis(points), controls)

    def basis(self, points: Float[Array, " m"]) -> Float[Array, "m n_controls"]:
        """What each control value contributes at the given arc lengths [m]."""
        piece = jnp.sum(points[:, None] >= self.breaks[None, :], axis=1)
        local = points - self.origins[piece]
        powers = jnp.stack([jnp.ones_like(local), local, local**2, local**3])
        return jnp.sum(self.coefficients[piece] * powers.T[:, :, None], axis=1)

    def averaged(self, rod: Rod) -> ElementAverages:
        """The spline's averages over the elements of a rod, worked out once.

        What the elements as a whole get is then what the spline has, however few
        they are. Two points of Gauss' rule: exact for a cubic.
        """
        middles = rod.arc_length_midpoints
        offset = rod.rest_lengths / (2 * math.sqrt(3))
        return ElementAverages(
            0.5 * (self.basis(middles - offset) + self.basis(middles + offset))
        )


@pytree
class ElementAverages:
    """A control spline averaged over each element of a rod; linear in its controls."""

    basis: Float[Array, "n n_controls"]
    """Average over each element of what each control value contributes [1]."""

    @property
    def n_controls(self) -> int:
        """Number of control values."""
        return self.basis.shape[-1]

    def __call__(
        self, controls: Float[Array, "*batch n_controls"]
    ) -> Float[Array, "*batch n"]:
        """The averages for given control values, in their unit."""
        return _combined(self.basis, controls)


def _combined(
    basis: Float[Array, "m n_controls"], controls: Float[Array, "*batch n_controls"]
) -> Float[Array, "*batch m"]:
    basis = jnp.expand_dims(basis, tuple(range(controls.ndim - 1)))
    return jnp.sum(controls[..., None, :] * basis, axis=-1)


def control_spline(
    controls: int | Numbers, length: float = 1.0, dtype: Any = None
) -> ControlSpline:
    """The spline through control points along a rod, zero at both ends.

    Args:
        controls: Number of equidistant control points, at least 2; or their arc
            lengths [m], increasing, strictly inside the rod.
        length: The rod's rest length [m].
        dtype: Floating-point type; by default JAX's default.

    Raises:
        ValueError: If the control points do not fit.
    """
    end = float(check_array("length", length, [()], "m", positive=True))
    if isinstance(controls, int | np.integer):
        if controls < 2:
            raise ValueError(f"controls must be at least 2, got {controls}")
        inner = end * np.arange(1, controls + 1) / (controls + 1)
    else:
        inner = check_array("controls", controls, [np.shape(controls)], "m")
        if inner.ndim != 1 or inner.size < 2:
            raise ValueError(f"controls must be at least 2 positions, got {controls}")
        if np.any(np.diff(inner) <= 0) or inner[0] <= 0 or inner[-1] >= end:
            raise ValueError(
                f"controls must increase strictly inside 0 m to {end:g} m, "
                f"got {inner.tolist()}"
            )
    knots = np.concatenate([[0.0], inner, [end]])
    # Not-a-knot: no break at the knots next to the ends.
    breaks = knots[2:-2]
    origins = np.concatenate([[0.0], breaks])
    coefficients = _cardinal_coefficients(knots, breaks, origins, end)
    kind = jnp.result_type(float) if dtype is None else dtype
    return ControlSpline(
        breaks=jnp.asarray(breaks, kind),
        origins=jnp.asarray(origins, kind),
        coefficients=jnp.asarray(coefficients, kind),
    )


def _cardinal_coefficients(
    knots: np.ndarray, breaks: np.ndarray, origins: np.ndarray, length: float
) -> np.ndarray:
    """Piecewise coefficients of the splines that are one at a single control point.

    Unknowns: one cubic plus one truncated cube per break, as many as knots, so the
    interpolation conditions determine them. Worked in units of the length.
    """
    t, b, o = knots / length, breaks / length, origins / length
    cubes = np.maximum(t[:, None] - b[None, :], 0.0) ** 3
    system = np.concatenate([t[:, None] ** np.arange(4), cubes], axis=1)
    solution = np.linalg.solve(system, np.eye(len(t))[:, 1:-1])
    pieces = []
    for index, origin in enumerate(o):
        # Taylor coefficients of the active cubes and the first cubic at the origin.
        shift = np.array(
            [
                [1, origin, origin**2, origin**3],
                [0, 1, 2 * origin, 3 * origin**2],
                [0, 0, 1, 3 * origin],
                [0, 0, 0, 1],
            ]
        )
        local = shift @ solution[:4]
        for break_, cube in zip(b[:index], solution[4 : 4 + index], strict=True):
            d = origin - break_
            local = local + np.array([d**3, 3 * d**2, 3 * d, 1])[:, None] * cube
        pieces.append(local / length ** np.arange(4)[:, None])
    return np.stack(pieces)


def spline_couples(
    rod: Rod,
    spline: ControlSpline | ElementAverages,
    controls: Float[Array, "3 n_controls"],
    couple_density: ArrayLike,
) -> ElementCouples:
    """Couples distributed along the rod in proportion to a spline, per rest length.

    The resolution-independent form: the couple on an element is the integral of the
    density over it, so that refining the rod does not change the load.

    Args:
        rod: The rod.
        spline: From `control_spline`; or its averages over the elements of this rod,
            `spline.averaged(rod)`, where controls change often.
        controls: Control values [1] about d1, d2 (bending) and d3 (twist).
        couple_density: Couple per rest length for a control value of one [N m/m];
            one number, or one per direction `(3,)`.

    Returns:
        An effect to list in a scene.

    Raises:
        ValueError: If an argument is not finite or of the wrong shape.
    """
    check_array("controls", controls, [(3, spline.n_controls)], "")
    check_array("couple_density", couple_density, [(), (3,)], "N m/m")
    density = jnp.broadcast_to(jnp.asarray(couple_density, controls.dtype), (3,))
    averages = spline.averaged(rod) if isinstance(spline, ControlSpline) else spline
    values = averages(controls)
    return ElementCouples(density[:, None] * values * rod.rest_lengths[None, :])


def limit_rate(
    applied: Float[Array, "*shape"],
    commanded: Float[Array, "*shape"],
    largest_change: ArrayLike,
) -> Float[Array, "*shape"]:
    """Moves applied control values towards the commanded ones, but not faster.

    Args:
        applied: What the actuator does now.
        commanded: What it should do.
        largest_change: The most any value may change, in the unit of the values:
            the actuator's rate times the time since the last call.

    Returns:
        What the actuator does next.

    Raises:
        ValueError: If `largest_change` is negative.
    """
    allowed = [(), jnp.shape(applied)]
    check_array("largest_change", largest_change, allowed, "", non_negative=True)
    bound = jnp.asarray(largest_change, applied.dtype)
    return applied + jnp.clip(commanded - applied, -bound, bound)
