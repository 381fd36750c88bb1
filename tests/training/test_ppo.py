"""PPO learns, compiles once, and says what is wrong with its settings."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs.trivial import Trivial, TrivialParams
from jaxrod.training import PPOConfig, evaluate, train, train_seeds
from jaxrod.training.algorithms import ppo

SMALL = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)
QUICK = PPOConfig(
    num_envs=32, rollout_steps=64, epochs=4, minibatches=4, learning_rate=3e-3
)


@pytest.mark.default_precision
def test_trivial_task_is_learned_to_its_known_optimum():
    env = Trivial()
    result = train(env, steps=100_000, config=QUICK, progress=False)
    score = evaluate(env, result.policy, episodes=1000).mean
    assert env.optimal_return - 0.1 < score < env.optimal_return + 0.05
    assert result.summary["final_score"] > env.optimal_return - 1


@pytest.mark.slow
def test_learning_in_float64_stays_in_float64():
    result = train(
        Trivial(), steps=1024, config=SMALL, progress=False, evaluation_episodes=2
    )
    floating = [
        leaf.dtype
        for leaf in jax.tree.leaves(result.state)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    assert set(floating) == {jnp.dtype("float64")}


@pytest.mark.slow
def test_changed_numbers_recompile_nothing():
    env = Trivial()
    # Functions of this test alone: equal ones share a cache.
    init = jax.jit(lambda key, *rest: ppo.init(key, env, *rest))
    update = jax.jit(lambda state: ppo.update(state))
    numbers = {
        field.name: 0.5 * field.default
        for field in dataclasses.fields(PPOConfig)
        if isinstance(field.default, float)
    }
    first = init(jax.random.key(0), SMALL, TrivialParams(), 1000)
    other = init(
        jax.random.key(1),
        dataclasses.replace(SMALL, **numbers),
        TrivialParams(0.3, 1.5),
        2000,
    )
    state = update(first)[0]
    update(state)
    update(other)
    assert init._cache_size() == 1
    assert update._cache_size() == 1


@pytest.mark.slow
def test_start_may_be_traced_although_factories_look_at_their_numbers():
    class Checking(Trivial):
        def default_params(self):
            assert float(jnp.asarray(0.2)) > 0
            return super().default_params()

    states = jax.vmap(lambda key: ppo.init(key, Checking(), SMALL))(
        jax.random.split(jax.random.key(0), 2)
    )
    assert states.environments.observation.shape == (2, 8, 1)


@pytest.mark.slow
def test_learning_rate_falls_linearly_to_its_end():
    result = train(
        Trivial(),
        steps=128 * 10,
        config=SMALL,
        chunk_steps=1,
        progress=False,
        evaluation_episodes=0,
    )
    rates = [row["learning_rate"] for row in result.progress]
    expected = 5e-5 + (1e-3 - 5e-5) * (1 - np.arange(10) / 10)
    np.testing.assert_allclose(rates, expected, rtol=1e-6)


@pytest.mark.slow
def test_first_minibatch_has_ratio_one():
    config = dataclasses.replace(SMALL, epochs=1, minibatches=1)
    state = ppo.init(jax.random.key(0), Trivial(), config)
    for _ in range(3):
        state, metrics = jax.jit(ppo.update)(state)
        np.testing.assert_allclose(metrics.scalars["kl"], 0, atol=1e-12)
        assert metrics.scalars["clipped"] == 0


@pytest.mark.slow
def test_vectorised_seeds_equal_separate_runs():
    env, updates = Trivial(), 4
    states, metrics = train_seeds(env, steps=128 * updates, seeds=(3, 4), config=SMALL)
    update = jax.jit(ppo.update)
    for i, seed in enumerate((3, 4)):
        state = ppo.init(jax.random.key(seed), env, SMALL, None, 128 * updates)
        for j in range(updates):
            state, alone = update(state)
            for name, value in alone.scalars.items():
                np.testing.assert_allclose(
                    metrics[name][i, j], value, rtol=1e-6, atol=1e-12
                )
        for a, b in zip(
            jax.tree.leaves(states.weights), jax.tree.leaves(state.weights), strict=True
        ):
            np.testing.assert_allclose(a[i], b, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_envs", 0),
        ("rollout_steps", 0),
        ("epochs", 0),
        ("minibatches", 0),
        ("minibatches", 3),
        ("hidden_sizes", (64, 0)),
        ("learning_rate", -1e-3),
        ("final_learning_rate", 0.0),
        ("clip", float("nan")),
        ("discount", 1.5),
        ("trace_decay", -0.1),
        ("reward_scale", 0.0),
        ("value_weight", -1.0),
        ("entropy_weight", float("inf")),
        ("gradient_norm", 0.0),
        ("initial_log_std", float("nan")),
        ("observation_limit", -1.0),
    ],
)
def test_bad_setting_is_refused_by_name_and_value(name, value):
    config = dataclasses.replace(SMALL, **{name: value})
    with pytest.raises(ValueError, match=name) as refusal:
        train(Trivial(), steps=1000, config=config, progress=False)
    assert str(value) in str(refusal.value)


def test_environments_must_divide_among_the_devices():
    with pytest.raises(ValueError, match=r"num_envs must be a multiple.* 3, got 8"):
        ppo.validate(SMALL, 3)


def test_seeds_do_not_take_the_settings_of_another_algorithm():
    with pytest.raises(ValueError, match=r"be a SACConfig .* got PPOConfig"):
        train_seeds(Trivial(), "sac", steps=1000, config=SMALL)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 1000.5}, r"steps must be an integer, got 1000\.5"),
        ({"seeds": 3}, "seeds must be a sequence of integers, got 3"),
        ({"seeds": ()}, "seeds must hold at least one seed"),
        ({"seeds": (0, -1)}, "seeds must be an integer from 0"),
    ],
)
def test_seeds_that_cannot_be_run_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        train_seeds(Trivial(), **{"steps": 1000, "config": SMALL} | changes)
