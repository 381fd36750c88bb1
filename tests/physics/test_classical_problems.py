"""Classical problems of slender rods: each a number that has been known for long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

import jaxrod
from jaxrod.rods.motion import motion_of
from jaxrod.statics.block_matrices import as_dense
from jaxrod.statics.equilibrium import _at_rest, _RodAtRest
from physics.rods import LENGTH, arm

SLENDER = 0.001  # Radius of a rod of 1 m [m]; shear and stretch change a millionth.


def bending(rod):
    return float(rod.bend_twist_stiffness[0, 0])


def largest_stable(is_stable, guess):
    """The load up to which something is stable, by bisection, around a guess."""
    assert is_stable(0.9 * guess) and not is_stable(1.1 * guess)
    low, high = 0.9 * guess, 1.1 * guess
    for _ in range(18):
        load = 0.5 * (low + high)
        low, high = (load, high) if is_stable(load) else (low, load)
    return low


def order(coarse, fine):
    """Order of two errors, the second on twice as many elements."""
    return np.log2(coarse / fine)


@pytest.mark.slow
@pytest.mark.parametrize("over", [1.05, 1.5, 2.5])
def test_a_buckled_column_has_the_shape_of_eulers_elastica(over, record):
    """Clamped at the base: K(k) = (pi/2) sqrt(P/Pc), height 2E/K - 1, offset 2k/K."""
    whole = 0.5 * np.pi * np.sqrt(over)
    m = brentq(lambda m: ellipk(m) - whole, 1e-9, 1 - 1e-9)
    height, offset = 2 * ellipe(m) / whole - 1, 2 * np.sqrt(m) / whole
    errors = []
    for n in (20, 40):
        rod, state = arm(n, radius=SLENDER)
        load = over * np.pi**2 * bending(rod) / (4 * LENGTH**2)
        push = jaxrod.end_load((1e-7 * load, 0.0, -load))
        scene = jaxrod.make_scene(rod, push, jaxrod.clamp(state))
        found = jaxrod.equilibrium(scene, state)
        assert bool(found.converged) and bool(found.stable)
        x, _, z = map(float, found.state.tip)
        errors.append(np.hypot(x - offset, z - height))
    record(
        f"Column under {over} times Euler's load: its tip, n = 40 [lengths]",
        "elliptic integrals",
        errors[1],
        at_most=3e-3,
    )
    assert order(*errors) > 1.8


@pytest.mark.slow
def test_a_column_buckles_under_its_own_weight_at_greenhills_length(record):
    """A column that stands in the ground: q L^3 / EI = 7.8373 (Greenhill, 1881)."""
    errors = []
    for n in (20, 40):
        rod, state = arm(n, radius=SLENDER)
        density = float(jnp.sum(rod.element_masses)) / LENGTH

        def is_stable(weight, rod=rod, state=state, density=density):
            pull = weight * bending(rod) / LENGTH**3 / density
            down = jaxrod.gravity((0.0, 0.0, -pull))
            scene = jaxrod.make_scene(rod, down, jaxrod.clamp(state))
            found = jaxrod.equilibrium(scene, state)
            assert bool(found.converged)
            return bool(found.stable)

        errors.append(abs(largest_stable(is_stable, 7.8373) / 7.8373 - 1))
    record(
        "Heavy column: weight at which it buckles, n = 40",
        "7.8373 EI/L^3",
        errors[1],
        at_most=1e-3,
    )
    assert order(*errors) > 1.8


@pytest.mark.slow
def test_a_follower_force_makes_a_column_flutter_at_becks_load(record):
    """Two bending frequencies meet at P L^2 / EI = 20.051 (Beck, 1952)."""
    errors = []
    for n in (20, 40):
        rod, state = arm(n, radius=SLENDER)

        @jax.jit
        def matrices(load, rod=rod, state=state):
            push = jaxrod.end_load((0.0, 0.0, -load), follower=True)
            scene = jaxrod.make_scene(rod, push, jaxrod.clamp(state))
            straight = motion_of(jaxrod.equilibrium(scene, state).state)
            balance = _at_rest(scene, straight)
            place = _RodAtRest(balance).place(straight)
            tangent = getattr(place.tangent, "entries", None)
            if tangent is None:
                tangent = as_dense(place.tangent).entries
            return tangent, place.mass, balance.free

        def is_stable(load, rod=rod, matrices=matrices):
            tangent, mass, free = matrices(load * bending(rod) / LENGTH**2)
            size = free.size
            stiffness = np.asarray(tangent).reshape(size, size)
            inertia = scipy.linalg.block_diag(*np.asarray(mass))
            # Bending in one plane: displacements along x, rotations about y.
            kept = np.zeros(free.shape, bool)
            kept[:, [0, 4]] = True
            kept = np.ravel(kept & (np.asarray(free) == 1))
            own = np.ix_(kept, kept)
            squares = scipy.linalg.eigvals(stiffness[own], inertia[own])
            slow = squares[np.argsort(np.abs(squares))[:2]]
            return bool(np.max(np.abs(slow.imag)) < 1e-6 * np.max(np.abs(slow)))

        errors.append(abs(largest_stable(is_stable, 20.051) / 20.051 - 1))
    record(
        "Column under a follower force: load at which it flutters, n = 40",
        "20.051 EI/L^2",
        errors[1],
        at_most=4e-3,
    )
    assert order(*errors) > 1.8


@pytest.mark.slow
def test_a_helical_spring_has_the_stiffness_that_love_gives(record):
    """Wrench along its axis, ends free to turn: lengthening per force (Love, 1927).

    delta / F = s (R^2 (cos^2 a / GJ + sin^2 a / EI) + sin^2 a / EA + cos^2 a / kGA)
    """
    coil, angle, turns, radius = 0.1, 0.2, 3, 0.004
    length = 2 * np.pi * turns * coil / np.cos(angle)
    errors = []
    for n in (60, 120):
        s = np.linspace(0.0, length, n + 1)
        phi = s * np.cos(angle) / coil
        nodes = [coil * np.cos(phi), coil * np.sin(phi), s * np.sin(angle)]
        rod, state = jaxrod.rod_along(
            np.array(nodes), radius=radius, density=1000.0, youngs_modulus=1e9
        )
        x, y, _ = np.asarray(state.tip)
        axis = jnp.array([-x, -y, 0.0])

        @jax.jit
        def lengthened(pull, rod=rod, state=state, axis=axis):
            force = jnp.array([0.0, 0.0, 1.0]) * pull
            load = jaxrod.end_load(force, jnp.cross(axis, force))
            scene = jaxrod.make_scene(rod, load, jaxrod.clamp(state))
            end = jaxrod.equilibrium(scene, state).state
            frame = end.directors[..., -1]
            before = state.directors[..., -1]
            # The point of the axis that goes with the last element and the last node.
            arms = jnp.sum(before * axis[None], axis=1)
            moved = jnp.sum(arms[:, None] * frame, axis=0)
            return end.tip[2] + moved[2]

        _, found = jax.jvp(lengthened, (0.0,), (1.0,))
        bend, twist = rod.bend_twist_stiffness[0, 0], rod.bend_twist_stiffness[2, 0]
        shear, stretch = rod.shear_stretch_stiffness[[0, 2], 0]
        sine, cosine = np.sin(angle) ** 2, np.cos(angle) ** 2
        turning = coil**2 * (cosine / twist + sine / bend)
        # A couple at the end acts on the last element: at its middle.
        bent = length * (1 - 0.5 / n)
        exact = bent * turning + length * (sine / stretch + cosine / shear)
        errors.append(abs(float(found / exact) - 1))
    record(
        "Helical spring of three turns: lengthening, n = 120",
        "Love",
        errors[1],
        at_most=1e-2,
    )
    assert order(*errors) > 1.8


@pytest.mark.slow
@pytest.mark.parametrize("weight", [3.0, 30.0, 300.0])
def test_a_cantilever_hangs_as_its_weight_says(weight, record):
    """EI theta'' = -q (L - s) cos(theta), as Romero et al. (2021) measured it."""

    def slope(s, y):
        return np.array([y[1], -weight * (1 - s) * np.cos(y[0])])

    def ends(base, tip):
        return np.array([base[0], tip[1]])

    s = np.linspace(0, 1, 400)
    guess = np.array([0.5 * np.pi * np.tanh(5 * s), np.exp(-5 * s)])
    exact = solve_bvp(slope, ends, s, guess, tol=1e-10, max_nodes=100000)
    assert exact.success
    fine = np.linspace(0, 1, 20001)
    theta = exact.sol(fine)[0]
    far, low = np.trapezoid(np.cos(theta), fine), -np.trapezoid(np.sin(theta), fine)
    errors = []
    for n in (25, 50):
        rod, state = arm(n, radius=SLENDER, direction=(1.0, 0.0, 0.0))
        density = float(jnp.sum(rod.element_masses)) / LENGTH
        pull = weight * bending(rod) / LENGTH**3 / density
        down = jaxrod.gravity((0.0, 0.0, -pull))
        scene = jaxrod.make_scene(rod, down, jaxrod.clamp(state))
        found = jaxrod.equilibrium(scene, state)
        assert bool(found.converged) and bool(found.stable)
        x, _, z = map(float, found.state.tip)
        errors.append(np.hypot(x - far, z - low))
    record(
        f"Cantilever of weight qL^3/EI = {weight:g}: its tip, n = 50 [lengths]",
        "its differential equation",
        errors[1],
        at_most=3e-3,
    )
    assert order(*errors) > 1.8


@pytest.mark.slow
def test_a_tall_strip_tips_over_sideways_at_prandtls_load(record):
    """P L^2 / sqrt(EI GJ) = 4.0126 for a load at the tip's centre (Michell, 1899)."""
    errors = []
    for n in (20, 40):
        rod, state = arm(
            n,
            radius=None,
            section=jaxrod.rectangle(0.001, 0.05),
            direction=(1.0, 0.0, 0.0),
            normal=(0.0, 1.0, 0.0),
        )
        stiffness = np.asarray(rod.bend_twist_stiffness[:, 0])
        weak, strong = np.sort(stiffness[:2])
        unit = np.sqrt(weak * stiffness[2]) / LENGTH**2

        def is_stable(load, rod=rod, state=state, unit=unit):
            push = jaxrod.end_load((0.0, 0.0, -load * unit))
            scene = jaxrod.make_scene(rod, push, jaxrod.clamp(state))
            found = jaxrod.equilibrium(scene, state)
            assert bool(found.converged)
            return bool(found.stable)

        # Bending in the stiff plane delays it by about weak/strong.
        assert weak / strong < 1e-3
        errors.append(abs(largest_stable(is_stable, 4.0126) / 4.0126 - 1))
    record(
        "Tall strip: load at which it tips over, n = 40",
        "4.0126 sqrt(EI GJ)/L^2",
        errors[1],
        at_most=2e-3,
    )
