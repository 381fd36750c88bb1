r"""Muscles: fibres in a rod that contract, along themselves or transverse to the rod.

A fibre of full force $F_0 = \sigma_\max A_0$ and activation $a$ has around each node
the energy

$$E = a F_0 \Lambda_0\, F(\Lambda/\Lambda_0), \qquad
  E = 2 a F_0 \Lambda_0\, F\big((\Lambda/\Lambda_0)^{-1/2}\big) \text{ transverse,}$$

where $\Lambda$ is its length there (`FibrePath.segments`), $\Lambda_0$ its length at
rest, and $F$ the integral of its force-length curve. So it pulls with
$a F_0 f(\Lambda/\Lambda_0)$. Transverse muscles make the rod thinner in two directions,
hence longer.

With a largest speed of shortening $v$, in rest lengths per time, the force is
multiplied by a factor that depends on the speed of shortening (Hill, Proc. R. Soc. B
126 (1938) 136). With $u$ that speed over $v$, the factor is Hill's hyperbola for
shortening, and for lengthening a hyperbola that has the same slope at zero speed,

$$g(u) = \frac{1 - u}{1 + u/h} \ (0 < u < 1), \qquad
  g(u) = 1 + (b - 1)\,\frac{-u}{c - u} \ (u < 0), \quad c = (b - 1)\,\frac{h}{1 + h}.$$

It is zero beyond $u = 1$ and at most $b$ during lengthening. At zero speed it is one.

A force-length curve $f(\lambda)$ is the fraction of the full force at the stretch
$\lambda$, about one at $\lambda = 1$. Its integral $F(\lambda) = \int_1^\lambda f$ is
the stored energy of a fully active muscle of unit force and length. The slope of $f$ is
continuous.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, Float

from jaxrod.actuation.fibre_path import FibrePath, fibre_path
from jaxrod.actuation.section_load import (
    SectionLoad,
    SectionStrains,
    Walls,
    lengths_at_nodes,
    walls_of,
)
from jaxrod.effects.base import Reach, StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.time import Scheduled, Timed, as_timed, is_schedule
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import Quaternion, multiply_quaternions
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod, middle_places, resampled_along
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_kind


class ForceLength(ABC):
    """Base class of curves of force over stretch, as fractions of the full force."""

    @abstractmethod
    def energy(self, stretch: Array) -> Array:
        """Integral of the force fraction from stretch 1 to `stretch` [1]."""

    @property
    @abstractmethod
    def largest(self) -> Array | float:
        """Upper bound of the force fraction [1]."""

    @property
    @abstractmethod
    def steepest(self) -> Array | float:
        """Upper bound of the slope of the force fraction over stretch [1]."""


@pytree
class ConstantForce(ForceLength):
    """Force fraction of one at any stretch."""

    def energy(self, stretch: Array) -> Array:
        """Integral of the force fraction: stretch minus one [1]."""
        return stretch - 1

    @property
    def largest(self) -> float:
        """Largest force fraction, which is always 1 [1]."""
        return 1.0

    @property
    def steepest(self) -> float:
        """Largest slope of the force fraction, which is always 0 [1]."""
        return 0.0


@jax.custom_jvp
def _error_function(x: Array) -> Array:
    """Error function of real numbers.

    JAX computes the exponential in its derivative from the bits of numbers, which
    kernels cannot do.
    """
    return erf(x)


@_error_function.defjvp
def _error_function_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    (x,), (change,) = primals, tangents
    slope = 2 / math.sqrt(math.pi) * jnp.exp(-x * x)
    return _error_function(x), slope * change


@pytree
class GaussianForce(ForceLength):
    r"""Gaussian force fraction, $f = \exp(-(\lambda - 1)^2/2w^2)$."""

    width: Float[Array, ""]
    """Width $w$ [1]."""

    def energy(self, stretch: Array) -> Array:
        """Integral of the force fraction from stretch 1 to `stretch` [1]."""
        scale = math.sqrt(math.pi / 2) * self.width
        return scale * _error_function((stretch - 1) / (math.sqrt(2) * self.width))

    @property
    def largest(self) -> float:
        """Largest force fraction, one at stretch 1 [1]."""
        return 1.0

    @property
    def steepest(self) -> Array:
        """Largest slope $e^{-1/2}/w$, at one width from the maximum [1]."""
        return math.exp(-0.5) / self.width


_CUBIC = np.polynomial.Polynomial([-6.44, 18.01, -13.64, 3.06])
_RUN_OUT = 0.05


def _outlets() -> tuple[float, float]:
    """Smallest and largest stretch of the cubic; beyond, parabolas fall to zero."""
    slope = _CUBIC.deriv()
    before = (2 * _CUBIC - _RUN_OUT * slope).roots()
    after = (2 * _CUBIC + _RUN_OUT * slope).roots()
    return (
        float(min(before.real, key=lambda x: abs(x - 0.60))),
        float(min(after.real, key=lambda x: abs(x - 1.57))),
    )


@pytree
class CubicForce(ForceLength):
    r"""Cubic $f = 3.06\lambda^3 - 13.64\lambda^2 + 18.01\lambda - 6.44$ where positive.

    It fits the muscles of an octopus (Chang et al., 2021). Its maximum is 0.99045. At
    the stretches 0.577 and 1.596 the cubic ends. From there $f$ falls to zero along
    parabolas 0.05 wide, so that its slope is continuous.
    """

    _ends: ClassVar[tuple[float, float]] = _outlets()

    def energy(self, stretch: Array) -> Array:
        """Integral of the force fraction from stretch 1 to `stretch` [1].

        It is constant beyond the parabolas at both ends of the cubic.
        """
        first, last = self._ends
        whole = _CUBIC.integ(lbnd=1.0)
        inside = jnp.clip(stretch, first, last)
        total = _polynomial(whole.coef, inside)
        # The integral of a parabola from v at the cubic's end to zero is v w / 3.
        low = jnp.clip((stretch - first) / _RUN_OUT + 1, 0, 1)
        high = jnp.clip((last - stretch) / _RUN_OUT + 1, 0, 1)
        before, after = (_RUN_OUT / 3 * float(_CUBIC(end)) for end in self._ends)
        return total - before * (1 - low**3) + after * (1 - high**3)

    @property
    def largest(self) -> float:
        """Largest force fraction, at stretch 0.99 [1]."""
        return 0.99045

    @property
    def steepest(self) -> float:
        """Largest slope, where the cubic ends at short lengths [1]."""
        return float(_CUBIC.deriv()(self._ends[0]))


def _polynomial(coefficients: np.ndarray, x: Array) -> Array:
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + float(coefficient)
    return total


def gaussian_force(width: Numbers = 0.25) -> GaussianForce:
    """Force-length curve that is a Gaussian about stretch one.

    Args:
        width: Standard deviation, above 0 [1].

    Raises:
        ValueError: If it is out of range.

    Example:
        >>> curve = actuation.gaussian_force(width=0.2)
        >>> force = jax.grad(curve.energy)
        >>> round(float(force(1.0)), 3), round(float(force(1.2)), 3)  # 1 and exp(-1/2)
        (1.0, 0.607)
    """
    return GaussianForce(as_array("width", width, "", positive=True))


def cubic_force() -> CubicForce:
    """Force-length curve of the muscles of an octopus; see `CubicForce`.

    Example:
        >>> curve = actuation.cubic_force()
        >>> force = jax.grad(curve.energy)
        >>> [round(float(force(stretch)), 2) for stretch in (0.5, 1.0, 1.7)]
        [0.0, 0.99, 0.0]
    """
    return CubicForce()


def constant_force() -> ConstantForce:
    """Force-length curve with the same force at any length.

    Example:
        >>> curve = actuation.constant_force()
        >>> muscle = actuation.muscle(rod, 2.0, curve=curve)
        >>> float(curve.energy(jnp.float32(1.25)))  # stretch minus one
        0.25
    """
    return ConstantForce()


HYPERBOLA = 0.25
"""Constant `h` of Hill's hyperbola: the smaller, the stronger its curvature [1]."""
DRAWN_OUT = 1.5
"""Constant `b`: largest force of a lengthening muscle, relative to that at zero speed
[1]."""


