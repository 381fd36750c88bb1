"""Materials with memory in kernels: in lanes and in rows as in XLA."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes.choice import lane_choices, use_lanes
from lanes.scenes import forced
from physics.test_histories import LAWS, swinging


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["always", "loops", "rows"])
@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_kernels_take_materials_with_memory(law, mode):
    scene, state, dt = swinging(law)
    rates = 0.05 * np.random.default_rng(0).normal(size=(8, *state.velocities.shape))
    begun = jaxrod.with_memory(scene, state)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 8), begun)
    many = replace(many, velocities=jnp.asarray(rates))

    def after():
        return jax.vmap(lambda one: jaxrod.advance(scene, one, dt, 50))(many)

    forced(mode)
    found = after()
    assert lane_choices()[-1].taken
    use_lanes("never")
    for mine, other in zip(
        jax.tree.leaves(found), jax.tree.leaves(after()), strict=True
    ):
        np.testing.assert_allclose(mine, other, atol=1e-9)
