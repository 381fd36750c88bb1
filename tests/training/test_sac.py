"""SAC learns, its density is a density, its temperature finds the entropy asked for."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs.trivial import Trivial, TrivialParams
from jaxrod.training import RunFolder, SACConfig, evaluate, train, train_seeds
from jaxrod.training.algorithms import sac
from jaxrod.training.algorithms.actor_critic import (
    critic_loss,
    critic_values,
    initial_critics,
)
from jaxrod.training.algorithms.replay import Transition
from jaxrod.training.algorithms.sac import tanh_gaussian
from jaxrod.training.runs.checkpoint import Checkpoints

SMALL = SACConfig(
    num_envs=4,
    rollout_steps=4,
    gradient_steps=4,
    batch_size=8,
    buffer_size=64,
    hidden_sizes=(8,),
    learning_starts=32.0,
)
UPDATE = jax.jit(lambda state: sac.update(state))
"""One program for all small runs of this file."""

TWO_DEVICES = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_rank_promotion", "raise")
from jaxrod.envs.trivial import Trivial
from jaxrod.training import SACConfig, train
config = SACConfig(
    num_envs=4, rollout_steps=4, gradient_steps=4, batch_size=8, buffer_size=64,
    hidden_sizes=(8,), learning_starts=32.0,
)
result = train(Trivial(), "sac", steps=16 * 8, config=config, chunk_steps=1,
               out=sys.argv[1], progress=False)
shards = result.state.replay.transitions.reward.addressable_shards
assert [shard.data.shape for shard in shards] == [(16, 2), (16, 2)]
"""

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
    initial_temperature=1.0,
    reward_scale=1.0,
    discount=0.9,
)


def assert_equal(left, right):
    """Every number of two states is the same, keys included."""
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def learned():
    with jax.enable_x64(False):
        return train(
            Trivial(), "sac", steps=30_000, config=QUICK, progress=False, chunk_steps=1
        )


@pytest.mark.slow
@pytest.mark.default_precision
def test_trivial_task_is_learned_to_its_known_optimum(learned):
    env = Trivial()
    score = evaluate(env, learned.policy, episodes=1000).mean
    assert env.optimal_return - 0.1 < score < env.optimal_return + 0.05
    assert learned.summary["final_score"] > env.optimal_return - 1


@pytest.mark.slow
def test_temperature_brings_the_entropy_to_its_target(learned):
    last = learned.progress[-30:]
    entropy = np.mean([row["entropy"] for row in last])
    assert entropy == pytest.approx(-1.0, abs=0.25)
    assert learned.progress[10]["entropy"] > entropy + 0.5


@pytest.mark.slow
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
    found, log_prob = tanh_gaussian(mean * ones, log_std * ones, noise[:, None])
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
    value, slope = jax.value_and_grad(lambda m: tanh_gaussian(m, zero, zero)[1][0])(
        mean
    )
    assert float(value) == pytest.approx(100 - 2 * np.log(2) - 0.918938, rel=1e-6)
    assert float(slope[0, 0]) == pytest.approx(2.0, rel=1e-6)


@pytest.fixture(scope="module")
def six_updates():
    """States of a small run, from before its first update to after its sixth."""
    reports = []
    with jax.enable_x64(True):
        states = [sac.init(jax.random.key(3), Trivial(), SMALL)]
        for _ in range(6):
            state, metrics = UPDATE(states[-1])
            states.append(state)
            reports.append(metrics.scalars)
    return states, reports


def test_what_follows_is_remembered_as_it_was_before_any_restart(six_updates):
    replay = six_updates[0][-1].replay
    assert (int(replay.written), len(replay.transitions.reward)) == (24, 16)
    # The ring has gone round one and a half times: the oldest first.
    memory = jax.tree.map(lambda leaf: np.roll(leaf, -8, axis=0), replay.transitions)
    restarted = memory.observation[1:] != memory.next_observation[:-1]
    # An episode has 20 steps: of 16 in a row most environments began one.
    assert np.array_equal(np.unique(np.sum(restarted, axis=0)), [0, 1])
    # The task ends an episode beyond its edge alone, not one that is cut short.
    lost = np.abs(memory.next_observation[..., 0]) > Trivial().default_params().edge
    assert np.array_equal(memory.terminated, lost)
    assert np.any(restarted[..., 0] & ~lost[:-1])
    moved = memory.observation + 0.2 * memory.action
    np.testing.assert_allclose(memory.next_observation, moved, atol=1e-12)
    np.testing.assert_allclose(memory.reward, 1 - moved[..., 0] ** 2, atol=1e-12)


def test_only_the_end_of_a_task_is_worth_nothing():
    critics = initial_critics(jax.random.key(0), Trivial(), SMALL, 2, jnp.float64)
    ends = jnp.array([False, True])
    ones = jnp.ones((2, 1))
    batch = Transition(ones, ones, jnp.array([3.0, 3.0]), ones, ends)
    value = critic_values(SMALL, critics, ones, ones)
    loss, _ = critic_loss(critics, SMALL, batch, jnp.array([10.0, 10.0]), 0.9)
    # Targets: 3 + 0.9 * 10 where the episode goes on, 3 where it ended.
    errors = (value - jnp.array([[12.0, 3.0]])) ** 2
    assert float(loss) == pytest.approx(float(0.5 * jnp.sum(jnp.mean(errors, 1))))