@pytree
class Muscle(SectionLoad):
    """One or several muscle fibres; see `muscle`.

    Example:
        >>> muscle = actuation.muscle(rod, 2.0, activation=0.5)
        >>> along = muscle.loads(rod, motion).forces[0]
        >>> round(float(along[0]), 2), round(float(along[-1]), 2)  # the ends attract
        (0.99, -0.99)
    """

    reach: ClassVar[Reach] = "second neighbours"
    path: FibrePath
    """Offsets of the fibres from the centreline."""
    force: Float[Array, "k n"]
    """Full force of each fibre in each element, or in the whole rod (n = 1) [N]."""
    activation: Scheduled
    """Fraction of the full force [1]: one number, one per fibre `(k,)`, or `(k, n)`."""
    curve: ForceLength
    """Force-length curve: fraction of the full force as a function of stretch."""
    fastest: Float[Array, ""] | None = None
    """Largest speed of shortening, in rest lengths per time [1/s]. If `None`, the force
    does not depend on speed."""
    slowed: Float[Array, "k n+1"] | None = None
    """Factor by which the speed of shortening changes the force, at nodes [1]; one if
    `None`. `at_speed` sets it."""
    walls: Walls = ()
    """Walls at ends of the rod into which the fibres continue."""
    across: bool = static(default=False)
    """Whether the fibres contract transverse to the rod."""

    def at_speed(self, rod: Rod, motion: Motion) -> Muscle:
        """The muscle with `slowed` set for the present speed of shortening."""
        if self.fastest is None:
            return self
        share = force_at_speed(self._shortening(rod, motion) / self.fastest)
        return replace(self, slowed=share)

    def _shortening(self, rod: Rod, motion: Motion) -> Array:
        """Speed of shortening at nodes, in rest lengths per time `(k, n + 1)` [1/s]."""
        rest = vectors.safe_norm(self.path.rest_segments(rod))

        def stretch(position: Vec3, orientation: Quaternion) -> Array:
            there = replace(motion, position=position, orientation=orientation)
            strains, _ = self._strains(there)
            along = vectors.safe_norm(self.path.segments(strains)) / rest
            return along**-0.5 if self.across else along

        x, y, z = motion.angular_velocities(rod)
        turning = multiply_quaternions(
            (0 * x, 0.5 * x, 0.5 * y, 0.5 * z), motion.orientation
        )
        here = motion.position, motion.orientation
        return -jax.jvp(stretch, here, (motion.velocity, turning))[1]

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Energy of the fibres [J].

        It is the sum over fibres and nodes of F L `curve.energy(s)`, with the active
        force F at rest length, the rest length L and the stretch s of the fibre. For
        transverse muscles, in two directions at constant volume, it is twice that sum
        at `s^(-1/2)`, with the stretch s of the rod.
        """
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        stretch = vectors.safe_norm(self.path.segments(strains)) / rest
        pull = self._pull(rod)
        if self.across:
            return 2 * jnp.sum(pull * rest * self.curve.energy(stretch**-0.5))
        return jnp.sum(pull * rest * self.curve.energy(stretch))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness and drag of the fibres, near the unstressed shape."""
        largest, steepest = self.curve.largest, self.curve.steepest
        if self.across:
            steepest = 0.5 * steepest + 1.5 * largest
        pull = jnp.abs(self._pull(rod))
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        slope = steepest * pull / rest
        most = 1.0 if self.fastest is None else DRAWN_OUT
        bound = self.path.bound(
            rod, most * largest * pull, most * slope, pulls=not self.across
        )
        if self.fastest is None:
            return bound
        # The slope is largest at zero speed; transverse fibres have half the rod's
        # speed.
        steep = (1 + 1 / HYPERBOLA) * largest * pull / self.fastest
        steep = 0.5 * steep if self.across else steep
        drag = self.path.bound(rod, 0 * pull, steep / rest, pulls=not self.across)
        return replace(bound, node_drag=drag.nodes, element_drag=drag.elements)

    def resampled(self, rod: Rod, new_rod: Rod) -> Muscle:
        """The same muscles in `new_rod`, interpolated along the rod."""
        old, new = middle_places(rod), middle_places(new_rod)
        activation = self.activation
        if is_schedule(activation):
            if jnp.ndim(activation.largest) == 2:
                activation = activation.resampled_along(old, new)
        elif jnp.ndim(activation) == 2:
            activation = resampled_along(activation, old, new)
        return replace(
            self,
            path=self.path.resampled(rod, new_rod),
            force=resampled_along(self.force, old, new),
            activation=activation,
        )

    def _pull(self, rod: Rod) -> Array:
        """Force at rest length of each fibre around each node `(k, n + 1)` [N].

        It is the activation times the full force times the factor `slowed`.
        """
        active = self.activation
        if active.ndim < 2:
            active = active.reshape(-1, 1)
        shape = (self.path.count, rod.n_elements)
        pull = jnp.broadcast_to(active * self.force, shape) * rod.rest_lengths[None, :]
        x = jnp.pad(0.5 * pull, ((0, 0), (0, 1))) + jnp.pad(
            0.5 * pull, ((0, 0), (1, 0))
        )
        at_nodes = x / lengths_at_nodes(rod)[None, :]
        return at_nodes if self.slowed is None else self.slowed * at_nodes


