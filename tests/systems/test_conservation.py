"""Free systems keep momentum and angular momentum, and energy to second order."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

import jaxrod
from systems.members import free_system, rod


@pytest.mark.slow
def test_momenta_with_joints_and_dashpots(record):
    system, state = free_system()
    dt = 0.5 * jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 1000)
    moved = np.linalg.norm(after["head"].positions - state["head"].positions)
    assert moved > 0.01
    assert not jaxrod.health(system, after, dt).flagged
    joints = "free rods and bodies with joints and dashpots"
    for name, function, bar in (
        ("momentum", jaxrod.System.momentum, 1e-14),
        ("angular momentum", jaxrod.System.angular_momentum, 1e-13),
    ):
        change = np.linalg.norm(function(system, after) - function(system, state))
        # Relative to what there is of it, were all of it in one direction.
        record(joints, name, change / sizes(system, state)[name], at_most=bar)
    # Dashpots took something.
    energies = [system.total_energy(s) for s in (state, after)]
    assert energies[1] < energies[0]


def sizes(system, state):
    """Sums of the sizes of momenta and angular momenta of all nodes and bodies."""
    linear = angular = 0.0
    for name, member in system.members.items():
        own = state[name]
        masses = member.masses if name in ("head", "ball") else member.rod.node_masses
        speeds = np.linalg.norm(own.velocities, axis=0)
        places = np.linalg.norm(own.positions, axis=0)
        linear += np.sum(masses * speeds)
        angular += np.sum(masses * places * speeds)
    return {"momentum": linear, "angular momentum": angular}


@pytest.mark.slow
def test_energy_of_a_rod_on_a_body_is_of_second_order():
    one, of_one = rod()
    spin = np.array((2.0, -1.0, 3.0))
    body, of_body = jaxrod.systems.rigid_body(
        jaxrod.shapes.box((-0.05, 0.01, 0.0), (0.05, 0.03, 0.02)),
        density=2000.0,
        angular_velocity=spin,
        dtype=jnp.float64,
    )
    arms = np.asarray(of_one.positions - of_body.positions)
    turning = np.cross(spin, arms.T).T
    along = np.linspace(0, 1, arms.shape[1])
    bends = np.array([[0.0], [1.0], [-0.5]]) * along**2
    of_one = replace(of_one, velocities=jnp.asarray(turning + bends))
    of_one = jaxrod.with_angular_velocities(one, of_one, body_rates(of_one, spin))
    state = {"rod": of_one, "body": of_body}
    system = jaxrod.make_system(
        {"rod": jaxrod.make_scene(one), "body": body},
        jaxrod.systems.attach(("rod", "base"), ("body",), state),
    )
    dt, start = jaxrod.stable_dt(system).dt, system.total_energy(state)
    errors = []
    for k in (2, 4, 8):
        path = jaxrod.rollout(system, state, dt / k, 300 * k, every=20 * k)
        energies = jax.vmap(lambda s: system.total_energy(s))(path)
        errors.append(float(jnp.max(jnp.abs(energies - start))))
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert errors[-1] < 1e-4 * start
    assert np.all(ratios > 3.2)


def body_rates(state, spin):
    """Angular velocity of all elements of a rod that turns as a whole."""
    return np.einsum("ijn,j->in", np.asarray(state.directors), spin)


def test_asymmetric_body_tumbles_with_the_period_of_the_closed_form(record):
    """Euler's top: periods by elliptic integrals (Landau and Lifshitz, section 37)."""
    i1, i2, i3 = moments = (1.0, 2.0, 2.9)
    body, state = jaxrod.systems.rigid_body(
        mass=1.0,
        inertia=moments,
        angular_velocity=(0.1, 2.0, 0.05),
        dtype=jnp.float64,
    )
    system = jaxrod.make_system({"body": body})
    own = np.array((0.1, 2.0, 0.05))
    twice = float(np.sum(np.array(moments) * own**2))
    square = float(np.sum((np.array(moments) * own) ** 2))
    if square < twice * i2:
        i1, i3 = i3, i1
    k2 = (i2 - i1) * (twice * i3 - square) / ((i3 - i2) * (square - twice * i1))
    root = np.sqrt(i1 * i2 * i3 / ((i3 - i2) * (square - twice * i1)))
    period = 4 * ellipk(k2) * root
    n = 4000
    path = jaxrod.rollout(system, {"body": state}, period / n, n, every=n // 4)
    frames = jax.vmap(lambda s: s.directors)(path["body"])[..., 0]
    rates = path["body"].angular_velocities[..., 0]
    seen = np.einsum("tij,tj->ti", frames, rates)
    error = np.linalg.norm(seen[-1] - seen[0]) / np.linalg.norm(seen[0])
    record(
        "free asymmetric body, after a period",
        "elliptic integrals (Landau and Lifshitz)",
        error,
        at_most=1e-4,
    )
    # It turned over on the way, about the middle axis.
    assert seen[2, 1] == pytest.approx(-seen[0, 1], rel=0.02)
    momenta = np.asarray(jax.vmap(lambda s: system.angular_momentum(s))(path))
    assert np.ptp(np.linalg.norm(momenta, axis=1)) < 1e-13
    assert np.max(np.abs(momenta - momenta[0])) < 1e-12


def test_sphere_and_symmetric_top_turn_exactly():
    body, state = jaxrod.systems.rigid_body(
        jaxrod.shapes.cylinder((0, 0, 0), (0, 0, 0.3), 0.1),
        density=1000.0,
        angular_velocity=(1.0, 0.0, 4.0),
        dtype=jnp.float64,
    )
    system = jaxrod.make_system({"top": body})
    few = jaxrod.advance(system, {"top": state}, 0.1, 10)["top"]
    many = jaxrod.advance(system, {"top": state}, 0.001, 1000)["top"]
    np.testing.assert_allclose(few.orientations, many.orientations, atol=1e-12)
