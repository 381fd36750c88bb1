"""Least squares of shared and own unknowns: all at once, and when it ends."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from jaxrod.control.identification.multiple_shooting import windowed_least_squares

TIMES = np.linspace(0, 2, 7)
PARTS = 3


def measured():
    """Decays of one size and rate from different heights, with noise."""
    random = np.random.default_rng(2)
    heights = np.array([1.0, 2.0, 0.5])
    exact = heights[:, None] * np.exp(-0.8 * TIMES) + 0.3
    return exact + 0.05 * random.normal(size=exact.shape)


def misses(shared, own, given):
    rate, rest = shared
    return {"miss": own["height"] * jnp.exp(-rate * TIMES) + rest - given}, own


def test_the_least_of_all_unknowns_is_found_and_then_it_ends():
    seen = measured()

    @jax.jit
    def solved(seen):
        return windowed_least_squares(
            misses,
            lambda shared, own, given: own,
            jnp.asarray([0.3, 0.0]),
            {"height": jnp.ones(PARTS)},
            {"height": jnp.ones((PARTS, 1))},
            seen[:, None],
            initial_damping=1e-3,
            lower=jnp.asarray([0.0, -5.0]),
            upper=jnp.asarray([9.0, 5.0]),
        )

    found = solved(jnp.asarray(seen))

    def all_at_once(unknowns):
        rate, rest, *heights = unknowns
        made = np.array(heights)[:, None] * np.exp(-rate * TIMES) + rest
        return (made - seen).ravel()

    expected = least_squares(
        all_at_once, [0.3, 0.0, 1, 1, 1], xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    np.testing.assert_allclose(found.solution, expected.x[:2], rtol=1e-5)
    np.testing.assert_allclose(found.own["height"], expected.x[2:], rtol=1e-5)
    np.testing.assert_allclose(found.residuals, expected.fun, atol=1e-5)
    # A few of the fifty points: the cost is not zero, but it no longer changes.
    assert 2 < int(found.iterations) < 15
