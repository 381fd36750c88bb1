r"""Travelling waves of moment along a rod, about an axis of the section or of space.

At the joint at arc length $s$ acts the moment

$$\tau = r(t)\,A(s) \sin 2\pi\left(\frac tT - \frac s\lambda + \varphi\right),$$

with the period $T$, the wavelength $\lambda$ and the phase $\varphi$, with a plus sign
on the element after the joint and a minus sign on the element before it. The wave bends
an unloaded rod of bending stiffness $B$ by the curvature $\tau/B$. $r$ rises from 0 to
1 while the wave is ramped up.

The amplitude $A(s)$ may be a clamped uniform cubic B-spline. With $K$ coefficients it
has $K - 3$ equal pieces. The first and the last coefficient are the values at the ends.
The curve passes near the others, not through them, and never exceeds the largest of
them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.actuation.section_load import (
    SectionLoad,
    SectionStrains,
    SectionStress,
    Walls,
    transport_bound,
    walls_of,
)
from jaxrod.effects.base import Effect, Reach, StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.ends import End, check_end
from jaxrod.effects.time import Clock, Schedule, Scheduled, is_schedule
from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import module_for, unit_vector
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, node_places, resampled_along
from jaxrod.structure import pytree
from jaxrod.validation import (
    Numbers,
    as_array,
    check_array,
    check_kind,
    is_traced,
    numeric,
)

DEGREE = 3


def b_spline_basis(count: int, places: Any) -> Array | np.ndarray:
    """Basis functions of a clamped uniform cubic B-spline at positions along a rod.

    Args:
        count: Number of coefficients, at least 4.
        places: Positions from 0 to 1 `(m,)`; slightly outside, the end pieces continue.

    Returns:
        The basis `(m, count)`, a NumPy array unless positions are traced.
    """
    xp = module_for(places)
    inner = np.linspace(0.0, 1.0, count - DEGREE + 1)
    knots = np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])
    pieces = count - DEGREE
    piece = xp.clip(xp.floor(places * pieces).astype(int), 0, pieces - 1) + DEGREE
    # Cox-de Boor recursion.
    columns = [1.0 * (piece == k) for k in range(len(knots) - 1)]
    for degree in range(1, DEGREE + 1):
        rising = [
            _share(places - knots[k], knots[k + degree] - knots[k])
            for k in range(len(columns))
        ]
        columns = [
            rising[k] * columns[k] + (1 - rising[k + 1]) * columns[k + 1]
            for k in range(len(columns) - 1)
        ]
    return xp.stack(columns[:count], axis=-1)


def _share(part: Any, whole: float) -> Any:
    """Fraction `part / whole`; zero if `whole` is zero."""
    return part / whole if whole > 0 else 0 * part


FEWEST_COEFFICIENTS = 4


@pytree
class Wave(Schedule):
    """Schedule of a sine in time whose amplitude and phase vary from node to node."""

    amplitudes: Float[Array, " n+1"]
    """Amplitude of the moment at each node [N m]."""
    phases: Float[Array, " n+1"]
    """Phase at each node at time zero, in periods [1]."""
    period: Float[Array, ""]
    """Period [s]."""
    ramp_up: Float[Array, ""] | None = None
    """Time in which the wave rises to its full size [s]. If `None`, it has its full
    size from the start."""

    def __call__(self, clock: Clock) -> Array:
        """Moments at the nodes at the time of a clock [N m].

        They are as exact after a million periods as in the first.
        """
        now, there = (
            2 * jnp.pi * turns for turns in (clock.phase(self.period), self.phases)
        )
        # The sine of a sum: what varies along the rod does not change with time.
        wave = jnp.sin(now) * jnp.cos(there) + jnp.cos(now) * jnp.sin(there)
        values = self.amplitudes * wave
        if self.ramp_up is None:
            return values
        return jnp.clip(clock.time / self.ramp_up, 0, 1) * values

    @property
    def largest(self) -> Array:
        """Bound of the moments: absolute amplitudes [N m]."""
        return jnp.abs(self.amplitudes)

    def resampled_along(self, old: Any, new: Any) -> Wave:
        """The wave interpolated from arc lengths `old` to arc lengths `new` [m]."""
        return replace(
            self,
            amplitudes=resampled_along(self.amplitudes, old, new),
            phases=resampled_along(self.phases, old, new),
        )


@pytree
class TravellingWave(SectionLoad):
    r"""Wave of joint moments about an axis of the section; see `travelling_wave`.

    At a fixed time its energy is $-\sum_k \tau_k\, a\cdot\phi_k$, with the moments
    $\tau_k$, the axis $a$ and the joint rotations $\phi_k$.

    Example:
        >>> wave = actuation.travelling_wave(rod, 0.25, period=2.0, wavelength=1.0)
        >>> now = jaxrod.make_scene(rod, wave).at(0.5).effects[0]  # a quarter period
        >>> now.moments[::5].tolist()  # at the base, the middle and the tip
        [0.25, -0.25, 0.25]
    """

    moments: Scheduled
    """Moment at the joint of each node `(n + 1,)`, or a schedule of it [N m]."""
    axis: Float[Array, "3"]
    """Unit vector along the axis, material frame."""
    walls: Walls = ()
    """Walls at ends of the rod into which the wave continues."""

    reach: ClassVar[Reach] = "neighbours"

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Energy: minus the sum of moments times joint angles about the axis [J]."""
        angle = vectors.dot(vectors.split(self.axis), strains.rotations)
        return -jnp.sum(self.moments * angle)

    def stress(self, rod: Rod, strains: SectionStrains) -> SectionStress:
        """Stress of the wave: joint moments about its axis, with opposite sign."""
        a, b, c = vectors.split(self.axis)
        size = -self.moments
        return SectionStress(moment=(size * a, size * b, size * c))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness that moments add because they turn with elements."""
        return transport_bound(rod, moment=self.moments)

    def resampled(self, rod: Rod, new_rod: Rod) -> TravellingWave:
        """The same wave at the nodes of `new_rod`."""
        return replace(self, moments=_resampled(self.moments, rod, new_rod))


@pytree
class WorldWave(Effect):
    """Wave of joint moments about an axis in space; see `muscle_torques`.

    It has no energy. The couples on the two elements of a joint are opposite.

    Example:
        >>> wave = actuation.muscle_torques(
        ...     rod, 0.25, period=2.0, wave_number=2 * jnp.pi, direction=(0.0, 0.0, 1.0)
        ... )
        >>> now = jaxrod.make_scene(rod, wave).at(0.5).effects[0]
        >>> couples = now.loads(rod, motion).couples
        >>> [round(abs(float(part.sum())), 3) for part in couples]  # they cancel
        [0.0, 0.0, 0.0]
    """

    moments: Scheduled
    """Moment at the joint of each node `(n + 1,)`, or a schedule of it [N m]."""
    direction: Float[Array, "3"]
    """Direction of the axis, world frame; its length multiplies the moments."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Couples on the elements.

        The moment of a joint acts on the element after it, and its opposite on the
        element before it.
        """
        inner = self.moments[1:-1]
        net = vectors.pad(inner, 1, 0) - vectors.pad(inner, 0, 1)
        a, b, c = vectors.split(self.direction)
        frame = directors(motion.orientation)
        return Loads(couples=to_material(frame, (net * a, net * b, net * c)))

    def turning_tangent(self, rod: Rod, motion: Motion) -> None:
        """Always `None`: world-frame couples do not change when elements rotate."""

    def resampled(self, rod: Rod, new_rod: Rod) -> WorldWave:
        """The same wave at the nodes of `new_rod`."""
        return replace(self, moments=_resampled(self.moments, rod, new_rod))


def _resampled(moments: Any, rod: Rod, new_rod: Rod) -> Any:
    old, new = node_places(rod), node_places(new_rod)
    if is_schedule(moments):
        return moments.resampled_along(old, new)
    return resampled_along(moments, old, new)


def travelling_wave(
    rod: Rod,
    amplitude: Numbers,
    *,
    period: Numbers,
    wavelength: Numbers,
    axis: Numbers = (1.0, 0.0, 0.0),
    phase: Numbers = 0.0,
    ramp_up: Numbers | None = None,
    head: End = "base",
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> TravellingWave:
    """A wave of bending or twist that runs along a rod and turns with its sections.

    The moment about the axis is `amplitude(s) sin 2 pi (t / period - s / wavelength +
    phase)`, with the arc length `s` from the head. Two waves about d1 and d2 lift a
    body as it swings.

    Args:
        rod: The rod.
        amplitude: One number [N m]; or the coefficients of a cubic B-spline along the
            rod, from the head, at least 4: the first and the last are the values at
            the ends, which free ends do not use.
        period: Period, above 0 [s].
        wavelength: Length of a wave, above 0 [m].
        axis: Axis in the material frame, of any length `(3,)`: d1 and d2 bend, d3
            twists.
        phase: Phase at time zero at the head, in periods: 0.25 makes it a cosine.
        ramp_up: Time in which the wave rises from zero, above 0 [s]; by default it has
            its full size from the start.
        head: The end at which waves begin, "base" or "tip".
        into: The `clamp` of an end, or a tuple of two, into whose wall the wave
            continues.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape.
        TypeError: If `rod` or `into` has the wrong type.

    Example:
        >>> swim = actuation.travelling_wave(rod, 0.1, period=2.0, wavelength=1.0)
        >>> eel = jaxrod.make_scene(rod, swim, fluids.stokes_drag(0.1, 0.2))
        >>> eel.depends_on_time, eel.at(0.5).effects[0].moments.shape
        (True, (11,))
    """
    check_kind("rod", rod, Rod)
    kind = rod.rest_lengths.dtype
    places = node_places(rod)
    from_head = places if check_end(head) == "base" else places[-1] - places
    length = as_array("wavelength", wavelength, "m", positive=True, dtype=kind)
    start = as_array("phase", phase, "", dtype=kind)
    wave = Wave(
        amplitudes=_amplitudes(amplitude, from_head / places[-1], kind),
        phases=start - jnp.asarray(from_head, kind) / length,
        period=as_array("period", period, "s", positive=True, dtype=kind),
        ramp_up=_ramp_up("ramp_up", ramp_up, kind),
    )
    direction = jnp.asarray(unit_vector("axis", axis), kind)
    return TravellingWave(wave, direction, walls_of(into))


def muscle_torques(
    rod: Rod,
    amplitude: Numbers,
    *,
    period: Numbers,
    wave_number: Numbers,
    direction: Numbers,
    phase_shift: Numbers = 0.0,
    ramp_up_time: Numbers | None = None,
) -> WorldWave:
    """PyElastica's `MuscleTorques`: a wave about a direction of space, from the tip.

    The moment at the joint with `j` elements after it is `amplitude(s) sin(2 pi t /
    period - wave_number s + phase_shift)`, where `s` is the length of the first `j`
    elements, divided by the length of the rod. With elements of equal length it is the
    distance from the tip, divided by the length of the rod. It is for comparisons with
    PyElastica; `travelling_wave` turns with the sections.

    Args:
        rod: The rod.
        amplitude: One number [N m]; or the coefficients of a cubic B-spline, at
            least 4, starting at the tip (PyElastica's `b_coeff`).
        period: Period, above 0 [s].
        wave_number: Phase over the whole rod, `2 pi` for one wave [rad].
        direction: Direction in the world frame `(3,)`; its length is a factor, as in
            PyElastica.
        phase_shift: Phase at time zero at the tip [rad].
        ramp_up_time: Time in which the wave rises from zero, above 0 [s]; by default it
            has its full size from the start.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape.
        TypeError: If `rod` is not a `Rod`.

    Example:
        >>> wave = actuation.muscle_torques(
        ...     rod, 0.25, period=2.0, wave_number=2 * jnp.pi, direction=(0.0, 0.0, 1.0)
        ... )
        >>> now = jaxrod.make_scene(rod, wave).at(0.5).effects[0]
        >>> now.moments[::5].tolist()
        [0.25, -0.25, 0.25]
    """
    check_kind("rod", rod, Rod)
    kind = rod.rest_lengths.dtype
    places = node_places(rod)
    shares = (places / places[-1])[::-1]
    number = as_array("wave_number", wave_number, "rad", dtype=kind)
    shift = as_array("phase_shift", phase_shift, "rad", dtype=kind)
    wave = Wave(
        amplitudes=_amplitudes(amplitude, shares, kind),
        phases=(shift - number * jnp.asarray(shares, kind)) / (2 * jnp.pi),
        period=as_array("period", period, "s", positive=True, dtype=kind),
        ramp_up=_ramp_up("ramp_up_time", ramp_up_time, kind),
    )
    return WorldWave(wave, as_array("direction", direction, "", [(3,)], dtype=kind))


def _amplitudes(amplitude: Numbers, shares: Any, kind: Any) -> Array:
    """Amplitude [N m] at fractions `shares` of a rod's length, in the dtype `kind`.

    It is one number for all, or a cubic B-spline with the given coefficients.
    """
    given = numeric("amplitude", amplitude, "N m")
    given = check_array("amplitude", given, [given.shape], "N m", dtype=kind)
    if given.ndim == 0:
        return jnp.full(shares.shape, given, kind)
    if given.ndim != 1 or given.size < FEWEST_COEFFICIENTS:
        raise ValueError(
            f"amplitude must be one number, or {FEWEST_COEFFICIENTS} or more "
            f"coefficients in N m, got shape {given.shape}"
        )
    basis = b_spline_basis(given.size, shares)
    xp = jnp if is_traced((given, basis)) else np
    return jnp.asarray(xp.sum(basis * given[None, :], axis=1), kind)


def _ramp_up(name: str, ramp_up: Numbers | None, kind: Any) -> Array | None:
    if ramp_up is None:
        return None
    return as_array(name, ramp_up, "s", positive=True, dtype=kind)
