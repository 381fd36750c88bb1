"""Errors of a run against the references, and the numbers that these are."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from benchmarks.mujoco_rods import references, scenes
from benchmarks.mujoco_rods.problem import Run

AT_REST = 1e-7
"""Speed below which a rod that should be at rest is [m/s]."""


class Deflections(NamedTuple):
    """Deflections of the cantilever's tip [m]."""

    linear: float
    """F L^3 / 3 EI."""
    elastica: float
    """The bending elastica's."""
    sheared: float
    """The same where the rod also shears and stretches."""


def deflections() -> Deflections:
    """The references of the cantilever."""
    rod, force = scenes.CANTILEVER, scenes.TIP_FORCE
    bending = (rod.length, rod.bending, force)
    return Deflections(
        force * rod.length**3 / (3 * rod.bending),
        references.tip_deflection(*bending),
        references.tip_deflection(*bending, rod.stretching, rod.shearing),
    )


def measure_deflection(run: Run) -> list[float]:
    """Relative errors against the elastica, and against the one that shears."""
    _check_rest(run)
    tip, exact = float(run.tips[-1, 2]), deflections()
    return [tip / exact.elastica - 1, tip / exact.sheared - 1]


@functools.cache
def swing(stretches: bool = True) -> references.Swing:
    """The reference of the swinging cable, or the one that does not stretch."""
    rod = scenes.SWINGING
    stretching = rod.stretching if stretches else np.inf
    return references.swing(
        rod.length, rod.bending, rod.weight, stretching, scenes.GRAVITY
    )


def period(run: Run) -> float:
    """The period of the sinusoid that is closest to the tip's way sideways [s].

    By least squares; its mean, amplitude and phase are found as well.
    """
    x = run.tips[:, 0]
    times = np.linspace(0.0, scenes.SWINGING.seconds, x.size)

    def apart(guess: np.ndarray) -> np.ndarray:
        mean, cosine, sine, frequency = guess
        turned = frequency * times
        return mean + cosine * np.cos(turned) + sine * np.sin(turned) - x

    start = [0.0, x[0], 0.0, swing().frequency]
    scale = [x[0], x[0], x[0], 1.0]
    found = least_squares(
        apart, start, x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    return float(2 * np.pi / found.x[3])


def measure_period(run: Run) -> list[float]:
    """Relative error of the period."""
    return [period(run) * swing().frequency / (2 * np.pi) - 1]


def catenary(stretches: bool = True) -> references.Catenary:
    """The reference of the hanging cable, or the one that does not stretch."""
    rod = scenes.HANGING
    stretching = rod.stretching if stretches else np.inf
    return references.catenary(scenes.SPAN, rod.length, rod.weight, stretching)


def measure_shape(run: Run) -> list[float]:
    """Errors of shape and sag, and of the shape where the reference is a rod.

    The first and the last are the largest distance of a node from its place over the
    length; the second is relative.
    """
    _check_rest(run)
    rod, cable = scenes.HANGING, catenary()
    nodes = run.nodes[:, [0, 2]]
    bent = references.bent_cable(cable, rod.bending, rod.shearing, rod.places)
    exact = cable.places(rod.places)
    sag = float(cable.places(np.asarray(rod.length / 2))[1])
    return [
        float(np.max(np.linalg.norm(nodes - exact, axis=1)) / rod.length),
        float(np.min(nodes[:, 1])) / sag - 1,
        float(np.max(np.linalg.norm(nodes - bent, axis=1)) / rod.length),
    ]


def _check_rest(run: Run) -> None:
    """Raises ValueError if a rod that should be at rest is not."""
    if not run.speed < AT_REST:
        raise ValueError(f"the rod still moves, by {run.speed:.2g} m/s")
