"""Enlarged transverse inertia: larger steps, the same slow motion."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm, random_rod


def rope(n=50, radius=0.002):
    rod, state = arm(n, radius=radius)
    return jaxrod.make_scene(rod, jaxrod.clamp(state)), state


@pytest.mark.slow
def test_a_thin_rope_takes_five_times_larger_steps(record):
    scene, state = rope()
    scaling = jaxrod.scale_inertia(scene)
    record(
        "Stable step of a rope, L/r = 500, n = 50, with enlarged inertia",
        "without",
        float(scaling.gain),
        between=(5.0, 6.0),
    )
    changes = jaxrod.frequency_changes(scaling, state, 8)
    record(
        "Its first four bending frequencies, twice each: largest change",
        "without",
        float(np.max(np.abs(changes))),
        at_most=3e-3,
    )
    # Mass and polar inertia are what waves need.
    before, after = scene.rod, scaling.scene.rod
    np.testing.assert_array_equal(after.rotary_inertia[1], before.rotary_inertia[1])
    np.testing.assert_array_equal(after.linear_density, before.linear_density)


@pytest.mark.slow
def test_the_swing_is_the_same():
    scene, state = rope(20)
    scene = replace(scene, effects=(*scene.effects, jaxrod.gravity((9.81, 0.0, 0.0))))
    scaling = jaxrod.scale_inertia(scene)
    dt = 0.02 / np.ceil(0.02 / (0.8 * float(scaling.dt)))
    small = 0.02 / np.ceil(0.02 / (0.8 * float(scaling.dt_before)))
    fast = jaxrod.advance(scaling.scene, state, dt, round(0.3 / dt))
    slow = jaxrod.advance(scene, state, small, round(0.3 / small))
    assert abs(float(slow.tip[0])) > 0.4
    np.testing.assert_allclose(fast.positions, slow.positions, atol=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_the_step_asked_for_is_stable(seed):
    """At the new limit a rod with noise on it stays where it is."""
    rod, state = random_rod(seed, 12)
    rod = replace(rod, rotary_inertia=rod.rotary_inertia.at[0].mul(0.1))
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    other = float(jaxrod.scale_inertia(scene).dt)
    asked = 0.9 * max(other, float(jaxrod.stable_dt(scene, 1.0).dt))
    scaling = jaxrod.scale_inertia(scene, asked)
    assert asked <= float(scaling.dt) <= 1.5 * asked
    assert float(jnp.min(scaling.factors)) >= 1
    noise = 1e-8 * np.random.default_rng(seed).normal(size=(3, 13))
    shaken = replace(state, velocities=jnp.asarray(noise))
    after = jaxrod.advance(scaling.scene, shaken, asked, 2000)
    assert float(jnp.max(jnp.abs(after.positions - state.positions))) < 1e-6


def test_thick_rods_are_left_alone():
    scaling = jaxrod.scale_inertia(jaxrod.make_scene(arm(20, radius=0.2)[0]))
    np.testing.assert_array_equal(scaling.factors, 1.0)
    assert float(scaling.gain) == 1.0


def test_it_works_under_transformations():
    scene, _ = rope(8)

    def limit(density):
        rod = replace(scene.rod, linear_density=density * scene.rod.linear_density)
        return jaxrod.scale_inertia(replace(scene, rod=rod)).dt

    together = jax.jit(jax.vmap(limit))(jnp.array([1.0, 4.0]))
    alone = [float(limit(1.0)), float(limit(4.0))]
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_of_a_schedule_its_largest_size_counts():
    scene, _ = rope()
    pull = jaxrod.end_load(jaxrod.schedules.sine((0.0, 0.0, 5.0), 0.5))
    held = jaxrod.end_load((0.0, 0.0, 5.0))
    moving, still = (
        jaxrod.scale_inertia(replace(scene, effects=(*scene.effects, effect)))
        for effect in (pull, held)
    )
    assert moving.scene.effects[-1] is pull
    assert np.array_equal(moving.factors, still.factors)
    assert moving.gain == still.gain > 2


def test_a_step_beyond_the_other_limits_is_refused():
    scene, _ = rope()
    with pytest.raises(
        ValueError, match=r"dt must be below 0.0002 s, the limit from stretch"
    ):
        jaxrod.scale_inertia(scene, 3e-4)
    with pytest.raises(ValueError, match="dt must be positive"):
        jaxrod.scale_inertia(scene, 0.0)


@pytest.mark.slow
def test_natural_frequencies_are_those_of_a_hanging_mass():
    """Stretch alone: a bar clamped at one end, closed form of the discrete chain."""
    n = 10
    rod, state = arm(n)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    every = jaxrod.natural_frequencies(scene, state)
    assert every.size == 6 * n
    k = np.arange(1, n + 1)
    speed = np.sqrt(1e7 / 1000.0)
    axial = 2 * speed * n * np.sin((2 * k - 1) * np.pi / (4 * n))
    for frequency in axial:
        assert np.min(np.abs(every / frequency - 1)) < 1e-10
    np.testing.assert_array_equal(
        jaxrod.natural_frequencies(scene, state, 3), every[:3]
    )


@pytest.mark.slow
def test_a_free_rod_has_six_rigid_motions():
    rod, state = arm(6)
    every = jaxrod.natural_frequencies(jaxrod.make_scene(rod), state)
    assert np.all(every[:6] < 1e-4 * every[6])


@pytest.mark.slow
def test_natural_frequencies_refuse_what_they_cannot_do():
    rod, state = arm(3)
    with pytest.raises(ValueError, match="not the gradient of an energy"):
        jaxrod.natural_frequencies(
            jaxrod.make_scene(rod, method=jaxrod.pyelastica()), state
        )
    with pytest.raises(ValueError, match="n_modes must be at most 21"):
        jaxrod.natural_frequencies(jaxrod.make_scene(rod), state, 22)
