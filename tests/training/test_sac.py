"""SAC learns, its density is a density, its temperature finds the entropy asked for."""

from __future__ import annotations

import dataclasses
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs.trivial import Trivial, TrivialParams
from jaxrod.training import SACConfig, evaluate, sac, train, train_seeds
from jaxrod.training.squashed_gaussian import squash

SMALL = SACConfig(
    num_envs=4,
    rollout_steps=4,
    gradient_steps=4,
    batch_size=8,
    buffer_size=64,
    hidden_sizes=(8,),
    learning_starts=32.0,
)
QUICK = SACConfig(
    num_envs=32,
    rollout_steps=8,
    gradient_steps=32,
    batch_size=128,
    buffer_size=20_000,
    hidden_sizes=(32, 32),
    learning_starts=1000.0,
    policy_learning_rate=3e-3,
    critic_learning_rate=3e-3,
    temperature_learning_rate=3e-3,
    discount=0.9,
)


@pytest.fixture(scope="module")
def learned():
    with jax.enable_x64(False):
        yield train(
            Trivial(), "sac", steps=30_000, config=QUICK, progress=False, chunk_steps=1
        )


@pytest.mark.default_precision
def test_trivial_task_is_learned_to_its_known_optimum(learned):
    env = Trivial()
    score = evaluate(env, learned.policy, episodes=1000).mean
    assert env.optimal_return - 0.1 < score < env.optimal_return + 0.05
    assert learned.summary["final_score"] > env.optimal_return - 1


def test_temperature_brings_the_entropy_to_its_target(learned):
    last = learned.progress[-30:]
    entropy = np.mean([row["entropy"] for row in last])
    assert entropy == pytest.approx(-1.0, abs=0.25)
    assert learned.progress[10]["entropy"] > entropy + 0.5


def test_nothing_is_learned_while_acting_at_random(learned):
    early = [row for row in learned.progress if row["env_steps"] <= 1024]
    assert [row["critic_error"] for row in early] == [0.0] * 4
    assert learned.progress[4]["critic_error"] > 0


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (1.3, -1.0), (-0.5, 0.7)])
def test_density_of_the_squashed_gaussian_integrates_to_probabilities(mean, log_std):
    # The density at given actions, from the noise that leads to them.
    edges = np.linspace(-1 + 1e-9, 1 - 1e-9, 400_001)
    action = 0.5 * (edges[1:] + edges[:-1])
    noise = (np.arctanh(action) - mean) / np.exp(log_std)
    ones = jnp.ones((len(action), 1))
    found, log_prob = squash(mean * ones, log_std * ones, noise[:, None])
    np.testing.assert_allclose(found[:, 0], action, atol=1e-12)
    mass = np.exp(np.asarray(log_prob)) * np.diff(edges)
    assert mass.sum() == pytest.approx(1, abs=1e-4)
    # P(a < 0.3) = P(u < artanh 0.3).
    score = (np.arctanh(0.3) - mean) / np.exp(log_std)
    below = float(jax.scipy.stats.norm.cdf(score))
    assert mass[action < 0.3].sum() == pytest.approx(below, abs=1e-4)


def test_density_stays_finite_where_tanh_is_flat():
    # log(1 - tanh(50)^2) = 2 (log 2 - 50) + ..., far below what float32 resolves.
    mean = jnp.full((1, 1), 50.0, jnp.float32)
    zero = jnp.zeros((1, 1), jnp.float32)
    value, slope = jax.value_and_grad(lambda m: squash(m, zero, zero)[1][0])(mean)
    assert float(value) == pytest.approx(100 - 2 * np.log(2) - 0.918938, rel=1e-6)
    assert float(slope[0, 0]) == pytest.approx(2.0, rel=1e-6)


class Truncating(Trivial):
    """Pays 1 in every step, whatever is done."""

    def step(self, key, state, action, params):
        observation, state, _, terminated, truncated, info = super().step(
            key, state, 0 * action, params
        )
        return observation, state, jnp.ones(()), terminated, truncated, info


@pytest.mark.default_precision
def test_time_limit_does_not_lower_the_value():
    # 1 / (1 - 0.9) = 10; with the time limit as an end it would be below 5 on average.
    config = dataclasses.replace(
        QUICK, initial_temperature=1e-6, learning_starts=0.0, target_rate=0.05
    )
    env = Truncating(episode_length=5)
    _, metrics = train_seeds(env, "sac", steps=256 * 40, seeds=(0,), config=config)
    assert float(metrics["value"][0, -1]) == pytest.approx(10, abs=0.3)


