"""Free systems keep momentum and angular momentum, and energy to second order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

import jaxrod
from systems.members import free_system, rod, stirred


def test_momenta_with_joints_and_dashpots(record):
    system, state = free_system()
    dt = 0.5 * jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 2000)
    before_p, after_p = (jaxrod.momentum(system, s) for s in (state, after))
    before_l, after_l = (jaxrod.angular_momentum(system, s) for s in (state, after))
    moved = np.linalg.norm(after["head"].positions - state["head"].positions)
    linear = np.linalg.norm(after_p - before_p) / np.linalg.norm(before_p)
    angular = np.linalg.norm(after_l - before_l) / np.linalg.norm(before_l)
    assert moved > 0.03
    assert not jaxrod.health(system, after, dt).flagged
    record("free system with joints and dashpots", "momentum", linear, at_most=1e-14)
    record(
        "free system with joints and dashpots",
        "angular momentum",
        angular,
        at_most=1e-13,
    )
    # Dashpots took something.
    energies = [jaxrod.total_energy(system, s) for s in (state, after)]
    assert energies[1] < energies[0]


def test_energy_of_a_rod_on_a_body_is_of_second_order():
    one, of_one = rod()
    body, of_body = jaxrod.rigid_body(
        jaxrod.box((-0.05, 0.01, 0.0), (0.05, 0.03, 0.02)),
        density=2000.0,
        angular_velocity=(2.0, -1.0, 3.0),
        dtype=jnp.float64,
    )
    state = {"rod": stirred(of_one), "body": of_body}
    system = jaxrod.make_system(
        {"rod": jaxrod.make_scene(one), "body": body},
        jaxrod.attach(("rod", "start"), ("body",), state),
    )
    state = jaxrod.advance(system, state, 1e-12, 1)
    dt, start = jaxrod.stable_dt(system).dt, jaxrod.total_energy(system, state)
    errors = []
    for k in (2, 4, 8):
        after = jaxrod.advance(system, state, dt / k, 300 * k)
        errors.append(abs(float(jaxrod.total_energy(system, after) - start)))
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert errors[-1] < 1e-3 * start
    assert np.all(ratios > 3.2)


def test_asymmetric_body_tumbles_with_the_period_of_the_closed_form(record):
    """Euler's top: periods by elliptic integrals (Landau and Lifshitz, section 37)."""
    i1, i2, i3 = moments = (1.0, 2.0, 2.9)
    body, state = jaxrod.rigid_body(
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
    momenta = np.asarray(jax.vmap(lambda s: jaxrod.angular_momentum(system, s))(path))
    assert np.ptp(np.linalg.norm(momenta, axis=1)) < 1e-13
    assert np.max(np.abs(momenta - momenta[0])) < 1e-12


def test_sphere_and_symmetric_top_turn_exactly():
    body, state = jaxrod.rigid_body(
        jaxrod.cylinder((0, 0, 0), (0, 0, 0.3), 0.1),
        density=1000.0,
        angular_velocity=(1.0, 0.0, 4.0),
        dtype=jnp.float64,
    )
    system = jaxrod.make_system({"top": body})
    few = jaxrod.advance(system, {"top": state}, 0.1, 10)["top"]
    many = jaxrod.advance(system, {"top": state}, 0.001, 1000)["top"]
    np.testing.assert_allclose(few.orientations, many.orientations, atol=1e-12)
