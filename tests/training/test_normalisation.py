"""Running moments against numpy on all data at once."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from jaxrod.training.normalisation import (
    batch_moments,
    merge_moments,
    no_moments,
    normalise,
)


@pytest.mark.fast_sets(1)
def test_merged_batches_have_the_moments_of_all_samples(dtype):
    random = np.random.default_rng(1)
    # Means far from zero compared with the spread: where naive sums fail.
    centre = np.array([0.0, 1000.0, -3.0])
    spread = np.array([1.0, 0.5, 20.0])
    sizes = (1, 7, 500, 4096)
    batches = [
        (centre + i + spread * random.normal(size=(size, 3))).astype(dtype)
        for i, size in enumerate(sizes)
    ]
    moments = no_moments(3, dtype)
    for batch in batches:
        moments = merge_moments(moments, batch_moments(batch))
    everything = np.concatenate(batches).astype(np.float64)
    tolerance = 1e-3 if dtype == np.float32 else 1e-11
    assert moments.mean.dtype == dtype
    assert float(moments.count) == sum(sizes)
    np.testing.assert_allclose(
        moments.mean, everything.mean(0), rtol=tolerance / 100, atol=tolerance
    )
    np.testing.assert_allclose(moments.variance, everything.var(0), rtol=tolerance)


def test_moments_stay_right_after_a_billion_float32_samples():
    batch = np.random.default_rng(2).normal(5.0, 2.0, (32768, 1)).astype(np.float32)
    one = batch_moments(batch)
    moments = jax.lax.fori_loop(
        0, 30_000, lambda _, m: merge_moments(m, one), no_moments(1, np.float32)
    )
    np.testing.assert_allclose(moments.mean, one.mean, rtol=1e-4)
    np.testing.assert_allclose(moments.variance, one.variance, rtol=1e-3)


def test_normalised_samples_have_mean_zero_and_variance_one(dtype):
    samples = np.random.default_rng(3).normal(3.0, 0.1, (1000, 4)).astype(dtype)
    result = np.asarray(normalise(batch_moments(samples), samples, 100.0))
    np.testing.assert_allclose(result.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(result.std(0), 1, atol=1e-3)


def test_nothing_seen_changes_nothing_and_constants_stay_finite():
    samples = np.random.default_rng(4).normal(size=(3, 5, 2))
    unchanged = normalise(no_moments(2, np.float64), samples, 100.0)
    np.testing.assert_allclose(unchanged, samples, rtol=1e-7)
    constant = np.full((10, 2), 7.0)
    np.testing.assert_array_equal(normalise(batch_moments(constant), constant, 5.0), 0)


def test_an_entry_that_never_varied_says_nothing():
    # A clamped end is still in simulation, and trembles in the eye of a camera.
    seen = np.random.default_rng(5).normal(size=(100, 2))
    seen[:, 0] = 0.3
    moments = merge_moments(batch_moments(seen[:40]), batch_moments(seen[40:]))
    shaken = normalise(moments, seen + 0.005, 10.0)
    np.testing.assert_array_equal(shaken[:, 0], 0)
    assert np.all(shaken[:, 1] != 0)


def test_result_is_clipped():
    samples = np.array([[1e6], [-1e6]])
    result = normalise(no_moments(1, np.float64), samples, 10.0)
    np.testing.assert_array_equal(result, [[10.0], [-10.0]])


def test_moments_over_a_mapped_axis_are_those_of_the_whole():
    samples = np.random.default_rng(5).normal(2.0, 3.0, (4, 100, 2))
    spread = jax.vmap(lambda part: batch_moments(part, "parts"), axis_name="parts")(
        samples
    )
    whole = batch_moments(samples.reshape(-1, 2))
    for a, b in zip(jax.tree.leaves(spread), jax.tree.leaves(whole), strict=True):
        for part in a:
            np.testing.assert_allclose(part, b, rtol=1e-12)
