"""Static shapes against beam theory, and how fast the error falls with n."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxrod
from physics.rods import BENDING, LENGTH, SHEARING, arm
from physics.small_motions import equilibrium, held_freedoms


def under_tip_load(rod, state, force, couple=(0.0, 0.0, 0.0)):
    """The static shape of a cantilever in a wall under a large end load."""
    wall = jaxrod.clamp(state)
    scene = lambda part: jaxrod.make_scene(
        rod, jaxrod.end_load(np.multiply(part, force), np.multiply(part, couple)), wall
    )
    return equilibrium(scene, state, held_freedoms(rod), steps=20)


@cache
def small_deflection_error(n, held_element=False):
    """Relative error of a cantilever's tip against Timoshenko's theory."""
    force = 1e-3
    exact = force * LENGTH**3 / (3 * BENDING) + force * LENGTH / SHEARING
    rod, state = arm(n)
    # With the element held the wall's couple on it does no harm.
    wall = jaxrod.clamp(state)
    scene = jaxrod.make_scene(rod, jaxrod.end_load((force, 0.0, 0.0)), wall)
    free = held_freedoms(rod, element=held_element)
    shape = equilibrium(lambda _: scene, state, free, steps=1)
    return float(shape.tip[0]) / exact - 1


def test_cantilever_tip_under_a_small_load(record):
    record(
        "Cantilever tip under a small load, n = 20",
        "FL^3/3EI + FL/(alpha_c GA)",
        abs(small_deflection_error(20)),
        at_most=2e-3,
    )


def test_pyelastica_s_clamp_is_too_stiff_by_three_half_over_n(record):
    record(
        "The same, end element held as in PyElastica (signed error)",
        "FL^3/3EI + FL/(alpha_c GA)",
        small_deflection_error(20, held_element=True),
        between=(-0.075, -0.071),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("clamp", "held_element", "order"),
    [("wall", False, 2.0), ("held element", True, 1.0)],
)
def test_order_of_convergence_in_the_number_of_elements(
    clamp, held_element, order, record
):
    errors = [abs(small_deflection_error(n, held_element)) for n in (10, 20, 40)]
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.ptp(slopes) < 0.1
    record(
        f"Order in n of the cantilever tip, {clamp} clamp",
        f"{order:g}",
        slopes[-1],
        between=(order - 0.1, order + 0.1),
    )


def elastica(load):
    """Tip of an inextensible cantilever under a dead load PL^2/EI, over its length.

    Solves theta'' = -load cos(theta), theta(0) = 0, theta'(1) = 0 by shooting.

    Returns:
        Deflection along the load and distance of the tip from the wall.
    """

    def shoot(curvature):
        def slope(_, y):
            theta, rate = y[:2]
            return rate, -load * np.cos(theta), np.sin(theta), np.cos(theta)

        tight = {"rtol": 1e-12, "atol": 1e-12}
        return solve_ivp(slope, (0, 1), (0.0, curvature, 0, 0), **tight).y[:, -1]

    curvature = brentq(lambda k: shoot(k)[1], 0.0, np.sqrt(2 * load), xtol=1e-13)
    return shoot(curvature)[2:]


def test_the_reference_elastica_is_the_tabulated_one():
    np.testing.assert_allclose(elastica(5.0), (0.713792, 1 - 0.387628), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "bar"),
    [
        pytest.param(10, 4e-3, marks=pytest.mark.slow),
        (20, 1e-3),
        pytest.param(40, 3e-4, marks=pytest.mark.slow),
    ],
)
def test_large_deflection_follows_the_elastica(n, bar, record):
    load = 5.0
    rod, state = arm(n, radius=0.005)
    force = load * float(rod.bend_twist_stiffness[0, 0])
    tip = under_tip_load(rod, state, (force, 0.0, 0.0)).tip
    error = np.hypot(tip[0] - elastica(load)[0], tip[2] - elastica(load)[1])
    record(
        f"Tip under PL^2/EI = 5, slender rod, n = {n} [lengths]",
        "elastica, by shooting",
        error,
        at_most=bar,
    )


@pytest.mark.slow
def test_an_end_moment_of_two_pi_ei_over_l_bends_a_rod_into_a_circle(record):
    n = 20
    rod, state = arm(n, radius=0.01)
    bending = float(rod.bend_twist_stiffness[0, 0])
    couple = (0.0, 2 * np.pi * bending, 0.0)
    shape = under_tip_load(rod, state, (0.0, 0.0, 0.0), couple)
    angles = jnp.unwrap(jnp.arctan2(shape.directors[2, 0], shape.directors[2, 2]))
    expected = 2 * np.pi * rod.arc_length_midpoints
    record(
        "Directions under an end moment 2 pi EI/L, n = 20 [rad]",
        "M s/EI at every element",
        float(jnp.max(jnp.abs(angles - expected))),
        at_most=1e-9,
    )
    record(
        "Gap of the circle that this moment bends the rod into [lengths]",
        "zero",
        float(jnp.linalg.norm(shape.tip)),
        at_most=1e-9,
    )


@pytest.mark.slow
def test_a_hanging_rod_stretches_under_its_own_weight(record):
    """Nodes hang exactly where theory says: half weights at the ends make it so."""
    n, gravity = 10, 9.80665
    rod, state = arm(n, direction=(0.0, 0.0, -1.0), youngs_modulus=1e6)
    scene = lambda part: jaxrod.make_scene(
        rod, jaxrod.clamp(state), jaxrod.gravity((0.0, 0.0, -gravity * part))
    )
    shape = equilibrium(scene, state, held_freedoms(rod), steps=1)
    s = np.linspace(0, 1, n + 1)
    sag = 1000 * gravity / 1e6 * (s - s**2 / 2)
    record(
        "Stretch of a hanging rod at its nodes [m]",
        "rho g (s L - s^2/2)/E",
        float(np.max(np.abs(-shape.positions[2] - s - sag))),
        at_most=1e-12,
    )
