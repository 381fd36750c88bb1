"""Identification of rods: films, forces, poses at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.identification.run import DROPPED, MATERIAL, Drop, Poses, noisy
from jaxrod import control

pytestmark = pytest.mark.slow

N, FRAMES = 4, 20


@pytest.fixture(scope="module")
def drop():
    return Drop(N, FRAMES)


def test_stiffness_and_damping_are_found_from_four_times_off(drop):
    truth = {k: DROPPED[k] for k in ("youngs_modulus", "damping")}
    sd = {"film": 2e-3}
    clean = jax.jit(drop.film)(truth)
    start = {"youngs_modulus": 4e7, "damping": 0.5}
    upper = {"youngs_modulus": 4.5e7}

    def fit(key):
        seen = noisy(clean, sd, key)
        return control.fit(drop.film, seen, start, noise=sd, upper=upper)

    fits = jax.jit(jax.vmap(fit))(jax.random.split(jax.random.key(0), 100))
    assert bool(jnp.all(fits.converged))
    assert bool(jnp.all(fits.determined))
    np.testing.assert_allclose(np.mean(fits.misfit), 1, atol=0.02)
    for name, z in fits.z(truth).items():
        # Of 100 draws the mean is known to 0.1 and the deviation to 0.07.
        assert abs(float(jnp.mean(z))) < 0.4, name
        assert 0.75 < float(jnp.std(z)) < 1.3, name
    error = np.abs(np.asarray(fits.values["youngs_modulus"]) / 1e7 - 1)
    assert np.mean(error) < 0.01


def test_positions_alone_do_not_weigh_an_arm_and_a_force_sensor_does(drop):
    start = {"youngs_modulus": 1.5e7, "damping": 1.0, "density": 700.0}
    upper = {"youngs_modulus": 4.5e7}
    sd = {"film": 2e-3}
    film = noisy(jax.jit(drop.film)(DROPPED), sd, jax.random.key(1))
    alone = control.fit(drop.film, film, start, noise=sd, upper=upper)
    (words,) = alone.undetermined
    assert words.startswith("density and youngs_modulus each")
    ratio = alone.forecast(lambda p: p["youngs_modulus"] / p["density"])
    assert abs(float(ratio.value) - 1e4) < 4 * float(ratio.sd)
    assert float(ratio.sd) < 500
    sd |= {"force": 0.5}
    both = noisy(jax.jit(drop.film_and_force)(DROPPED), sd, jax.random.key(2))
    fit = control.fit(drop.film_and_force, both, start, noise=sd, upper=upper)
    assert fit.undetermined == ()
    assert bool(fit.converged)
    for name, z in fit.z(DROPPED).items():
        assert abs(float(z)) < 4, name
    assert float(fit.values["density"]) == pytest.approx(1000, rel=0.02)


def test_three_constants_are_found_from_poses_at_rest():
    poses = Poses(10)
    sd = {"markers": 1e-3}
    seen = noisy(jax.jit(poses.markers)(MATERIAL), sd, jax.random.key(3))
    start = {"youngs_modulus": 9e5, "poisson_ratio": 0.2, "density": 650.0}
    fit = control.fit(
        poses.markers, seen, start, noise=sd, upper={"poisson_ratio": 0.5}
    )
    assert bool(fit.converged)
    assert fit.undetermined == ()
    for name, z in fit.z(MATERIAL).items():
        assert abs(float(z)) < 3.5, name
    assert float(fit.values["youngs_modulus"]) == pytest.approx(315e3, rel=0.05)
