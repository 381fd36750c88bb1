"""`examples/moving_picture.py`: the tip is on its target."""

import jax.numpy as jnp
import pytest

from examples.loading import load


@pytest.mark.slow
def test_the_tip_reaches_the_target_and_stays():
    nodes, target, _, period = load("moving_picture").chase(seconds=0.6)
    away = jnp.linalg.norm(nodes[:, -1] - target, axis=-1)
    assert float(jnp.max(away[round(0.4 / period) :])) < 0.05
