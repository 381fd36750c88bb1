"""Policies as functions and as files."""

from __future__ import annotations

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs.trivial import Trivial
from jaxrod.training import (
    PPOConfig,
    SACConfig,
    evaluate,
    load_policy,
    save_policy,
    train,
    untrained_policy,
)
from jaxrod.training.algorithms import ppo, sac
from jaxrod.training.algorithms.on_policy import policy_network
from jaxrod.training.normalisation import RunningMoments, normalise


def some_state():
    config = PPOConfig(num_envs=4, rollout_steps=8, minibatches=2, hidden_sizes=(8, 8))
    return ppo.init(jax.random.key(0), Trivial(), config)


@pytest.mark.slow
def test_policy_is_the_median_or_the_mean_of_the_learners_distribution():
    state = some_state()
    policy = dataclasses.replace(ppo.PPO.policy(state), quiet_action="median")
    observation = jnp.linspace(-3, 3, 20)[:, None]
    mean, log_std = policy_network(state.env, state.config, observation.dtype).apply(
        {"params": state.weights["policy"]},
        normalise(state.moments, observation, state.config.observation_limit),
    )
    np.testing.assert_allclose(policy(observation), jnp.clip(mean, -1, 1), rtol=1e-12)
    drawn = np.random.default_rng(0).normal(size=(200_000, 1, 1))
    noisy = np.clip(mean[None] + np.exp(log_std) * drawn, -1, 1)
    found = ppo.PPO.policy(state)(observation)
    np.testing.assert_allclose(found, noisy.mean(axis=0), atol=1e-2)


@pytest.mark.parametrize("gru_units", [0, 4])
def test_a_policy_of_shapes_alone_is_not_evaluated(gru_units):
    policy = untrained_policy(Trivial(), config=PPOConfig(gru_units=gru_units))
    with pytest.raises(ValueError, match=r"policy must have numbers, .* seed=0"):
        evaluate(Trivial(), policy)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("activation", ["tanh", "relu", "elu"])
@pytest.mark.parametrize("output", ["clip", "tanh"])
def test_files_hold_exactly_the_policy(tmp_path, activation, output):
    random = np.random.default_rng(0)
    policy = ppo.PPO.policy(some_state())
    policy = type(policy)(
        moments=RunningMoments(
            jnp.asarray(10.0), random.normal(size=3), random.random(3)
        ),
        limit=jnp.asarray(5.0),
        layers=(
            (random.normal(size=(3, 7)), random.normal(size=7)),
            (random.normal(size=(7, 2)), random.normal(size=2)),
        ),
        activation=activation,
        output=output,
        action_repeat=3,
    )
    save_policy(policy, tmp_path / "policy", {"task": "none"})
    loaded = load_policy(tmp_path / "policy")
    observation = jnp.asarray(random.normal(size=(50, 3)))
    np.testing.assert_array_equal(loaded(observation), policy(observation))
    np.testing.assert_allclose(loaded(observation[0]), policy(observation)[0])
    assert jnp.all(jnp.abs(loaded(observation)) <= 1)
    description = json.loads((tmp_path / "policy" / "policy.json").read_text())
    assert description["about"] == {"task": "none"}
    assert (description["observation_size"], description["action_size"]) == (3, 2)
    assert loaded.action_repeat == 3


def test_policy_of_before_actions_were_held_decides_at_every_step(tmp_path):
    save_policy(ppo.PPO.policy(some_state()), tmp_path)
    description = json.loads((tmp_path / "policy.json").read_text())
    del description["action_repeat"]
    (tmp_path / "policy.json").write_text(json.dumps(description))
    assert load_policy(tmp_path).action_repeat == 1


def test_impossible_action_repeat_is_refused_where_it_is_read(tmp_path):
    policy = ppo.PPO.policy(some_state())
    save_policy(dataclasses.replace(policy, action_repeat=0), tmp_path)
    with pytest.raises(
        ValueError,
        match=r"policy\.json is damaged: 'action_repeat' must be a whole .* got 0",
    ):
        load_policy(tmp_path)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("learner", "init", "settings"),
    [(ppo.PPO, ppo.init, PPOConfig), (sac.SAC, sac.init, SACConfig)],
)
def test_policy_tells_for_how_long_its_actions_were_held(learner, init, settings):
    config = settings(num_envs=4, action_repeat=3, hidden_sizes=(8, 8))
    state = init(jax.random.key(0), Trivial(), config)
    assert learner.policy(state).action_repeat == 3


def test_folder_without_a_policy_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"policy\.json"):
        load_policy(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_the_untrained_policy_is_the_one_with_which_training_begins(name):
    env = Trivial()
    sizes = {"num_envs": 4, "rollout_steps": 8}
    if name == "ppo":
        config = PPOConfig(learning_rate=1e-30, final_learning_rate=1e-30, **sizes)
    else:
        config = SACConfig(learning_starts=10_000, **sizes)
    policy = untrained_policy(env, name, config, seed=3)
    run = {"steps": 64, "config": config, "evaluation_episodes": 0, "progress": False}
    trained = train(env, name, seed=3, **run).policy
    for mine, theirs in zip(policy.layers, trained.layers, strict=True):
        np.testing.assert_array_equal(mine[0], theirs[0])
    other = untrained_policy(env, name, config, seed=4)
    assert (other.layers[0][0] != policy.layers[0][0]).any()
    like = untrained_policy(env, name, config)
    assert jax.tree.structure(like) == jax.tree.structure(policy)


def test_the_seed_of_an_untrained_policy_is_checked():
    with pytest.raises(ValueError, match="seed must be"):
        untrained_policy(Trivial(), seed=-1)