def force_at_speed(speed: Array) -> Array:
    """Ratio of a muscle's force to that at zero speed, by Hill's hyperbola [1].

    Args:
        speed: Speed of shortening divided by the largest; negative for lengthening [1].
    """
    shorter = jnp.minimum(jnp.where(speed > 0, speed, 0), 1)
    longer = jnp.where(speed > 0, 0, -speed)
    slow = (DRAWN_OUT - 1) * HYPERBOLA / (1 + HYPERBOLA)
    drawn_out = 1 + (DRAWN_OUT - 1) * longer / (slow + longer)
    return jnp.where(speed > 0, (1 - shorter) / (1 + shorter / HYPERBOLA), drawn_out)


def muscle(
    rod: Rod,
    force: Numbers,
    activation: Timed = 1.0,
    *,
    offsets: Numbers | None = None,
    curve: ForceLength | None = None,
    across: bool = False,
    fastest: Numbers | None = None,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> Muscle:
    """Muscle fibres in a rod: longitudinal, helical or transverse.

    Args:
        rod: The rod.
        force: Full force, the stress of the muscle times its area at rest, at least 0:
            one number; one per fibre `(k,)`; or also per element `(k, n)` [N].
        activation: Fraction of the full force: one number; one per fibre `(k,)`; or
            also per element `(k, n)`; or a schedule of any of these [1].
        offsets: Offsets from the centreline along d1 and d2 `(2,)`; one per fibre
            `(k, 2)`; or also per node `(k, 2, n + 1)`, as from `helical_offsets` [m].
            On the centreline by default.
        curve: Force fraction as a function of stretch: `cubic_force()` by default, or
            `gaussian_force()`, `constant_force()`.
        across: Whether the fibres contract transverse to the rod, which makes it
            thinner and longer.
        fastest: Largest speed of shortening, in rest lengths per time [1/s]. Fibres
            pull less the faster they shorten, not at all at this speed, and up to 1.5
            times as much while they lengthen. By default the speed has no effect.
        into: The `clamp` of an end, or a tuple of two, into whose wall the fibres
            continue.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape.
        TypeError: If `rod`, `curve` or `into` has the wrong type.

    Example:
        >>> muscle = actuation.muscle(rod, 2.0, activation=0.5, offsets=(0.01, 0.0))
        >>> about_d2 = muscle.loads(rod, motion).couples[1]
        >>> round(float(about_d2[0]), 3)  # minus force times offset [N m]
        -0.01
    """
    check_kind("rod", rod, Rod)
    path = fibre_path(rod, offsets)
    curve = CubicForce() if curve is None else curve
    if not isinstance(curve, ForceLength):
        raise TypeError(
            "curve must be a force curve, such as jaxrod.actuation.cubic_force(), got "
            f"{type(curve).__name__}"
        )
    kind = rod.rest_lengths.dtype
    count = path.count
    shapes: list[tuple[int, ...]] = [(), (count,), (count, rod.n_elements)]
    full = as_array("force", force, "N", shapes, non_negative=True, dtype=kind)
    if full.ndim < 2:
        full = jnp.broadcast_to(full, (count,))[:, None]
    return Muscle(
        path=path,
        force=full,
        activation=as_timed("activation", activation, "", *shapes),
        curve=curve,
        fastest=(
            None
            if fastest is None
            else as_array("fastest", fastest, "1/s", positive=True, dtype=kind)
        ),
        walls=walls_of(into),
        across=bool(across),
    )
