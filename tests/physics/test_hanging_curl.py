"""A naturally curved rod hangs by its upper end: planar, then in space, then planar.

Romero et al. (2021) call it the bend-twist test, after Miller, Lazarus, Audoly and Reis
(2014). Lengths are in rod lengths L and weights qL^3/EI; Poisson's ratio is 0.5, so
GJ/EI = 2/3. The references are Kirchhoff's equations, solved by collocation.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp

import jaxrod

CURVATURE, TWIST = 7.0, 2 / 3
GRID = np.linspace(0.0, 1.0, 201)


def planar_hook(weight):
    """Angle to the vertical and curvature: theta'' = w (1 - s) sin(theta)."""
    s, y = GRID, np.array([CURVATURE * GRID, CURVATURE + 0 * GRID])
    for part in np.linspace(0.0, weight, 1 + round(weight / 4)):

        def slope(s, y, part=part):
            return np.array([y[1], part * (1 - s) * np.sin(y[0])])

        def ends(base, tip):
            return np.array([base[0], tip[1] - CURVATURE])

        found = solve_bvp(slope, ends, s, y, tol=1e-3)
        assert found.success
        y = found.sol(s)
    return y


def critical_weight(guess):
    """Weight at which the second variation out of the plane first vanishes, its mode.

    A section turns by alpha about its axis and by beta about the normal in the plane.
    With the twist a = alpha' - kappa beta, the bend b = beta' + kappa alpha and the
    moment M = kappa - kappa_0 the second variation is the integral of

    (2/3) a^2 + b^2 - M (alpha b - beta a)
        + w (1 - s) (alpha beta sin(theta) + beta^2 cos(theta)).
    """

    def slope(s, y, parameters):
        theta, kappa, alpha, beta, p, r = y
        pull, moment = parameters[0] * (1 - s), kappa - CURVATURE
        a = (p - 0.5 * moment * beta) / TWIST
        b = r + 0.5 * moment * alpha
        sine, cosine = pull * np.sin(theta), pull * np.cos(theta)
        return np.array(
            [
                kappa,
                sine,
                a + kappa * beta,
                b - kappa * alpha,
                kappa * b - 0.5 * moment * (b + kappa * alpha) + 0.5 * sine * beta,
                -TWIST * kappa * a
                + 0.5 * moment * (a - kappa * beta)
                + 0.5 * sine * alpha
                + cosine * beta,
            ]
        )

    def ends(base, tip, _):
        free = [tip[1] - CURVATURE, tip[4], tip[5], tip[3] - 1]
        return np.array([base[0], base[2], base[3], *free])

    start = np.concatenate([planar_hook(guess), [GRID, GRID, 0 * GRID, 0 * GRID]])
    found = solve_bvp(slope, ends, GRID, start, p=[guess], tol=1e-8, max_nodes=20000)
    assert found.success
    return found.p[0], found.sol(GRID)


def directors(q):
    """Rows d1, d2, d3 of the frame of a quaternion (w, x, y, z)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def times(a, b):
    """Product of quaternions."""
    first = a[0] * b[0] - np.sum(a[1:] * b[1:], axis=0)
    rest = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:], axis=0)
    return np.concatenate([[first], rest])


def tip_in_space(weights, mode):
    """Tip of the rod in space under the last of some weights, from the critical mode.

    q' = q u / 2, m' = -u x m - d3 x n, r' = d3, with the force n = -w (1 - s) z.
    """
    down = np.array([0.0, 1.0, 1.0, 0.0]) / np.sqrt(2)  # d1 = y, d2 = x, d3 = -z

    def strains(m):
        return np.array([m[0] - CURVATURE, m[1], m[2] / TWIST])

    theta, _, alpha, beta, _, _ = mode
    half, zero = 0.5 * theta, np.zeros_like(theta)
    plane = times(
        down[:, None] + 0 * GRID, np.array([np.cos(half), -np.sin(half), zero, zero])
    )
    q = times(plane, np.array([1 + zero, zero, 0.15 * beta, 0.15 * alpha]))
    q = q / np.linalg.norm(q, axis=0)
    turned = times(q * np.array([[1], [-1], [-1], [-1]]), np.gradient(q, GRID, axis=1))
    m = 2 * turned[1:] * np.array([[1], [1], [TWIST]])
    m[0] += CURVATURE
    axis = directors(q)[2]
    way = np.cumsum(0.5 * (axis[:, 1:] + axis[:, :-1]) * np.diff(GRID), axis=1)
    y = np.concatenate([q, m, np.zeros((3, 1)) + np.pad(way, ((0, 0), (1, 0)))])
    for weight in weights:

        def slope(s, y, weight=weight):
            q, m = y[:4], y[4:7]
            d, u = directors(q), strains(m)
            x, y, _ = -weight * (1 - s) * d[:, 2]
            force = np.array([-y, x, 0 * x])
            spin = np.concatenate([[0 * s], 0.5 * u])
            return np.concatenate(
                [times(q, spin), -np.cross(u, m, axis=0) - force, d[2]]
            )

        def ends(base, tip):
            return np.concatenate([base[:4] - down, tip[4:7], base[7:]])

        found = solve_bvp(slope, ends, GRID, y, tol=1e-7, max_nodes=20000)
        assert found.success
        y = found.sol(GRID)
    return y[7:, -1]