@pytest.mark.default_precision
def test_interrupted_run_resumes_bit_by_bit_with_its_memory(tmp_path):
    settings = {
        "steps": 16 * 12,
        "config": SMALL,
        "chunk_steps": 16,
        "progress": False,
        "evaluation_episodes": 2,
    }

    def interrupt(row):
        if row["env_steps"] == 16 * 7:
            signal.raise_signal(signal.SIGINT)

    whole = train(Trivial(), "sac", out=tmp_path / "whole", **settings)
    train(Trivial(), "sac", out=tmp_path / "part", log=interrupt, **settings)
    resumed = train(Trivial(), "sac", out=tmp_path / "part", resume=True, **settings)
    assert len(resumed.progress) == 5
    assert int(resumed.state.replay.written) == 48
    for a, b in zip(
        jax.tree.leaves(whole.state), jax.tree.leaves(resumed.state), strict=True
    ):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)
    assert whole.summary["evaluation_score"] == resumed.summary["evaluation_score"]


def test_vectorised_seeds_equal_separate_runs():
    env, updates = Trivial(), 6
    states, metrics = train_seeds(
        env, "sac", steps=16 * updates, seeds=(3, 4), config=SMALL
    )
    update = jax.jit(sac.update)
    for i, seed in enumerate((3, 4)):
        state = sac.init(jax.random.key(seed), env, SMALL)
        for j in range(updates):
            state, alone = update(state)
            for name, value in alone.scalars.items():
                np.testing.assert_allclose(
                    metrics[name][i, j], value, rtol=1e-6, atol=1e-12
                )
        for a, b in zip(
            jax.tree.leaves(states.learner), jax.tree.leaves(state.learner), strict=True
        ):
            np.testing.assert_allclose(a[i], b, rtol=1e-6, atol=1e-9)


def test_changed_numbers_recompile_nothing_and_float64_stays_float64():
    env = Trivial()
    # Functions of this test alone: equal ones share a cache.
    init = jax.jit(lambda key, *rest: sac.init(key, env, *rest))
    update = jax.jit(lambda state: sac.update(state))
    numbers = {
        field.name: 0.5 * field.default
        for field in dataclasses.fields(SACConfig)
        if isinstance(field.default, float)
    }
    state = update(init(jax.random.key(0), SMALL, TrivialParams(), 1000))[0]
    update(state)
    other = dataclasses.replace(SMALL, **numbers)
    update(init(jax.random.key(1), other, TrivialParams(0.3, 1.5), 2000))
    assert init._cache_size() == 1
    assert update._cache_size() == 1
    floating = {
        leaf.dtype
        for leaf in jax.tree.leaves(state)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    assert floating == {jnp.dtype("float64")}


def test_policy_is_tanh_of_the_mean():
    state = sac.init(jax.random.key(0), Trivial(), SMALL)
    weights = jax.tree.map(lambda w: w + 0.3, state.learner.weights["policy"])
    learner = dataclasses.replace(
        state.learner, weights=state.learner.weights | {"policy": weights}
    )
    policy = sac.SAC.policy(dataclasses.replace(state, learner=learner))
    observation = jnp.linspace(-3, 3, 20)[:, None]
    hidden = jnp.maximum(
        observation @ weights["hidden_0"]["kernel"] + weights["hidden_0"]["bias"][None],
        0,
    )
    output = hidden @ weights["output"]["kernel"] + weights["output"]["bias"][None]
    np.testing.assert_allclose(
        policy(observation), jnp.tanh(output[:, :1]), rtol=1e-6, atol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_envs", 0),
        ("gradient_steps", 0),
        ("batch_size", 6),
        ("buffer_size", 15),
        ("learning_starts", -1.0),
        ("target_rate", 1.5),
        ("initial_temperature", 0.0),
        ("policy_learning_rate", -1e-3),
        ("critic_learning_rate", float("nan")),
        ("entropy_per_action", float("inf")),
    ],
)
def test_bad_setting_is_refused_by_name_and_value(name, value):
    config = dataclasses.replace(SMALL, **{name: value})
    with pytest.raises(ValueError, match=name) as refusal:
        train(Trivial(), "sac", steps=1000, config=config, progress=False)
    assert str(value) in str(refusal.value)
