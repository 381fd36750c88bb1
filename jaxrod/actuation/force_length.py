r"""Force-length curves of muscles: fraction of the full force as a function of stretch.

A curve is the fraction $f(\lambda)$, about one at $\lambda = 1$, and its integral
$F(\lambda) = \int_1^\lambda f$, which is the stored energy of a fully active muscle of
unit force and length. Both are smooth enough for a step: $f$ has a continuous slope.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, Float

from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array


class ForceLength(ABC):
    """Base of force-length curves; a subclass is a pytree."""

    @abstractmethod
    def energy(self, stretch: Array) -> Array:
        """Integral of the force fraction from stretch 1 [1]."""

    @property
    @abstractmethod
    def largest(self) -> Array | float:
        """Bound on the force fraction [1]."""

    @property
    @abstractmethod
    def steepest(self) -> Array | float:
        """Bound on the slope of the force fraction [1]."""


@pytree
class ConstantForce(ForceLength):
    """The same force at any length."""

    def energy(self, stretch: Array) -> Array:
        """Stretch minus one [1]."""
        return stretch - 1

    @property
    def largest(self) -> float:
        """Largest force fraction, one [1]."""
        return 1.0

    @property
    def steepest(self) -> float:
        """Largest slope, zero [1]."""
        return 0.0


@pytree
class GaussianForce(ForceLength):
    r"""Gaussian force fraction, $f = \exp(-(\lambda - 1)^2/2w^2)$."""

    width: Float[Array, ""]
    """Width $w$ [1]."""

    def energy(self, stretch: Array) -> Array:
        """Integral of the Gaussian [1]."""
        scale = self.width * np.sqrt(np.pi / 2)
        return scale * erf((stretch - 1) / (np.sqrt(2) * self.width))

    @property
    def largest(self) -> float:
        """Largest force fraction, one at stretch 1 [1]."""
        return 1.0

    @property
    def steepest(self) -> Array:
        """Slope at one width from the maximum [1]."""
        return np.exp(-0.5) / self.width


_CUBIC = np.polynomial.Polynomial([-6.44, 18.01, -13.64, 3.06])
_RUN_OUT = 0.05


def _outlets() -> tuple[float, float]:
    """Ends of the cubic, from which parabolas continue to zero within the run-out."""
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

    It fits the muscles of an octopus (Chang et al., 2021). Its maximum is 0.99045. It
    ends near the stretches 0.577 and 1.596: there it continues to zero along a parabola
    0.05 wide, so that its slope is continuous.
    """

    _ends: ClassVar[tuple[float, float]] = _outlets()

    def energy(self, stretch: Array) -> Array:
        """Integral of the force fraction from a stretch of 1 [1].

        Over the cubic and the parabolas at its ends; constant beyond them.
        """
        first, last = self._ends
        whole = _CUBIC.integ(lbnd=1.0)
        inside = jnp.clip(stretch, first, last)
        total = _polynomial(whole.coef, inside)
        # The integral of a parabola from v at the cubic's end to zero is v w / 3.
        low = jnp.clip((stretch - first) / _RUN_OUT + 1, 0, 1)
        high = jnp.clip((last - stretch) / _RUN_OUT + 1, 0, 1)
        held = _RUN_OUT / 3 * _CUBIC(np.asarray(self._ends))
        return total - held[0] * (1 - low**3) + held[1] * (1 - high**3)

    @property
    def largest(self) -> float:
        """Largest force fraction, at stretch 0.99 [1]."""
        return 0.99045

    @property
    def steepest(self) -> float:
        """Slope at the shorter end of the cubic [1]."""
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
    """
    return GaussianForce(as_array("width", width, "", positive=True))


def cubic_force() -> CubicForce:
    """Force-length curve of the muscles of an octopus; see `CubicForce`."""
    return CubicForce()


def constant_force() -> ConstantForce:
    """Force-length curve with the same force at any length."""
    return ConstantForce()
