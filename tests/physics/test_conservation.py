"""What a free rod keeps for ever: momentum, angular momentum and, nearly, energy."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.methods.laws import IN_SPACE
from physics.rods import arm, deformed, largest, random_rod


@pytest.mark.slow
def test_momentum_of_a_spinning_bent_twisting_rod(record):
    rod, _ = random_rod(5, n_elements=8)
    scene = jaxrod.make_scene(rod)
    state = deformed(rod, 5, largest_angle=0.3, largest_strain=0.05, speed=0.3)
    after = jaxrod.advance(scene, state, jaxrod.stable_dt(scene, 0.5).dt, 10_000)
    assert largest(after.positions - state.positions) > 1, "the rod should move"
    for name, quantity in (
        ("Momentum", jaxrod.Rod.momentum),
        ("Angular momentum", jaxrod.Rod.angular_momentum),
    ):
        before = quantity(rod, state)
        record(
            f"{name} of a free, spinning, bent, twisting rod after 10 000 steps",
            "its initial value",
            largest(quantity(rod, after) - before) / float(jnp.linalg.norm(before)),
            at_most=1e-12,
        )


def test_a_free_element_tumbles_exactly():
    """Far from any load an element turns as a free symmetric top at any step size."""
    rod, state = arm(2)
    rod = replace(
        rod,
        bend_twist_stiffness=jnp.zeros((3, 2)),
        shear_stretch_stiffness=jnp.zeros((3, 2)),
    )
    spin = jnp.array([[3.0, -2.0], [1.0, 4.0], [7.0, -5.0]])
    scene = jaxrod.make_scene(rod)
    state = jaxrod.with_angular_velocities(rod, state, spin)
    coarse = jaxrod.advance(scene, state, 1e-4, 100)
    fine = jaxrod.advance(scene, state, 1e-5, 1000)
    np.testing.assert_allclose(coarse.orientations, fine.orientations, atol=1e-13)
    np.testing.assert_array_equal(coarse.angular_momenta, state.angular_momenta)
    # The polar spin is constant, the transverse one turns at (1 - J3/J1) w3 = -w3.
    angle = -spin[2] * 0.01
    expected = (
        spin[0] * np.cos(angle) + spin[1] * np.sin(angle),
        spin[1] * np.cos(angle) - spin[0] * np.sin(angle),
        spin[2],
    )
    after = jaxrod.angular_velocities(rod, coarse)
    np.testing.assert_allclose(after, jnp.stack(expected), rtol=1e-12)


def butterfly(n, mode):
    """A straight rod folded to a right angle in the middle and released.

    PyElastica's example of the same name.
    """
    properties = {
        "density": 5000.0,
        "youngs_modulus": 1e4,
        "shear_modulus": 1e4 / 1.5,
        "dtype": jnp.float64,
    }
    rod, _ = jaxrod.straight_rod(n, length=3.0, radius=0.25, **properties)
    s = np.linspace(0.0, 3.0, n + 1) / np.sqrt(2)
    folded = np.stack([np.minimum(s, s[-1] - s), np.zeros(n + 1), s])
    normal = (0.0, 1.0, 0.0)
    _, state = jaxrod.rod_along(folded, radius=0.25, normal=normal, **properties)
    return jaxrod.make_scene(rod, method=IN_SPACE[mode]), state


def energy_drift(n, dt_over_spacing, mode="consistent"):
    """Largest and final change of energy in 40 s, relative to the initial energy."""
    scene, state = butterfly(n, mode)
    dt = dt_over_spacing * 3.0 / n
    steps = 100 * round(0.4 / dt)
    states = jaxrod.rollout(scene, state, dt, steps, steps // 100)
    energies = jax.vmap(lambda s: scene.total_energy(s))(states)
    change = np.asarray(energies / energies[0] - 1)
    return np.max(np.abs(change)), change[-1]


@pytest.mark.slow
def test_the_butterfly_keeps_its_energy(record):
    worst, _ = energy_drift(20, 0.01)
    record(
        "Energy of the butterfly, n = 20, 40 s at dt = 0.01 dl, largest drift",
        "its initial value",
        worst,
        at_most=1e-3,
    )


@pytest.mark.slow
def test_the_energy_error_falls_with_the_square_of_the_step(record):
    ratio = energy_drift(8, 0.04)[0] / energy_drift(8, 0.02)[0]
    record(
        "Energy error of the butterfly, n = 8, step halved: ratio",
        "4",
        ratio,
        between=(3.5, 4.5),
    )


@pytest.mark.slow
def test_pyelastica_s_law_gains_energy(record):
    """What the consistent mode is for."""
    _, final = energy_drift(10, 0.01, "pyelastica")
    record(
        "The same in PyElastica mode, n = 10: relative gain after 40 s",
        "+0.49 (PyElastica 1.0)",
        final,
        between=(0.4, 0.55),
    )


@pytest.mark.parametrize(
    "mode", ["consistent", pytest.param("pyelastica", marks=pytest.mark.slow)]
)
def test_gravity_alone_makes_a_rod_fall_as_a_stone_does(mode):
    rod, state = random_rod(6, n_elements=5)
    scene = jaxrod.make_scene(
        rod, jaxrod.gravity((0.0, 1.0, -9.0)), method=IN_SPACE[mode]
    )
    dt = float(jaxrod.stable_dt(scene).dt)
    after = jaxrod.advance(scene, state, dt, 1000)
    fallen = 0.5 * (1000 * dt) ** 2 * np.array([[0.0], [1.0], [-9.0]])
    np.testing.assert_allclose(
        after.positions - state.positions, fallen + 0 * state.positions, atol=1e-9
    )
    # The state never depends on where gravity's energy is counted from.
    kept = scene.total_energy(after) - scene.total_energy(state)
    assert abs(float(kept)) <= 1e-9 * float(rod.kinetic_energy(after))


def test_kinetic_energy_is_that_of_nodes_and_of_turning_elements():
    rod, state = arm(4, jnp.float64)
    spin = jnp.broadcast_to(jnp.array([[1.0], [2.0], [5.0]]), (3, 4))
    turning = jaxrod.with_angular_velocities(rod, state, spin)
    still = replace(turning, velocities=jnp.zeros_like(state.velocities))
    turn = 0.5 * np.sum(np.asarray(rod.principal_inertias) * np.asarray(spin) ** 2)
    np.testing.assert_allclose(rod.kinetic_energy(still), turn, rtol=1e-12)
    moving = replace(still, velocities=still.velocities + 3.0)
    way = 0.5 * np.sum(np.asarray(rod.node_masses)) * 3 * 3.0**2
    np.testing.assert_allclose(rod.kinetic_energy(moving), turn + way, rtol=1e-12)
