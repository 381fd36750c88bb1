"""The examples of a coupling, a method and a shape of one's own do what they say."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from examples.loading import load

own_coupling, own_method = load("own_coupling"), load("own_method")
own_shape = load("own_shape")


@pytest.mark.slow
def test_a_tether_lets_fall_catches_and_keeps_energy_and_momentum():
    system, state = own_coupling.dropped(slack=0.1)
    dt = float(jaxrod.stable_dt(system, 0.2).dt)
    free = int(0.9 * np.sqrt(2 * 0.1 / 9.81) / dt)
    fallen = jaxrod.advance(system, state, dt, free)
    assert float(jnp.max(jnp.abs(fallen["arm"].velocities))) < 1e-9
    speed = float(fallen["ball"].velocities[2, 0])
    np.testing.assert_allclose(speed, -9.80665 * free * dt, rtol=1e-6)
    caught = jaxrod.advance(system, fallen, dt, 3 * free)
    assert float(jnp.max(jnp.abs(caught["arm"].velocities))) > 0.01
    before, after = (float(system.total_energy(s)) for s in (state, caught))
    fell = float(state["ball"].positions[2, 0] - fallen["ball"].positions[2, 0])
    mass = float(system.members["ball"].masses[0])
    assert abs(after - before) < 1e-3 * mass * 9.81 * fell


@pytest.mark.slow
def test_a_taut_tether_passes_momentum_on_and_makes_none():
    system, state = own_coupling.dropped(slack=-0.02)
    members = {
        "arm": jaxrod.make_scene(system.members["arm"].rod),
        "ball": replace(system.members["ball"], effects=()),
    }
    free = jaxrod.make_system(members, system.couplings[0], state=state)
    after = jaxrod.advance(free, state, jaxrod.stable_dt(free).dt, 100)
    passed = float(members["ball"].masses[0] * jnp.abs(after["ball"].velocities).max())
    assert passed > 1e-4
    for total in (jaxrod.System.momentum, jaxrod.System.angular_momentum):
        np.testing.assert_allclose(total(free, after), 0, atol=1e-9 * passed)


def test_symplectic_euler_is_of_first_order():
    euler = own_method.SymplecticEuler()
    exact = own_method.swing(own_method.CONSISTENT, 8000)
    errors = [
        float(jnp.linalg.norm(own_method.swing(euler, n) - exact)) for n in (400, 800)
    ]
    assert 1.8 < errors[0] / errors[1] < 2.3


@pytest.mark.slow
def test_a_rod_lies_on_a_torus_and_is_shown_with_it():
    scene, states, times = own_shape.laid()
    crossing = jnp.argmin(jnp.abs(states.positions[-1, 0] - 0.15))
    height = float(states.positions[-1, 2, crossing])
    assert height == pytest.approx(0.02 + 0.008, abs=0.003)
    assert float(jnp.max(jnp.abs(states.velocities[-1, 2]))) < 0.05
    replay = jaxrod.viz.Replay.from_states(scene, states, times)
    (mesh,) = replay.meshes
    distance, _ = own_shape.Torus(0.15, 0.02).surface(tuple(mesh.vertices.T))
    np.testing.assert_allclose(distance, 0, atol=1e-6)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    volume = np.sum(a * np.cross(b, c)) / 6
    assert volume == pytest.approx(2 * np.pi**2 * 0.15 * 0.02**2, rel=0.03)
