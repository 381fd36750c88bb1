"""Identification across a fork: starts of windows, and four parameters at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.identification.buckling import (
    LENGTH,
    PERIOD,
    PRESSED,
    SD,
    TRUTH,
    Buckling,
)
from benchmarks.identification.fit_rows import noisy, scaled

TIME = 0.7


@pytest.fixture(scope="module")
def small():
    return Buckling(n=6, modes=3, frames=12)


@pytest.fixture(scope="module")
def bent():
    return {
        "amplitudes": jnp.array([0.6, -0.1, 0.05]),
        "rates": jnp.array([1.0, 2.0, -1.0]),
    }


@pytest.mark.slow
def test_a_start_meets_the_walls_under_one_force_along_the_rod(small, bent):
    nodes, angle = small.shape(bent["amplitudes"], TIME)
    gap = LENGTH - 0.5 * PRESSED * (1 - np.cos(2 * np.pi * TIME / PERIOD))
    np.testing.assert_allclose(nodes[:, -1], [0, gap], atol=1e-9)
    edges = np.diff(np.asarray(nodes), axis=1) * small.n / LENGTH
    along = np.array([np.sin(angle), np.cos(angle)])
    across = np.array([np.cos(angle), -np.sin(angle)])
    scene, _ = small.scene(TRUTH)
    shear, _, stretch = np.asarray(scene.rod.shear_stretch_stiffness)
    force = stretch * (np.sum(edges * along, axis=0) - 1) * along
    force += shear * np.sum(edges * across, axis=0) * across
    np.testing.assert_allclose(force[0], 0, atol=1e-9)
    np.testing.assert_allclose(force[1], force[1, 0])
    assert abs(force[1, 0]) > 1


@pytest.mark.slow
def test_a_start_moves_as_its_rates_say(small, bent):
    state = small.state(TRUTH, bent, jnp.asarray(TIME))
    h = 1e-6
    ends = []
    for side in (-h, h):
        amplitudes = bent["amplitudes"] + side * bent["rates"]
        ends.append(small.shape(amplitudes, TIME + side))
    velocity, spin = ((b - a) / (2 * h) for a, b in zip(*ends, strict=True))
    np.testing.assert_allclose(state.velocities[::2], velocity, atol=1e-6)
    scene, _ = small.scene(TRUTH)
    found = jaxrod.angular_velocities(scene.rod, state)[1]
    np.testing.assert_allclose(found, spin, atol=1e-5)


@pytest.mark.slow
def test_windows_joined_one_after_the_other_are_one_run(small, bent):
    state = small.state(TRUTH, bent, jnp.asarray(TIME))
    first = jnp.asarray(21)
    whole, end = jax.jit(lambda: small.joint(TRUTH, state, first, 4))()

    def halves():
        a, middle = small.joint(TRUTH, state, first, 2)
        b, end = small.joint(TRUTH, middle, first + 2, 2)
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), a, b), end

    joined, last = jax.jit(halves)()
    for found, expected in ((joined, whole), (last, end)):
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(x, y, atol=1e-9), found, expected
        )


@pytest.mark.slow
def test_four_parameters_are_found_across_the_fork_from_three_times_off():
    buckling = Buckling(n=8, modes=6, frames=90)
    clean = jax.jit(buckling.films)(jax.random.split(jax.random.key(1), 4))
    seen = noisy(clean, SD, jax.random.key(2))
    start = scaled(TRUTH, (3.5, 1 / 3, 3.0, 0.25))
    fit = jax.jit(lambda seen, start: buckling.fit(seen, start, 6))(seen, start)
    assert bool(fit.converged)
    for name, value in TRUTH.items():
        assert float(fit.values[name]) == pytest.approx(value, rel=0.02), name
        assert abs(float(fit.z(TRUTH)[name])) < 3.5, name
    assert float(fit.misfit) == pytest.approx(1, abs=0.05)
