"""TRPO's pieces against explicit matrices; its bound holds; it learns."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.stats import norm

from jaxrod.envs.trivial import Trivial
from jaxrod.training import TRPOConfig, evaluate, train, train_seeds
from jaxrod.training.algorithms import trpo
from jaxrod.training.algorithms.on_policy import log_density
from jaxrod.training.algorithms.trpo import (
    backtrack,
    conjugate_gradient,
    fisher_product,
    longest_step,
    mean_divergence,
)
from jaxrod.training.networks import GaussianPolicy, MultilayerPerceptron

SMALL = TRPOConfig(
    num_envs=8,
    rollout_steps=16,
    value_epochs=2,
    value_minibatches=2,
    hidden_sizes=(8,),
    fisher_stride=1,
)
UPDATE = jax.jit(lambda state: trpo.update(state))
"""One program for all small runs of this file."""

QUICK = TRPOConfig(
    num_envs=32,
    rollout_steps=64,
    hidden_sizes=(32, 32),
    discount=0.9,
    trace_decay=0.95,
    value_learning_rate=3e-3,
    max_kl=0.03,
    final_max_kl=0.01,
)


def test_entropy_is_that_of_independent_normals():
    spread = np.array([0.2, 1.0, 3.0])
    found = trpo.gaussian_entropy(jnp.log(spread))
    np.testing.assert_allclose(found, norm(scale=spread).entropy().sum(), rtol=1e-6)


def test_the_density_is_that_of_independent_normals():
    spread = np.array([0.2, 1.0, 3.0])
    standardised = np.linspace(-3, 4, 12).reshape(2, 2, 3)
    found = log_density(jnp.asarray(standardised), jnp.log(spread))
    wanted = norm(scale=spread).logpdf(standardised * spread).sum(axis=-1)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


@pytest.fixture(scope="module")
def learned():
    with jax.enable_x64(False):
        return train(
            Trivial(),
            "trpo",
            steps=150_000,
            config=QUICK,
            progress=False,
            chunk_steps=1,
        )


@pytest.mark.slow
@pytest.mark.default_precision
def test_trivial_task_is_learned_to_its_known_optimum(learned):
    env = Trivial()
    score = evaluate(env, learned.policy, episodes=1000).mean
    assert env.optimal_return - 0.1 < score < env.optimal_return + 0.05
    assert learned.summary["final_score"] > env.optimal_return - 1


@pytest.mark.slow
@pytest.mark.default_precision
def test_every_step_keeps_the_bound_and_improves_the_surrogate(learned):
    bounds = [row["max_kl"] for row in learned.progress]
    np.testing.assert_allclose(bounds[0], 0.03, rtol=1e-6)
    # The last update starts a little before the end of the way to 0.01.
    np.testing.assert_allclose(bounds[-1], 0.01, rtol=2 / len(bounds))
    np.testing.assert_allclose(np.diff(bounds), (0.01 - 0.03) / len(bounds), rtol=1e-3)
    for row in learned.progress:
        assert 0 <= row["kl"] <= row["max_kl"] * (1 + 1e-5)
        if row["accepted"]:
            assert row["policy_gain"] > 0
        else:
            assert row["kl"] == 0 and row["policy_gain"] == 0
    accepted = np.mean([row["accepted"] for row in learned.progress])
    assert accepted > 0.9
    # The step goes to the edge, not somewhere inside.
    assert np.median([row["kl"] for row in learned.progress]) > 0.003


def tiny_policy():
    """A policy of 19 weights, its outputs at some observations, and the Hessian."""
    mean = MultilayerPerceptron((3,), 2, output_scale=0.01, dtype=jnp.float64)
    network = GaussianPolicy(mean, 2, initial_log_std=-0.4, dtype=jnp.float64)
    keys = jax.random.split(jax.random.key(0), 3)
    observation = jax.random.normal(keys[0], (50, 2))
    start, as_weights = ravel_pytree(network.init(keys[1], observation)["params"])
    start = start + 0.3 * jax.random.normal(keys[2], start.shape)

    def outputs(parameters):
        return network.apply({"params": as_weights(parameters)}, observation)

    old = outputs(start)
    hessian = jax.jit(jax.hessian(lambda p: mean_divergence(*old, *outputs(p))))(start)
    return outputs, start, hessian


@pytest.mark.slow
def test_fisher_product_is_that_of_the_explicit_matrix():
    outputs, start, hessian = tiny_policy()
    matrix = jax.jit(
        lambda p: jax.vmap(fisher_product(outputs, p))(jnp.eye(start.size))
    )(start)
    assert start.size == 19
    np.testing.assert_allclose(matrix, hessian, rtol=1e-9, atol=1e-12)


def test_divergence_is_that_of_normal_distributions():
    means = jnp.array([[0.3, -0.2]]), jnp.array([[0.1, 0.4]])
    log_stds = jnp.array([0.2, -0.5]), jnp.array([-0.1, 0.3])
    x = jnp.linspace(-15, 15, 60_001)
    expected = 0.0
    for i in range(2):
        p, q = (
            jax.scipy.stats.norm.logpdf(x, mean[0, i], jnp.exp(log_std[i]))
            for mean, log_std in zip(means, log_stds, strict=True)
        )
        expected += float(jnp.sum(jnp.exp(p) * (p - q)) * (x[1] - x[0]))
    found = mean_divergence(means[0], log_stds[0], means[1], log_stds[1])
    assert float(found) == pytest.approx(expected, rel=1e-8)


def test_small_divergences_keep_their_digits_in_float32():
    zero = jnp.zeros((1, 1), jnp.float32)
    for change in (1e-1, 1e-3, 1e-5):
        found = mean_divergence(zero, zero[0], zero, zero[0] + change)
        # (e^(-2c) - 1 + 2c) / 2 of which a naive sum keeps no digit at 1e-5.
        expected = change**2 - 2 * change**3 / 3 + change**4 / 3
        assert float(found) == pytest.approx(expected, rel=0.02)


def test_conjugate_gradients_solve_in_as_many_steps_as_there_are_unknowns():
    random = np.random.default_rng(0)
    root = random.normal(size=(6, 6))
    matrix = jnp.asarray(root @ root.T + np.eye(6))
    right = jnp.asarray(random.normal(size=6))
    for scale in (1e-12, 1.0, 1e12):
        found = conjugate_gradient(lambda v: matrix @ v, scale * right, 6, 1e-24)
        np.testing.assert_allclose(
            found, scale * np.linalg.solve(matrix, right), rtol=1e-8
        )
    # More steps than unknowns, and nothing to solve, do no harm.
    found = conjugate_gradient(lambda v: matrix @ v, right, 60)
    np.testing.assert_allclose(matrix @ found, right, rtol=1e-4, atol=1e-4)
    assert not np.any(conjugate_gradient(lambda v: matrix @ v, 0 * right, 5))


def test_longest_step_ends_on_the_bound():
    matrix = jnp.diag(jnp.array([1.0, 4.0, 9.0]))
    step = longest_step(lambda v: matrix @ v, jnp.array([1.0, -2.0, 0.5]), 0.02)
    assert float(0.5 * step @ matrix @ step) == pytest.approx(0.02, rel=1e-12)
    assert not np.any(longest_step(lambda v: matrix @ v, jnp.zeros(3), 0.02))


def test_line_search_takes_the_first_length_that_will_do_or_stays():
    start, step = jnp.array([1.0]), jnp.array([8.0])
    found = backtrack(lambda x: x[0] <= 3.5, start, step, 0.5, 10)
    assert float(found.point[0]) == 3.0 and int(found.backtracks) == 2
    assert bool(found.accepted)
    never = backtrack(lambda x: x[0] < 1, start, step, 0.5, 4)
    assert not bool(never.accepted) and float(never.point[0]) == 1.0


@pytest.mark.slow
def test_vectorised_seeds_equal_separate_runs():
    states, metrics = train_seeds(
        Trivial(), "trpo", steps=128 * 3, seeds=(8, 3), config=SMALL
    )
    state = trpo.init(jax.random.key(3), Trivial(), SMALL)
    for j in range(3):
        state, alone = UPDATE(state)
        for name, value in alone.scalars.items():
            np.testing.assert_allclose(
                metrics[name][1, j], value, rtol=1e-5, atol=1e-10
            )
    for a, b in zip(
        jax.tree.leaves(states.weights), jax.tree.leaves(state.weights), strict=True
    ):
        np.testing.assert_allclose(a[1], b, rtol=1e-5, atol=1e-8)


@pytest.mark.slow
def test_changed_numbers_recompile_nothing_and_float64_stays_float64():
    numbers = {
        field.name: 0.5 * field.default
        for field in dataclasses.fields(TRPOConfig)
        if isinstance(field.default, float)
    }
    state = UPDATE(trpo.init(jax.random.key(0), Trivial(), SMALL))[0]
    other = dataclasses.replace(SMALL, **numbers)
    UPDATE(trpo.init(jax.random.key(1), Trivial(), other))
    assert UPDATE._cache_size() == 1
    floating = {
        leaf.dtype
        for leaf in jax.tree.leaves(state)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    assert floating == {jnp.dtype("float64")}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_envs", 0),
        ("conjugate_iterations", 0),
        ("fisher_stride", 0),
        ("line_search_tries", 0),
        ("line_search_shrink", 0.0),
        ("line_search_shrink", 1.5),
        ("value_minibatches", 3),
        ("value_epochs", 0),
        ("max_kl", 0.0),
        ("final_max_kl", 0.0),
        ("damping", -1.0),
        ("value_learning_rate", float("nan")),
    ],
)
def test_bad_setting_is_refused_by_name_and_value(name, value):
    config = dataclasses.replace(SMALL, **{name: value})
    with pytest.raises(ValueError, match=name) as refusal:
        train(Trivial(), "trpo", steps=1000, config=config, progress=False)
    assert str(value) in str(refusal.value)
