"""PyElastica's Laplace filter, step by step, on random rates."""

import jax.numpy as jnp
import numpy as np
import pytest
from elastica.dissipation import nb_filter_rate

import jaxrod
from jaxrod.rods.motion import Motion
from physics.rods import arm


@pytest.mark.fast_sets(2)
@pytest.mark.parametrize("order", [1, 3, 7])
def test_filtered_rates(order):
    rod, _ = arm(10)
    random = np.random.default_rng(order)
    velocity, spin = random.normal(size=(3, 11)), random.normal(size=(3, 10))
    motion = Motion(
        position=tuple(jnp.zeros((3, 11))),
        orientation=tuple(jnp.ones((4, 10))),
        velocity=tuple(jnp.asarray(velocity)),
        spin=tuple(jnp.asarray(spin)),
        spin_is_velocity=True,
    )
    effect = jaxrod.laplacian_filter(order)
    scene = jaxrod.make_scene(rod, effect, method=jaxrod.pyelastica())
    ours = effect.dissipate(scene, motion, jnp.asarray(1e-3))
    for rates in (velocity, spin):
        nb_filter_rate(rates, np.zeros_like(rates), order)
    np.testing.assert_allclose(jnp.stack(ours.velocity), velocity, atol=1e-14)
    np.testing.assert_allclose(jnp.stack(ours.spin), spin, atol=1e-14)
