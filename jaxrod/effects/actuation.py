r"""Couples along a rod in proportion to a spline through a few control values.

The spline is the interpolating cubic with not-a-knot ends. It passes through the
control values at the control points and through zero at both ends of the rod. It
overshoots between control points: with six equidistant ones it reaches 1.67 times the
largest value.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect
from jaxrod.effects.time import (
    Clock,
    Schedule,
    Timed,
    as_timed,
    at_clock,
    at_largest,
    depends_on_time,
    is_schedule,
)
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix, skew
from jaxrod.geometry.rotations import directors, to_world
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, interpolated
from jaxrod.structure import pytree
from jaxrod.validation import (
    Numbers,
    as_array,
    check_array,
    check_count,
    check_dtype,
    check_held,
    check_kind,
    is_traced,
    numeric,
)

MOST_CONTROLS = 1000
"""Largest number of control values. The linear system is dense, so a larger number must
be a mistake."""


@pytree
class ControlSpline:
    """A cubic spline that is linear in its control values.

    Called with control values `(..., n_controls)` and positions `(m,)` [m] it gives
    the spline's values `(..., m)`, in the unit of the control values. Beyond the
    ends of the rod the outer cubics are extrapolated.

    Example:
        >>> spline = actuation.control_spline(3, length=1.0)
        >>> values = spline(jnp.array([1.0, 0.0, 1.0]), jnp.array([0.0, 0.25, 0.5]))
        >>> [round(float(x), 3) for x in values]
        [0.0, 1.0, 0.0]
    """

    breaks: Float[Array, " pieces-1"]
    """Arc lengths where one cubic piece ends and the next begins [m]."""
    origins: Float[Array, " pieces"]
    """Arc length where the local coordinate of each cubic piece is zero [m]."""
    coefficients: Float[Array, "pieces 4 n_controls"]
    """Coefficients of the cubic in each piece, for powers 0 to 3 of the local
    coordinate, per unit of each control value."""
    length: Any = math.nan
    """The rod's rest length [m]; NaN if it is not known."""

    @property
    def n_controls(self) -> int:
        """Number of control values."""
        return self.coefficients.shape[-1]

    def __call__(
        self, controls: Float[Array, "*batch n_controls"], points: Float[Array, " m"]
    ) -> Float[Array, "*batch m"]:
        """Spline values at arc lengths `points` [m], for given control values."""
        return _combined(self.basis(points), controls)

    def basis(self, points: Float[Array, " m"]) -> Float[Array, "m n_controls"]:
        """Spline at each point for a unit value of one control, the others being zero.

        Entry `[i, j]` belongs to point i, at arc length `points[i]` [m], and to control
        j.
        """
        piece = jnp.sum(points[:, None] >= self.breaks[None, :], axis=1)
        local = points - self.origins[piece]
        powers = jnp.stack([jnp.ones_like(local), local, local**2, local**3])
        return jnp.sum(self.coefficients[piece] * powers.T[:, :, None], axis=1)

    def averaged(self, rod: Rod) -> ElementAverages:
        """Averages of the spline over the elements of a rod, computed once.

        Their sum, weighted by element lengths, is the integral of the spline, however
        few elements there are. They use the two-point Gauss rule, exact for a cubic.

        Raises:
            ValueError: The spline was made for a rod of another length.
        """
        self._check_length(rod)
        middles = rod.arc_length_midpoints
        offset = rod.rest_lengths / (2 * math.sqrt(3))
        return ElementAverages(
            0.5 * (self.basis(middles - offset) + self.basis(middles + offset))
        )

    def _check_length(self, rod: Rod) -> None:
        """Raises if the lengths of spline and rod are known and differ."""
        if is_traced(self.length, rod.rest_lengths):
            return
        length = float(np.sum(np.asarray(rod.rest_lengths, float)))
        # A comparison with an unknown length, NaN, is false.
        if abs(length - float(self.length)) > 1e-3 * length:
            raise ValueError(
                f"the rod is {length:g} m long, and the spline was made for "
                f"{float(self.length):g} m: give control_spline length={length:g}"
            )


@pytree
class ElementAverages:
    """A control spline averaged over each element of a rod; linear in its controls.

    Example:
        >>> spline = actuation.control_spline(3, length=1.0)
        >>> averages = spline.averaged(rod)
        >>> averages.basis.shape
        (10, 3)
        >>> averages(jnp.array([1.0, 2.0, 1.0])).shape
        (10,)
    """

    basis: Float[Array, "n n_controls"]
    """Average of the spline over element i for a unit value of control j alone, `[i,
    j]` [1]."""

    @property
    def n_controls(self) -> int:
        """Number of control values."""
        return self.basis.shape[-1]

    def averaged(self, rod: Rod) -> ElementAverages:
        """Returns this object, which is already averaged over the rod's elements.

        Raises:
            ValueError: The averages are for another number of elements.
        """
        if self.basis.shape[0] != rod.n_elements:
            raise ValueError(
                f"the averages are for a rod of {self.basis.shape[0]} elements, but "
                f"this one has {rod.n_elements}"
            )
        return self

    def __call__(
        self, controls: Float[Array, "*batch n_controls"]
    ) -> Float[Array, "*batch n"]:
        """Average of the spline over each element, for given control values."""
        return _combined(self.basis, controls)


