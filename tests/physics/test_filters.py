"""Damping of short waves: its rate, and what it leaves alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.rods.motion import motion_of, state_of
from physics.rods import arm, deformed, largest, random_rod
from physics.test_internal_damping import spinning

DT = 1e-3


@jax.jit
def filtered(rod, state, rate):
    effect = jaxrod.short_wave_damping(rate, order=2)
    scene = jaxrod.make_scene(rod, effect)
    return state_of(effect.dissipate(scene, motion_of(state), jnp.asarray(DT)))


@pytest.mark.slow
def test_what_a_filter_keeps(record):
    """Momenta, and rigid motion; energy falls, at any rate."""
    rod, state = random_rod(4, n_elements=8)
    moving = deformed(rod, 4, largest_angle=0.5, speed=1.0)
    worst = 0.0
    for rate in (10.0, 1e6):
        after = filtered(rod, moving, rate)
        for quantity in (jaxrod.Rod.momentum, jaxrod.Rod.angular_momentum):
            before = quantity(rod, moving)
            change = largest(quantity(rod, after) - before)
            worst = max(worst, change / float(jnp.linalg.norm(before)))
        lost = rod.kinetic_energy(after) / rod.kinetic_energy(moving)
        assert lost < 0.999
    rigid = spinning(rod, state, [3.0, -1.0, 2.0])
    after = filtered(rod, rigid, 1e6)
    kept = largest(after.velocities - rigid.velocities)
    record(
        "Momentum, angular momentum and rigid motion under short-wave damping, change",
        "0",
        max(worst, kept),
        at_most=1e-13,
    )


@pytest.mark.parametrize("wave", [2, 5])
def test_the_rate_of_a_wave(wave, record):
    """Axial, on a straight free rod: the filter's own modes."""
    rod, state = arm(8)
    mode = np.cos(wave * np.pi * np.arange(9) / 8)
    state = replace(state, velocities=state.velocities.at[2].set(mode))
    after = filtered(rod, state, 100.0)
    share = np.sin(wave * np.pi / 16) ** 4
    expected = 1 - share * -np.expm1(-100.0 * DT)
    record(
        f"Wave {wave} of 8 elements after a step of short-wave damping, off by",
        "1 - (1 - exp(-g h)) sin(k l/2)^4",
        float(np.max(np.abs(after.velocities[2] - expected * mode))),
        at_most=1e-13,
    )


def test_what_is_no_filter_is_refused():
    with pytest.raises(ValueError, match="rate must be non-negative"):
        jaxrod.short_wave_damping(-1.0)
    with pytest.raises(ValueError, match="order must be at least 1"):
        jaxrod.laplacian_filter(0)
    rod, state = arm(3)
    scene = jaxrod.make_scene(rod, jaxrod.laplacian_filter(3))
    with pytest.raises(ValueError, match="short_wave_damping"):
        jaxrod.advance(scene, state, 1e-4, 1)
