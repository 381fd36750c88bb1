"""Small vibrations of the discrete rod have the frequencies derived by hand."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxrod
from physics.rods import DENSITY, RADIUS, SHEAR, YOUNG, arm
from physics.small_motions import frequencies, held_freedoms

N = 20
SPACING = 1 / N
AXIAL_SPEED = np.sqrt(YOUNG / DENSITY)
TWIST_SPEED = np.sqrt(SHEAR / DENSITY)
SHEAR_SPEED = np.sqrt(27 / 28 * SHEAR / DENSITY)


def freedoms(*kept):
    """A mask of the freedoms kept: "x", "y", "z" of nodes or "rx", "ry", "rz"."""
    nodes, elements = np.zeros((3, N + 1), bool), np.zeros((3, N), bool)
    for name in kept:
        (elements if name[0] == "r" else nodes)["xyz".index(name[-1])] = True
    return nodes, elements


def mask(nodes, elements):
    return np.concatenate([nodes.ravel(), elements.ravel()])


def worst(measured, expected):
    return np.max(np.abs(measured / np.sort(expected) - 1))


def clamped_free(speed):
    k = np.arange(1, N + 1)
    return 2 * speed / SPACING * np.sin((2 * k - 1) * np.pi / (4 * N))


@pytest.mark.slow
def test_axial_vibrations(record):
    rod, state = arm(N)
    nodes, elements = freedoms("z")
    nodes[:, 0] = False
    measured = frequencies(jaxrod.make_scene(rod), state, mask(nodes, elements))
    record(
        "Axial frequencies, one end held, n = 20, all modes",
        "(2c/l) sin((2k-1) pi/4n)",
        worst(measured, clamped_free(AXIAL_SPEED)),
        at_most=1e-10,
    )


@pytest.mark.slow
def test_torsional_vibrations(record):
    rod, state = arm(N)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    measured = frequencies(scene, state, mask(*freedoms("rz")))
    record(
        "Torsional frequencies, wall clamp, n = 20, all modes",
        "(2c_t/l) sin((2k-1) pi/4n)",
        worst(measured, clamped_free(TWIST_SPEED)),
        at_most=1e-10,
    )


@pytest.mark.parametrize(("bend", "about"), [("x", "ry"), ("y", "rx")])
def test_bending_and_shear_vibrations(bend, about, record):
    """Pinned ends: Timoshenko's dispersion with k replaced by (2/l) sin(k l/2)."""
    rod, state = arm(N)
    nodes, elements = freedoms(bend, about)
    nodes[:, [0, -1]] = False
    measured = frequencies(jaxrod.make_scene(rod), state, mask(nodes, elements))
    s = 2 / SPACING * np.sin(np.arange(N) * np.pi / (2 * N))
    rocking = 4 * SHEAR_SPEED**2 / RADIUS**2
    total = (SHEAR_SPEED**2 + AXIAL_SPEED**2) * s**2 + rocking
    product = SHEAR_SPEED**2 * AXIAL_SPEED**2 * s**4
    upper = (total + np.sqrt(total**2 - 4 * product)) / 2
    # No bending with k = 0: only the rocking of all elements against the axis.
    expected = np.sqrt(np.concatenate([upper, (product / upper)[1:]]))
    record(
        f"Bending and shear frequencies along {bend}, pinned, n = 20, all modes",
        "discrete Timoshenko dispersion",
        worst(measured, expected),
        at_most=1e-10,
    )


@pytest.mark.slow
def test_the_arm_s_first_frequency(record):
    """At n = 20 within 0.3 % of the continuous clamped beam's."""
    rod, state = arm(N)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    measured = frequencies(scene, state, held_freedoms(rod)) / (2 * np.pi)
    record(
        "First bending frequency of the clamped arm, n = 20",
        "1.391 Hz (Timoshenko)",
        abs(measured[0] / timoshenko_frequency() - 1),
        at_most=3e-3,
    )


def timoshenko_frequency():
    """The lowest frequency of the continuous clamped Timoshenko beam [Hz]."""
    area = np.pi * RADIUS**2
    second = area**2 / (4 * np.pi)
    shear, bend = 27 / 28 * SHEAR * area, YOUNG * second

    def end_loads(omega):
        """Moment and shear force at the free end for each unknown at the wall."""

        def slope(_, y):
            w, phi, moment, force = y
            return (
                force / shear + phi,
                moment / bend,
                -force - DENSITY * second * omega**2 * phi,
                -DENSITY * area * omega**2 * w,
            )

        starts = ((0, 0, 1.0, 0), (0, 0, 0, 1.0))
        tight = {"rtol": 1e-11, "atol": 1e-13}
        return [solve_ivp(slope, (0, 1), y, **tight).y[2:, -1] for y in starts]

    determinant = lambda omega: np.linalg.det(end_loads(omega))
    return brentq(determinant, 2 * np.pi, 4 * np.pi, xtol=1e-10) / (2 * np.pi)