def test_a_restored_run_continues_bit_by_bit_with_its_memory(tmp_path, six_updates):
    states, _ = six_updates
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(3, states[3], {})
    state, _ = checkpoints.restore(states[0])
    for _ in range(3):
        state, _ = UPDATE(state)
    assert int(state.replay.written) == 24
    assert_equal(state, states[6])


@pytest.mark.slow
@pytest.mark.default_precision
def test_an_interrupted_run_resumes_bit_by_bit(tmp_path):
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
    assert_equal(whole.state, resumed.state)
    assert whole.summary["evaluation_score"] == resumed.summary["evaluation_score"]


@pytest.mark.slow
@pytest.mark.default_precision
def test_two_devices_train_the_same_as_one(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", TWO_DEVICES, str(tmp_path)]
    )
    one = train(
        Trivial(), "sac", steps=16 * 8, config=SMALL, chunk_steps=1, progress=False
    )
    assert process.wait(timeout=240) == 0
    rows = RunFolder(tmp_path).progress.read()
    for row, other in zip(one.progress, rows, strict=True):
        for name in ("critic_error", "value", "entropy", "temperature"):
            np.testing.assert_allclose(float(other[name]), row[name], rtol=1e-3)


@pytest.mark.slow
def test_vectorised_seeds_equal_separate_runs(six_updates):
    states, metrics = train_seeds(
        Trivial(), "sac", steps=16 * 6, seeds=(8, 3), config=SMALL
    )
    alone, reports = six_updates
    for j, report in enumerate(reports):
        for name, value in report.items():
            np.testing.assert_allclose(
                metrics[name][1, j], value, rtol=1e-6, atol=1e-12
            )
    for a, b in zip(
        jax.tree.leaves(states.learner), jax.tree.leaves(alone[-1].learner), strict=True
    ):
        np.testing.assert_allclose(a[1], b, rtol=1e-6, atol=1e-9)


def test_changed_numbers_recompile_nothing_and_float64_stays_float64(six_updates):
    numbers = {
        field.name: 0.5 * field.default
        for field in dataclasses.fields(SACConfig)
        if isinstance(field.default, float)
    }
    other = dataclasses.replace(SMALL, **numbers)
    before = UPDATE._cache_size()
    UPDATE(sac.init(jax.random.key(1), Trivial(), other, TrivialParams(0.3, 1.5)))
    assert UPDATE._cache_size() == before
    floating = {
        leaf.dtype
        for leaf in jax.tree.leaves(six_updates[0][-1])
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    assert floating == {jnp.dtype("float64")}


def test_policy_is_tanh_of_the_mean(six_updates):
    state = six_updates[0][-1]
    weights = state.learner.weights["policy"]
    policy = sac.SAC.policy(state)
    observation = jnp.linspace(-3, 3, 20)[:, None]
    seen = (observation - state.moments.mean[None]) / jnp.sqrt(state.moments.variance)[
        None
    ]
    hidden = jnp.maximum(
        seen @ weights["hidden_0"]["kernel"] + weights["hidden_0"]["bias"][None],
        0,
    )
    output = hidden @ weights["output"]["kernel"] + weights["output"]["bias"][None]
    np.testing.assert_allclose(
        policy(observation), jnp.tanh(output[:, :1]), rtol=1e-6, atol=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_noise_stays_as_similar_as_was_asked_for(correlation):
    config = dataclasses.replace(
        SMALL,
        num_envs=64,
        rollout_steps=30,
        batch_size=64,
        buffer_size=64 * 60,
        learning_starts=1e6,
        noise_correlation=correlation,
    )
    state = sac.init(jax.random.key(0), Trivial(), config)
    for _ in range(2):
        state, _ = UPDATE(state)
    # Acting at random is the distribution function of the noise.
    action = np.asarray(state.replay.transitions.action)[..., 0]
    noise = np.asarray(jax.scipy.special.erfinv(action)) * 2**0.5
    np.testing.assert_allclose(noise[-1], state.action_noise[:, 0], rtol=1e-6)
    # Standard errors of what follows: 0.03 and less, of one decision's 64 0.09.
    assert noise.std() == pytest.approx(1, abs=0.1)
    fresh = (noise[1:] - correlation * noise[:-1]) / (1 - correlation**2) ** 0.5
    assert fresh.std() == pytest.approx(1, abs=0.05)
    assert np.mean(noise[:-1] * fresh) == pytest.approx(0, abs=0.06)
    # The same from the first update to the second.
    assert fresh[29].std() == pytest.approx(1, abs=0.3)
    assert np.mean(noise[29] * fresh[29]) == pytest.approx(0, abs=0.4)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_envs", 0),
        ("gradient_steps", 0),
        ("batch_size", 6),
        ("buffer_size", 15),
        ("learning_starts", -1.0),
        ("target_rate", 1.5),
        ("noise_correlation", -0.1),
        ("noise_correlation", 1.0),
        ("initial_temperature", 0.0),
        ("policy_learning_rate", -1e-3),
        ("critic_learning_rate", float("nan")),
        ("entropy_per_action", float("inf")),
        ("entropy_per_action", 0.7),
    ],
)
def test_bad_setting_is_refused_by_name_and_value(name, value):
    config = dataclasses.replace(SMALL, **{name: value})
    with pytest.raises(ValueError, match=name) as refusal:
        train(Trivial(), "sac", steps=1000, config=config, progress=False)
    assert str(value) in str(refusal.value)