def hanging(n, weight, push=0.0):
    """Scene and rest shape of the rod; `push` is a force EI/L^2 on the tip along y."""
    s = np.linspace(0.0, 1.0, n + 1)
    arc = [1 - np.cos(CURVATURE * s), 0 * s, -np.sin(CURVATURE * s)]
    rod, state = jaxrod.rod_along(
        np.array(arc) / CURVATURE,
        radius=0.001,
        density=1000.0,
        youngs_modulus=1e7,
        normal=(0.0, 1.0, 0.0),
        dtype=jnp.float64,
    )
    bending = float(rod.bend_twist_stiffness[0, 0])
    mass = float(jnp.sum(rod.element_masses))
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity((0.0, 0.0, -weight * bending / mass)),
        jaxrod.end_load((0.0, push * bending, 0.0)),
    )
    return scene, state


def hook(n, weight):
    """The planar equilibrium: its weight grows from zero."""
    state = hanging(n, 0.0)[1]
    for part in np.linspace(0.0, weight, 2 + round(weight / 10))[1:]:
        found = jaxrod.equilibrium(hanging(n, part)[0], state)
        assert found.converged
        state = found.state
    assert np.max(np.abs(state.positions[1])) < 1e-9
    return found


def weight_of_change(n, guess):
    """Weight near a guess at which the hook gains or loses its stability."""
    low, high = 0.85 * guess, 1.15 * guess
    below = hook(n, low)
    state, stable = below.state, bool(below.stable)
    assert bool(hook(n, high).stable) != stable
    for _ in range(18):
        weight = 0.5 * (low + high)
        found = jaxrod.equilibrium(hanging(n, weight)[0], state)
        assert found.converged
        same = bool(found.stable) == stable
        low, high = (weight, high) if same else (low, weight)
    return low


@pytest.mark.slow
@pytest.mark.parametrize("guess", [14.5, 76.0])
def test_a_hook_leaves_its_plane_where_its_second_variation_vanishes(guess, record):
    exact, _ = critical_weight(guess)
    errors = [abs(weight_of_change(n, guess) / exact - 1) for n in (20, 40)]
    record(
        f"Hanging hook, curvature 7/L: weight qL^3/EI = {exact:.4g} at which its "
        "stability changes, n = 40",
        "second variation by collocation",
        errors[1],
        at_most=5e-3,
    )
    assert np.log2(errors[0] / errors[1]) > 1.8


@pytest.mark.slow
@pytest.mark.parametrize("weights", [(60.0,), (60.0, 45.0, 30.0), (60.0, 30.0, 18.0)])
def test_a_curl_in_space_hangs_as_kirchhoffs_equations_say(weights, record):
    _, mode = critical_weight(76.0)
    weight = weights[-1]
    exact, errors = tip_in_space(weights, mode), []
    for n in (25, 50):
        # A push to the side takes it out of its plane, and is then taken away.
        scene, state = hanging(n, weight, push=weight / 20)
        aside = jaxrod.equilibrium(scene, state)
        found = jaxrod.equilibrium(hanging(n, weight)[0], aside.state)
        assert found.converged and found.stable
        errors.append(float(jnp.linalg.norm(found.state.tip - exact)))
    record(
        f"Hanging curl, curvature 7/L, weight qL^3/EI = {weight:g}: its tip, n = 50 "
        "[lengths]",
        "Kirchhoff's equations by collocation",
        errors[1],
        at_most=2e-3,
    )
    assert np.log2(errors[0] / errors[1]) > 1.8
