r"""Force-length curves of muscles: the share of the full force at a stretch.

A curve has the share $f(\lambda)$, at $\lambda = 1$ about one, and its integral
$F(\lambda) = \int_1^\lambda f$, which is the stored energy of a fully active muscle of
force and length one. Both are smooth enough for a step: $f$ has a continuous slope.
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
        """Integral of the share of force from the stretch 1 [1]."""

    @property
    @abstractmethod
    def largest(self) -> Array | float:
        """Bound on the share of force [1]."""

    @property
    @abstractmethod
    def steepest(self) -> Array | float:
        """Bound on its slope [1]."""


@pytree
class ConstantForce(ForceLength):
    """The same force at any length."""

    def energy(self, stretch: Array) -> Array:
        """The stretch from 1 [1]."""
        return stretch - 1

    @property
    def largest(self) -> float:
        """One [1]."""
        return 1.0

    @property
    def steepest(self) -> float:
        """None [1]."""
        return 0.0


@pytree
class GaussianForce(ForceLength):
    r"""$f = \exp(-(\lambda - 1)^2/2w^2)$."""

    width: Float[Array, ""]
    """$w$ [1]."""

    def energy(self, stretch: Array) -> Array:
        """Integral of the bell [1]."""
        scale = self.width * np.sqrt(np.pi / 2)
        return scale * erf((stretch - 1) / (np.sqrt(2) * self.width))

    @property
    def largest(self) -> float:
        """One, at the stretch 1 [1]."""
        return 1.0

    @property
    def steepest(self) -> Array:
        """The slope at one width from the top [1]."""
        return np.exp(-0.5) / self.width


_CUBIC = np.polynomial.Polynomial([-6.44, 18.01, -13.64, 3.06])
_RUN_OUT = 0.05


def _outlets() -> tuple[float, float]:
    """Where the cubic ends, so that a parabola goes on to zero in the run-out."""
    slope = _CUBIC.deriv()
    before = (2 * _CUBIC - _RUN_OUT * slope).roots()
    after = (2 * _CUBIC + _RUN_OUT * slope).roots()
    return (
        float(min(before.real, key=lambda x: abs(x - 0.60))),
        float(min(after.real, key=lambda x: abs(x - 1.57))),
    )


@pytree
class CubicForce(ForceLength):
    r"""$f = 3.06\lambda^3 - 13.64\lambda^2 + 18.01\lambda - 6.44$ where it is above 0.

    Of the muscles of an octopus (Chang et al., 2021). It has 0.99045 at most, and ends
    near the stretches 0.577 and 1.596: there it runs out to zero along a parabola 0.05
    wide, so that its slope is continuous.
    """

    _ends: ClassVar[tuple[float, float]] = _outlets()

    def energy(self, stretch: Array) -> Array:
        """Integral of the cubic and of the parabolas [1]."""
        first, last = self._ends
        whole = _CUBIC.integ(lbnd=1.0)
        inside = jnp.clip(stretch, first, last)
        total = _polynomial(whole.coef, inside)
        # A parabola from the value v at the end of the cubic to zero holds v w / 3.
        low = jnp.clip((stretch - first) / _RUN_OUT + 1, 0, 1)
        high = jnp.clip((last - stretch) / _RUN_OUT + 1, 0, 1)
        held = _RUN_OUT / 3 * _CUBIC(np.asarray(self._ends))
        return total - held[0] * (1 - low**3) + held[1] * (1 - high**3)

    @property
    def largest(self) -> float:
        """At the stretch 0.99 [1]."""
        return 0.99045

    @property
    def steepest(self) -> float:
        """At the shorter end of the cubic [1]."""
        return float(_CUBIC.deriv()(self._ends[0]))


def _polynomial(coefficients: np.ndarray, x: Array) -> Array:
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + float(coefficient)
    return total


def gaussian_force(width: Numbers = 0.25) -> GaussianForce:
    """A bell of the stretch about one.

    Args:
        width: Its standard deviation, above 0 [1].

    Raises:
        ValueError: If it is out of range.
    """
    return GaussianForce(as_array("width", width, "", positive=True))


def cubic_force() -> CubicForce:
    """The curve of the muscles of an octopus; see `CubicForce`."""
    return CubicForce()


def constant_force() -> ConstantForce:
    """The same force at any length."""
    return ConstantForce()
