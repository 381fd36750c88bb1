"""References of the three scenes: an elastica, a swinging mode, hanging cables.

Each takes stiffnesses of the rod, `numpy.inf` for one that does not yield. The tests
compare them with other closed forms, and with themselves on finer grids.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_bvp
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import eigh
from scipy.optimize import bisect


def tip_deflection(
    length: float,
    bending: float,
    force: float,
    stretching: float = np.inf,
    shearing: float = np.inf,
) -> float:
    r"""Deflection of a cantilever's tip under a force across it [m].

    The elastica, $EI\,\theta'' = -F x'$, with the slopes
    $x' = \cos\theta\,(1 + c F \sin\theta)$ and
    $y' = \sin\theta + F \sin^2\theta/EA + F \cos^2\theta/S$, where
    $c = 1/EA - 1/S$. It has a first integral, so that length and deflection are
    integrals over the angle up to that of the tip. The angle of the tip is the one at
    which the length is right, by bisection. Small forces give $F L^3/3EI + F L/S$.

    Args:
        length: Length L [m].
        bending: Stiffness EI [N m^2].
        force: Force F, which keeps its direction [N].
        stretching: Stiffness EA [N].
        shearing: Stiffness S of shear, corrected for the section [N].
    """
    knots, weights = np.polynomial.legendre.leggauss(80)
    slope = force * (1 / stretching - 1 / shearing)

    def integrals(tip: float) -> tuple[float, float]:
        """Length and deflection of a rod whose tip has turned so far [rad]."""
        # Angles are tip - u^2: what is infinite at the tip becomes smooth.
        u = np.sqrt(tip) * (knots + 1) / 2
        angle = tip - u**2
        sines = 2 * np.cos((tip + angle) / 2) * np.sin(u**2 / 2)
        rate = np.sqrt(
            2
            * force
            / bending
            * sines
            * (1 + slope * (np.sin(tip) + np.sin(angle)) / 2)
        )
        share = weights * np.sqrt(tip) / 2 * 2 * u / rate
        across = (
            np.sin(angle)
            + force * np.sin(angle) ** 2 / stretching
            + force * np.cos(angle) ** 2 / shearing
        )
        return float(np.sum(share)), float(np.sum(share * across))

    tip = bisect(lambda a: integrals(a)[0] - length, 1e-9, np.pi / 2 - 1e-9, xtol=1e-15)
    return integrals(tip)[1]


class Swing(NamedTuple):
    """The lowest mode of a cable that hangs from a pin."""

    frequency: float
    """Angular frequency [rad/s]."""
    shape: CubicHermiteSpline
    """Displacement over the distance from the pin at rest [m]; one at the tip."""


def swing(
    length: float,
    bending: float,
    weight: float,
    stretching: float,
    gravity: float,
    elements: int = 200,
) -> Swing:
    r"""The lowest small swing of a hanging cable, by cubic Hermite elements.

    $(EI u'')'' - \big(\frac{T}{1 + T/EA} u'\big)' = \frac{w}{g}\,\omega^2 u$, pinned
    at the top and free below, with the tension $T = w (L - s)$.

    Args:
        length: Length L at rest [m].
        bending: Stiffness EI [N m^2].
        weight: Weight w for each length at rest [N/m].
        stretching: Stiffness EA [N].
        gravity: Gravitational acceleration g [m/s^2].
        elements: Number of elements, equally long.
    """
    h = length / elements
    knots, weights = np.polynomial.legendre.leggauss(4)
    t, weights = (knots + 1) / 2, weights * h / 2
    value = np.stack(
        [
            1 - 3 * t**2 + 2 * t**3,
            h * (t - 2 * t**2 + t**3),
            3 * t**2 - 2 * t**3,
            h * (t**3 - t**2),
        ]
    )
    slope = np.stack(
        [
            (6 * t**2 - 6 * t) / h,
            1 - 4 * t + 3 * t**2,
            (6 * t - 6 * t**2) / h,
            3 * t**2 - 2 * t,
        ]
    )
    curvature = np.stack(
        [(12 * t - 6) / h**2, (6 * t - 4) / h, (6 - 12 * t) / h**2, (6 * t - 2) / h]
    )
    size = 2 * (elements + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for element in range(elements):
        tension = weight * (length - (element + t) * h)
        pull = tension / (1 + tension / stretching)
        own = slice(2 * element, 2 * element + 4)
        stiffness[own, own] += bending * (curvature * weights) @ curvature.T
        stiffness[own, own] += (slope * weights * pull) @ slope.T
        mass[own, own] += weight / gravity * (value * weights) @ value.T
    squares, modes = eigh(stiffness[1:, 1:], mass[1:, 1:], subset_by_index=(0, 0))
    mode = np.concatenate([[0.0], modes[:, 0]])
    mode /= mode[-2]
    places = np.linspace(0.0, length, elements + 1)
    shape = CubicHermiteSpline(places, mode[::2], mode[1::2])
    return Swing(float(np.sqrt(squares[0])), shape)


class Catenary(NamedTuple):
    """A cable without bending stiffness between two pins at one height."""

    length: float
    """Length at rest [m]."""
    weight: float
    """Weight for each length at rest [N/m]."""
    stretching: float
    """Stiffness EA [N]."""
    pull: float
    """Horizontal part of the tension [N]."""

    def places(self, s: np.ndarray) -> np.ndarray:
        r"""Positions `(k, 2)`, along and up, at distances s from the first pin [m].

        Distances are those of the cable at rest. With $V = w L/2$ and $v = w s - V$:
        $x = \frac{H s}{EA} + \frac{H}{w}\big(\sinh^{-1}\frac{v}{H} +
        \sinh^{-1}\frac{V}{H}\big)$ and
        $z = \frac{s}{EA}\big(\frac{w s}{2} - V\big) + \frac1w\big(\sqrt{H^2 + v^2} -
        \sqrt{H^2 + V^2}\big)$ (Irvine, Cable structures, 1981).
        """
        end = self.weight * self.length / 2
        lift = self.weight * s - end
        curve = np.arcsinh(lift / self.pull) + np.arcsinh(end / self.pull)
        x = self.pull * s / self.stretching + self.pull / self.weight * curve
        rise = (np.hypot(self.pull, lift) - np.hypot(self.pull, end)) / self.weight
        z = s / self.stretching * (self.weight * s / 2 - end) + rise
        return np.stack([x, z], axis=-1)


def catenary(span: float, length: float, weight: float, stretching: float) -> Catenary:
    """The elastic catenary; its pull by bisection.

    Args:
        span: Distance between the pins [m].
        length: Length at rest [m].
        weight: Weight for each length at rest [N/m].
        stretching: Stiffness EA [N].
    """

    def excess(pull: float) -> float:
        cable = Catenary(length, weight, stretching, pull)
        return float(cable.places(np.asarray(length))[0]) - span

    whole = weight * length
    pull = bisect(excess, 1e-4 * whole, 1e4 * whole, xtol=1e-15 * whole, rtol=1e-15)
    return Catenary(length, weight, stretching, float(pull))


def bent_cable(
    cable: Catenary, bending: float, shearing: float, s: np.ndarray
) -> np.ndarray:
    r"""Positions `(k, 2)` of a hanging cable that resists bending and shear [m].

    Equilibrium of a rod under its weight, by collocation on one half:
    $EI\,\theta'' = z' H - x' V$ with $V = w (s - L/2)$, the pull H to be found, and
    the slopes x', z' of a section turned by theta with the normal force
    $H\cos\theta + V\sin\theta$ and the shear force $V\cos\theta - H\sin\theta$.

    Args:
        cable: The same cable without either.
        bending: Stiffness EI [N m^2].
        shearing: Stiffness of shear, corrected for the section [N].
        s: Distances from the first pin at rest [m].
    """
    middle = cable.length / 2
    span = float(cable.places(np.asarray(cable.length))[0])

    def slopes(place: np.ndarray, state: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Derivatives of x, z, the angle and the moment."""
        _, _, angle, moment = state
        cosine, sine = np.cos(angle), np.sin(angle)
        lift = cable.weight * (place - middle)
        along = 1 + (pull[0] * cosine + lift * sine) / cable.stretching
        across = (lift * cosine - pull[0] * sine) / shearing
        x = along * cosine - across * sine
        z = along * sine + across * cosine
        return np.stack([x, z, moment / bending, z * pull[0] - x * lift])

    def ends(pin: np.ndarray, low: np.ndarray, _: np.ndarray) -> np.ndarray:
        """Zero where the pin holds and the middle is level."""
        return np.asarray([pin[0], pin[1], pin[3], low[2], low[0] - span / 2])

    places = np.linspace(0.0, middle, 400)
    guess = np.zeros((4, places.size))
    guess[:2] = cable.places(places).T
    guess[2] = np.arctan2(cable.weight * (places - middle), cable.pull)
    found = solve_bvp(
        slopes, ends, places, guess, p=[cable.pull], tol=1e-9, max_nodes=20000
    )
    if not found.success:
        raise RuntimeError(f"the hanging cable was not found: {found.message}")
    mirrored = s > middle
    x, z = found.sol(np.where(mirrored, cable.length - s, s))[:2]
    return np.stack([np.where(mirrored, span - x, x), z], axis=-1)
