"""Velocities and spins decay each at its own rate, in every method."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

DT = 1e-6
RATES = 2e5, 7e5


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "method",
    [
        jaxrod.consistent(),
        jaxrod.pyelastica(),
        jaxrod.torsion_free(),
        jaxrod.planar("zx"),
    ],
    ids=lambda method: type(method).__name__,
)
def test_velocities_and_spins_decay_at_their_own_rates(method):
    """In a step so short that internal loads change next to nothing."""
    rod, state = jaxrod.straight_rod(
        4,
        length=1.0,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e5,
        dtype=jnp.float64,
    )
    about_y = jnp.asarray([[0.0, 1.0, 0.0]]).T
    state = replace(
        state,
        velocities=state.velocities.at[0].set(0.3),
        angular_momenta=1e-6 * about_y * jnp.asarray([[1.0, -2.0, 3.0, 1.5]]),
    )
    scene = jaxrod.make_scene(rod, jaxrod.exponential_damping(*RATES), method=method)
    after = jaxrod.step(scene, state, DT)
    for field, rate in zip(("velocities", "angular_momenta"), RATES, strict=True):
        before, found = (np.asarray(getattr(s, field)) for s in (state, after))
        expected = before * np.exp(-rate * DT)
        size = np.max(np.abs(before))
        np.testing.assert_allclose(found, expected, atol=2e-3 * size)