def _combined(
    basis: Float[Array, "m n_controls"], controls: Float[Array, "*batch n_controls"]
) -> Float[Array, "*batch m"]:
    basis = jnp.expand_dims(basis, tuple(range(controls.ndim - 1)))
    return jnp.sum(controls[..., None, :] * basis, axis=-1)


def control_spline(
    controls: int | Numbers, length: Numbers = 1.0, dtype: Any = None
) -> ControlSpline:
    """Cubic spline along a rod through values at control points, zero at both ends.

    Args:
        controls: Number of equidistant control points, at least 2; or their arc
            lengths [m], increasing, strictly inside the rod.
        length: The rod's rest length [m].
        dtype: float32 or float64; by default JAX's default.

    Raises:
        ValueError: If the control points do not fit.

    Example:
        >>> spline = actuation.control_spline([0.25, 0.5, 0.75], length=1.0)
        >>> values = spline(jnp.array([1.0, 2.0, 1.0]), jnp.array([0.0, 0.5, 0.75]))
        >>> [round(float(x), 3) for x in values]
        [0.0, 2.0, 1.0]
    """
    kind = check_dtype(dtype)
    end = check_array("length", length, [()], "m", positive=True, dtype=kind)
    if not is_traced(end):
        with np.errstate(all="ignore"):
            check_held("cube of length", end**3, "m^3", kind, each=True)
    # In units of the length: equidistant points are then known even if it is traced.
    if isinstance(controls, int | np.integer):
        count = check_count("controls", controls, 2, MOST_CONTROLS)
        inner = np.arange(1, count + 1) / (count + 1)
    else:
        inner = _shares(controls, end, kind)
    xp = jnp if is_traced(inner) else np
    knots = xp.concatenate([np.zeros(1), inner, np.ones(1)])
    # Not-a-knot: no break at the knots next to the ends.
    breaks = knots[2:-2]
    origins = xp.concatenate([np.zeros(1), breaks])
    powers = end ** np.arange(4)
    with np.errstate(all="ignore"):
        coefficients = _cardinal_coefficients(knots) / powers[None, :, None]
    if not is_traced(coefficients):
        size = np.max(np.abs(coefficients))
        if not size < jnp.finfo(kind).max:
            raise ValueError(
                "controls must be further apart, and further from the ends, for a "
                f"spline in {kind}, got {controls}"
            )
    return ControlSpline(
        breaks=jnp.asarray(breaks * end, kind),
        origins=jnp.asarray(origins * end, kind),
        coefficients=jnp.asarray(coefficients, kind),
        length=jnp.asarray(end, kind),
    )


def _shares(controls: Numbers, end: Any, kind: Any) -> Any:
    """Validates control points; returns their arc lengths over the rod length [1].

    They must increase strictly between 0 and the length `end`, and fit into the dtype
    `kind`.
    """
    points = numeric("controls", controls, "m")
    if points.ndim != 1 or points.size < 2:
        raise ValueError(f"controls must be at least 2 positions, got {controls}")
    check_count("number of controls", points.size, 2, MOST_CONTROLS)
    check_array("controls", points, [points.shape], "m", dtype=kind)
    if not is_traced(points):
        inside = points[0] > 0 and (is_traced(end) or points[-1] < end)
        if not inside or np.any(np.diff(points) <= 0):
            last = "the length" if is_traced(end) else f"{end:g} m"
            raise ValueError(
                f"controls must increase strictly inside 0 m to {last}, "
                f"got {points.tolist()}"
            )
    return points / end


def _cardinal_coefficients(knots: Any) -> Any:
    """Coefficients of the basis splines, each of which is one at one control point.

    The unknowns are the second derivatives at the knots. The first derivative is
    continuous at the inner knots. The third derivative is continuous at the first and
    the last inner knot (not-a-knot), so the outer two intervals at either end share a
    cubic.

    Args:
        knots: Ends and control points, in units of the length `(controls + 2,)`.

    Returns:
        `(pieces, 4, controls)`, in units of the length; not finite where knots are too
        close together.
    """
    xp = jnp if is_traced(knots) else np
    count = len(knots)
    values = np.eye(count)[:, 1:-1]
    h = knots[1:] - knots[:-1]
    slopes = (values[1:] - values[:-1]) / h[:, None]
    inner = np.arange(1, count - 1)
    before, after = np.eye(count)[inner - 1], np.eye(count)[inner + 1]
    at, one, two = np.eye(count)[inner], h[:-1, None], h[1:, None]
    smooth = one * before + 2 * (one + two) * at + two * after
    # Third derivatives before and after a knot, both multiplied by both intervals.
    same = two * before - (one + two) * at + one * after
    system = xp.concatenate([same[:1], smooth, same[-1:]])
    bends = 6 * (slopes[1:] - slopes[:-1])
    zero = np.zeros((1, count - 2))
    try:
        second = xp.linalg.solve(system, xp.concatenate([zero, bends, zero]))
    except np.linalg.LinAlgError:
        second = np.full((count, count - 2), np.inf)
    start, end, width = second[:-1], second[1:], h[:, None]
    cubics = xp.stack(
        [
            values[:-1],
            slopes - width * (2 * start + end) / 6,
            start / 2,
            (end - start) / (6 * width),
        ],
        axis=1,
    )
    return xp.concatenate([cubics[:1], cubics[2:-1]])


