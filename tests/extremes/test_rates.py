"""Spin, steps and damping at their limits."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm


@jax.jit
def spun(scene, state, rate):
    """Energy and angular momentum, recorded, of a rod set spinning [rad/s]."""
    spins = jnp.zeros((3, 4)).at[2].set(rate).at[0].set(1e-3 * rate)
    spinning = jaxrod.with_angular_velocities(scene.rod, state, spins)

    def block(s, _):
        s = jaxrod.advance(scene, s, 1e-4, jnp.asarray(1000))
        return s, (scene.total_energy(s), scene.angular_momentum(s))

    return jax.lax.scan(block, spinning, length=20)[1]


@pytest.mark.parametrize("rate", [1.0, 100.0, 1e4])
def test_spinning_about_the_axis_keeps_its_energy(rate, record):
    """A radian per step at the fastest, and a slight wobble."""
    rod, state = arm(4)
    energies, momenta = map(np.asarray, spun(jaxrod.make_scene(rod), state, rate))
    record(
        f"Energy of a rod spinning at {rate:g} rad/s over 20,000 steps, change",
        "conservation",
        np.max(np.abs(energies / energies[0] - 1)),
        at_most=1e-5,
    )
    drift = np.linalg.norm(momenta - momenta[0], axis=1).max()
    assert drift <= 1e-11 * np.linalg.norm(momenta[0])


@jax.jit
def growth(scene, state, dt):
    """How far noise of 1e-8 m carries in 200 steps [m], and whether it is flagged."""
    noise = 1e-8 * jax.random.normal(jax.random.key(0), state.positions.shape)
    start = replace(state, positions=state.positions + noise)
    after = jaxrod.advance(scene, start, dt, jnp.asarray(200))
    flagged = jaxrod.health(scene, after, dt).flagged
    kept = jaxrod.freeze(flagged, start, after)
    return jnp.max(jnp.abs(kept.positions - state.positions)), flagged


@pytest.mark.parametrize("radius", [0.002, 0.05])
def test_steps_from_a_tenth_of_the_limit_to_just_above_it(radius):
    rod, state = arm(5, radius=radius)
    scene = jaxrod.make_scene(rod)
    limit = jaxrod.stable_dt(scene, 1.0).dt  # Within a per cent of the true one.
    for share in (0.1, 0.5, 0.8, 0.95):
        moved, flagged = growth(scene, state, share * limit)
        assert moved < 1e-6 and not flagged
    moved, flagged = growth(scene, state, 1.05 * limit)
    assert flagged and moved < 1e-6


@jax.jit
def fallen(scene, state, dt):
    """Speed along x after 2000 steps [m/s], and whether the state is flagged."""
    after = jaxrod.advance(scene, state, dt, jnp.asarray(2000))
    return after.velocities[0], jaxrod.health(scene, after, dt).flagged


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("exponent", [0.0, 1e-6, 0.1, 1.0, 10.0, 50.0])
def test_damping_from_none_to_fifty_per_step(exponent, dtype):
    """Terminal velocity is right and nothing overflows; g h is the exponent."""
    rod, state = arm(4, dtype=dtype)
    dt = 1e-4
    rate = exponent / dt
    pull, fall = 0.5, 9.81
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((fall, 0.0, 0.0)),
        jaxrod.end_load(couple=(0.0, 0.0, pull)),
        jaxrod.exponential_damping(rate),
    )
    velocities, flagged = fallen(scene, state, jnp.asarray(dt, dtype))
    assert not flagged
    elapsed = 2000 * dt
    speed = fall * elapsed if rate == 0 else -np.expm1(-rate * elapsed) / rate * fall
    np.testing.assert_allclose(velocities, speed, rtol=2e-3)


@jax.jit
def relaxing(scene, state, dt):
    """Potential energy, recorded every 200 steps [J]."""

    def block(s, _):
        after = jaxrod.advance(scene, s, dt, jnp.asarray(200))
        return after, scene.potential_energy(s)

    return jax.lax.scan(block, state, length=100)[1]


@pytest.mark.parametrize("exponent", [1.0, 50.0])
def test_an_overdamped_rod_relaxes_and_does_not_ring(exponent):
    rod, state = arm(4)
    bent = replace(
        state, positions=state.positions.at[0].add(0.05 * state.positions[2] ** 2)
    )
    dt = 1e-4
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), jaxrod.exponential_damping(exponent / dt)
    )
    energies = relaxing(scene, bent, dt)
    assert jnp.all(jnp.diff(energies) <= 1e-12 * energies[0])
    assert energies[-1] < 0.9 * energies[0]
