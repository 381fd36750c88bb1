"""Noise has the statistics that it is given: 1e5 numbers, within five deviations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.sensors import noisy

DRAWS = 100_000


def drawn(seed, **noise):
    return np.asarray(noisy(jax.random.key(seed), jnp.full(DRAWS, 3.0), **noise))


def test_bias_and_deviation_are_those_of_the_draws():
    found = drawn(0, deviation=0.2, bias=-0.5)
    assert abs(np.mean(found) - 2.5) < 5 * 0.2 / np.sqrt(DRAWS)
    assert abs(np.std(found) - 0.2) < 5 * 0.2 / np.sqrt(2 * DRAWS)
    # Normal: the fourth moment is three times the square of the second.
    fourth = np.mean(((found - 2.5) / 0.2) ** 4)
    assert abs(fourth - 3) < 5 * np.sqrt(96 / DRAWS)
    # Independent from number to number.
    pairs = np.mean((found[1:] - 2.5) * (found[:-1] - 2.5)) / 0.04
    assert abs(pairs) < 5 / np.sqrt(DRAWS)


def test_readings_are_multiples_of_the_resolution_and_lose_its_variance():
    found = drawn(1, deviation=0.5, resolution=0.1)
    np.testing.assert_allclose(found / 0.1, np.round(found / 0.1), atol=1e-12)
    # Sheppard: a coarse grain adds the variance of a uniform distribution.
    variance = 0.25 + 0.1**2 / 12
    assert abs(np.var(found) - variance) < 5 * variance * np.sqrt(2 / DRAWS)


def test_numbers_are_lost_as_often_as_stated():
    found = drawn(2, dropout=0.3)
    lost = np.mean(np.isnan(found))
    assert abs(lost - 0.3) < 5 * np.sqrt(0.3 * 0.7 / DRAWS)
    np.testing.assert_array_equal(found[~np.isnan(found)], 3.0)


def test_without_noise_the_reading_is_unchanged_and_derivatives_pass():
    reading = jnp.asarray([0.3, -jnp.inf, 2.0])
    found = noisy(jax.random.key(3), reading)
    np.testing.assert_array_equal(found, reading)
    slope = jax.grad(
        lambda value: jnp.sum(noisy(jax.random.key(3), value, resolution=0.25))
    )(reading)
    np.testing.assert_array_equal(slope, [1, 0, 1])


def test_its_numbers_may_be_traced():
    key, reading = jax.random.key(5), jnp.linspace(0, 1, 6)
    numbers = {"deviation": 0.2, "bias": 0.1, "resolution": 0.05, "dropout": 0.3}
    traced = jax.jit(lambda given: noisy(key, reading, **given))(numbers)
    np.testing.assert_array_equal(traced, noisy(key, reading, **numbers))
    assert 0 < np.sum(np.isnan(traced)) < 6


def test_one_number_for_each_of_the_reading():
    found = noisy(jax.random.key(4), jnp.zeros((2, 3)), bias=jnp.ones((2, 3)))
    np.testing.assert_array_equal(found, 1)
    with pytest.raises(ValueError, match="dropout must be at most 1"):
        noisy(jax.random.key(4), jnp.zeros(3), dropout=1.5)
