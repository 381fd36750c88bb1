"""The nest of the examples: rods settle on each other and stay in the cylinder."""

import jax
import numpy as np
import pytest

import jaxrod
from examples.loading import load


@pytest.mark.slow
def test_a_small_nest_runs_and_begins_to_fall():
    with jax.enable_x64(True):
        system, state, dt = load("nest").nest(20)
        after = jaxrod.advance(system, state, dt, 40)
        lists = after["neighbours"]
        assert lists.missed <= 0 and lists.moved < 1 and lists.used > 20
        time = 40 * float(dt)
        speed = np.asarray(after["rods"].velocities)[:, 2].mean()
        assert -1.01 * 9.81 * time < speed < 0


@pytest.mark.slow
def test_rods_settle_in_the_cylinder_and_no_contact_is_missed():
    with jax.enable_x64(True):
        example = load("nest")
        system, state, dt = example.nest(30)
        after = jaxrod.advance(system, state, dt, 600)
        health = jaxrod.health(system, after, dt)
        assert not health.overflow and not health.stale and not health.flagged
        assert float(after["neighbours"].used) > 100
        x, y, z = np.moveaxis(np.asarray(after["rods"].positions), 1, 0)
        assert np.min(z) > 0.5 * example.RADIUS
        assert np.max(np.hypot(x, y)) < example.WALL
        # It fell, by less than a layer: the second layer carries the third.
        drop = np.asarray(state["rods"].positions)[:, 2].mean() - z.mean()
        assert 0 < drop < 4 * example.RADIUS
        assert np.mean(z[20:]) > np.mean(z[:10]) + 2 * example.RADIUS


@pytest.mark.slow
def test_energy_only_falls_while_a_nest_settles():
    """Three layers that come to rest on each other, by friction and in air."""
    with jax.enable_x64(True):
        system, state, dt = load("nest").nest(30)
        energy = jax.jit(lambda moved: system.total_energy(moved))
        run = jax.jit(jaxrod.advance, static_argnums=3)
        found = []
        for _ in range(25):
            state = run(system, state, dt, int(0.06 / dt))
            found.append(float(energy(state)))
        assert not jaxrod.health(system, state, dt).flagged
        assert np.all(np.diff(found) < 0)
