"""`examples/own_effect.py` does what it says."""

import jax.numpy as jnp
import pytest

from examples.loading import load

own_effect = load("own_effect")


@pytest.mark.slow
def test_the_muscle_swings_the_arm_and_tires():
    tips, freshness = own_effect.simulate(seconds=0.2)
    assert jnp.max(jnp.abs(tips[:, 1])) > 0.02
    # Weaker by the square of the activation, which lags and is at most one.
    assert 0.82 < float(freshness) < 0.99


def test_without_strength_nothing_moves():
    tips, _ = own_effect.simulate(strength=0.0, seconds=0.05)
    assert float(jnp.max(jnp.abs(tips - tips[:1]))) == pytest.approx(0, abs=1e-12)