@pytree
class ElementCouples(Effect):
    """Couples on all elements, constant in the material frame; see `spline_couples`.

    Example:
        >>> spline = actuation.control_spline(3)
        >>> twist = jnp.zeros((3, 3)).at[2].set(1.0)  # about d3
        >>> effect = actuation.spline_couples(rod, spline, twist, couple_density=0.1)
        >>> effect.couples.shape, float(abs(effect.couples[0]).max())
        ((3, 10), 0.0)
    """

    couples: Float[Array, "3 n"]
    """Couple on each element, material frame [N m]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """The given couples on the elements, without forces."""
        return Loads(couples=(self.couples[0], self.couples[1], self.couples[2]))

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix:
        """Negative derivative of couples with respect to rotations, world frame [N m].

        It is the matrix of the cross product with each couple, because the couple turns
        with its element.
        """
        couples = vectors.split(self.couples)
        return skew(to_world(directors(motion.orientation), couples))

    @property
    def twists(self) -> str:
        """Name of the couples, for the error message of methods that cannot twist."""
        return "couples in the material frame"

    def resampled(self, rod: Rod, new_rod: Rod) -> ElementCouples:
        """Couples of the same density per rest length, interpolated along the rod.

        Raises:
            ValueError: If they are a schedule that cannot be interpolated.
        """
        timed: Any = self.couples
        if is_schedule(timed):
            old, new = (one.arc_length_midpoints for one in (rod, new_rod))
            return ElementCouples(timed.resampled_along(old, new))
        density = interpolated(
            np.asarray(self.couples / rod.rest_lengths[None, :]),
            np.asarray(rod.arc_length_midpoints),
            np.asarray(new_rod.arc_length_midpoints),
        )
        lengths = new_rod.rest_lengths[None, :]
        return ElementCouples(jnp.asarray(density, lengths.dtype) * lengths)


@pytree
class SplineCouples(Schedule):
    """Schedule of couples from a spline with time-dependent controls or density."""

    averages: ElementAverages
    """Spline averaged over the elements, linear in its control values."""
    controls: Any
    """Control values about d1, d2, d3 `(3, n_controls)`, or a schedule of them [1]."""
    couple_density: Any
    """Couple per rest length for a control value of one [N m/m]: one number, or one
    each about d1, d2, d3, or a schedule of either."""
    lengths: Float[Array, " n"]
    """Rest lengths of the elements [m]."""

    def __call__(self, clock: Clock) -> Float[Array, "3 n"]:
        """Couples on the elements at the time of a clock, material frame [N m]."""
        controls, density = at_clock((self.controls, self.couple_density), clock)
        return _couples(self.averages, controls, density, self.lengths)

    @property
    def largest(self) -> Float[Array, "3 n"]:
        """Upper bound of the absolute couples at all times [N m].

        It is computed from absolute averages, largest control values and largest
        density.
        """
        averages, controls, density = jax.tree.map(
            jnp.abs, (self.averages, *at_largest((self.controls, self.couple_density)))
        )
        return _couples(averages, controls, density, self.lengths)


def _couples(
    averages: ElementAverages, controls: Array, density: Array, lengths: Array
) -> Float[Array, "3 n"]:
    """Couples, material frame: density times spline average times rest length [N m]."""
    per_length = jnp.broadcast_to(density, (3,))[:, None] * averages(controls)
    return per_length * lengths[None, :]


def spline_couples(
    rod: Rod,
    spline: ControlSpline | ElementAverages,
    controls: Timed,
    couple_density: Timed,
) -> ElementCouples:
    """Couples distributed along the rod in proportion to a spline, per rest length.

    The couple on an element is the integral over it of the spline times
    `couple_density`, so refining the rod does not change the load.

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

    Example:
        >>> spline = actuation.control_spline(3)
        >>> controls = jnp.zeros((3, 3)).at[0].set(1.0)  # about d1
        >>> bend = actuation.spline_couples(rod, spline, controls, couple_density=0.1)
        >>> bend.couples.shape, round(float(bend.couples[0].sum()), 3)  # sum [N m]
        ((3, 10), 0.083)
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

    Example:
        >>> applied = jnp.array([0.0, 0.0])
        >>> actuation.limit_rate(applied, [1.0, -0.25], largest_change=0.5).tolist()
        [0.5, -0.25]
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
