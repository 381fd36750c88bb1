"""Noise of the actions: its bound along a run, and policies that act with it."""

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
    evaluate,
    find_algorithm,
    load_policy,
    save_policy,
    train,
    untrained_policy,
    with_noise,
)
from jaxrod.training.algorithms import on_policy, ppo
from jaxrod.training.policy import MLPPolicy

SMALL = {
    "ppo": {"num_envs": 8, "rollout_steps": 16, "epochs": 1, "minibatches": 2},
    "trpo": {"num_envs": 8, "rollout_steps": 16},
    "shac": {"num_envs": 8, "rollout_steps": 16},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_the_bound_of_the_noise_falls_linearly(name):
    bounds = {"max_log_std": -1.0, "final_max_log_std": -3.0}
    config = find_algorithm(name).config_type(
        **SMALL[name], hidden_sizes=(4,), initial_log_std=0.0, **bounds
    )
    run = {"progress": False, "evaluation_episodes": 0, "chunk_steps": 1}
    per_update = find_algorithm(name).steps_per_update(config)
    result = train(Trivial(), name, steps=8 * per_update, config=config, **run)
    found = np.log([row["action_std"] for row in result.progress])
    # An update may move it from the bound at which it acted, by a little.
    np.testing.assert_allclose(found, -1 - 2 * np.arange(8) / 8, atol=0.2)
    assert np.ptp(found) > 1.5


@pytest.mark.parametrize("log_std", [-0.5, 1.9, 2.0])
def test_noise_below_the_bound_is_left_as_it_is(log_std):
    config = PPOConfig(**SMALL["ppo"], initial_log_std=log_std)
    state = ppo.init(jax.random.key(0), Trivial(), config)
    after = on_policy.with_bounded_noise(state)
    for a, b in zip(*map(jax.tree.leaves, (state.weights, after.weights)), strict=True):
        np.testing.assert_array_equal(a, b)


def quiet(output="clip", std=(0.1, 2.0), bias=(0.0, 0.5)):
    """A policy whose action does not depend on the observation."""
    like = untrained_policy(Trivial(), config=PPOConfig(hidden_sizes=()))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), like)
    return dataclasses.replace(
        zeros,
        limit=jnp.ones(()),
        layers=((jnp.zeros((1, 2)), jnp.asarray(bias)),),
        action_std=None if std is None else jnp.asarray(std),
        output=output,
        quiet_action="median",
    )


def acted(policy, seed, steps=2, batch=20_000):
    noisy, seen = with_noise(policy, seed), jnp.zeros((batch, 1))
    memory, actions = noisy.init(seen, None), []
    for _ in range(steps):
        action, memory = noisy.act(memory, seen, None)
        actions.append(action)
    return np.stack(actions)


@pytest.mark.parametrize("output", ["clip", "tanh"])
def test_noise_is_added_before_actions_are_bounded(output):
    policy = quiet(output)
    actions = acted(policy, 0)
    assert (np.abs(actions) <= 1).all()
    undone = np.arctanh(actions) if output == "tanh" else actions
    first = undone[..., 0]
    assert np.mean(first) == pytest.approx(0, abs=3e-3)
    assert np.std(first) == pytest.approx(0.1, rel=2e-2)
    # The probability of an action above zero: that of z > -0.25.
    share = np.mean(actions[..., 1] > 0)
    assert share == pytest.approx(0.5987, abs=1e-2)
    # Neither decisions nor episodes share their noise.
    assert abs(np.corrcoef(first[0], first[1])[0, 1]) < 0.03
    assert len(np.unique(first)) == first.size
    np.testing.assert_array_equal(acted(policy, 0), actions)
    assert (acted(policy, 1) != actions).any()


@pytest.mark.parametrize("output", ["clip", "tanh"])
@pytest.mark.parametrize("mean", [-2.0, -0.6, 0.0, 0.9])
def test_the_quiet_action_is_the_mean_of_the_noisy_ones(output, mean):
    policy = quiet(output, std=(0.4, 1.0), bias=(mean, mean))
    actions = acted(policy, 0)
    found = dataclasses.replace(policy, quiet_action="mean")(jnp.zeros(1))
    error = np.std(actions, axis=(0, 1)) / actions[..., 0].size ** 0.5
    assert (np.abs(actions.mean((0, 1)) - found) <= 4 * error + 1e-6).all()
    median = policy(jnp.zeros(1))
    np.testing.assert_allclose(np.median(actions, (0, 1)), median, atol=0.02)
    # Without noise in training both are the same.
    for std, atol in {(0.0, 0.0): 1e-7, (1e-4, 1e-4): 1e-4}.items():
        still = dataclasses.replace(
            policy, action_std=jnp.asarray(std), quiet_action="mean"
        )
        np.testing.assert_allclose(still(jnp.zeros(1)), median, rtol=0, atol=atol)


@pytest.mark.default_precision
@pytest.mark.parametrize(("output", "error"), {"clip": 1e-6, "tanh": 1e-5}.items())
def test_the_mean_action_equals_its_integral(output, error):
    z = np.linspace(-10, 10, 100_001)
    weights = np.exp(-(z**2) / 2) / np.sum(np.exp(-(z**2) / 2))
    bound = {"clip": lambda x: np.clip(x, -1, 1), "tanh": np.tanh}[output]
    for std in (1e-3, 0.1, 0.5, 1.0, 3.0):
        for mean in (-8.0, -1.0, -0.2, 0.0, 0.7, 1.0, 3.0, 8.0):
            policy = dataclasses.replace(
                quiet(output, (std, std), (mean, mean)), quiet_action="mean"
            )
            found = policy(jnp.zeros(1))
            wanted = np.sum(weights * bound(mean + std * z))
            # Two terms of the size of std cancel.
            np.testing.assert_allclose(found, wanted, rtol=0, atol=error * max(1, std))
            assert (np.abs(found) <= 1).all()


@pytest.mark.parametrize("std", [0.0, 0.5])
def test_gradients_of_the_mean_action_are_finite(std):
    policy = dataclasses.replace(quiet(std=(std, std)), quiet_action="mean")
    slopes = jax.grad(lambda policy: jnp.sum(policy(jnp.zeros(1))))(policy)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


@pytest.mark.parametrize("name", SMALL)
def test_runs_leave_the_quiet_action_of_their_settings(name):
    for action in ("mean", "median"):
        config = find_algorithm(name).config_type(**SMALL[name], quiet_action=action)
        policy = untrained_policy(Trivial(), name, config=config)
        assert policy.quiet_action == action


@pytest.mark.slow
def test_a_noisy_policy_keeps_what_the_quiet_one_has():
    config = PPOConfig(**SMALL["ppo"], gru_units=4, action_repeat=3)
    policy = ppo.PPO.policy(ppo.init(jax.random.key(0), Trivial(), config))
    silent = dataclasses.replace(policy, action_std=0 * policy.action_std)
    assert with_noise(policy).action_repeat == 3
    scores = [evaluate(Trivial(), p).mean for p in (silent, with_noise(silent))]
    assert scores[0] == scores[1] != evaluate(Trivial(), with_noise(policy)).mean


def test_files_hold_the_noise_and_older_ones_do_not(tmp_path):
    save_policy(quiet(), tmp_path / "new")
    loaded = load_policy(tmp_path / "new")
    np.testing.assert_array_equal(loaded.action_std, [0.1, 2.0])
    assert isinstance(loaded, MLPPolicy)
    save_policy(quiet(std=None), tmp_path / "old")
    assert "action_std" not in np.load(tmp_path / "old" / "policy.npz")
    assert load_policy(tmp_path / "old").action_std is None
    with pytest.raises(ValueError, match=r"policy must have an action_std, .* MLPPol"):
        with_noise(load_policy(tmp_path / "old"))
    for wrong, words in {(0.1,): "shape", (0.1, -2.0): "must not be negative"}.items():
        save_policy(quiet(std=wrong), tmp_path / "wrong")
        with pytest.raises(ValueError, match=f"'action_std' .*{words}"):
            load_policy(tmp_path / "wrong")


def test_files_hold_the_quiet_action_and_older_ones_have_the_median(tmp_path):
    mean = dataclasses.replace(quiet(), quiet_action="mean")
    save_policy(mean, tmp_path)
    assert load_policy(tmp_path).quiet_action == "mean"
    file = tmp_path / "policy.json"
    entries = json.loads(file.read_text())
    file.write_text(json.dumps(entries | {"quiet_action": "mode"}))
    with pytest.raises(ValueError, match="quiet_action"):
        load_policy(tmp_path)
    del entries["quiet_action"]
    file.write_text(json.dumps(entries))
    assert load_policy(tmp_path).quiet_action == "median"


@pytest.mark.parametrize("action", ["mean", "median"])
def test_files_of_policies_with_memory_hold_the_quiet_action(tmp_path, action):
    config = PPOConfig(**SMALL["ppo"], gru_units=4, quiet_action=action)
    policy = ppo.PPO.policy(ppo.init(jax.random.key(0), Trivial(), config))
    save_policy(policy, tmp_path)
    like = untrained_policy(Trivial(), config=PPOConfig(**SMALL["ppo"], gru_units=4))
    assert load_policy(tmp_path, like).quiet_action == action


def test_a_quiet_action_that_does_not_exist_is_refused():
    config = PPOConfig(quiet_action="mode")
    with pytest.raises(ValueError, match=r"quiet_action must be .* 'mean', got 'mode'"):
        train(Trivial(), steps=20_000, config=config, progress=False)
    policy = dataclasses.replace(quiet(), quiet_action="mode")
    with pytest.raises(ValueError, match=r"quiet_action must be .* got 'mode'"):
        policy(jnp.zeros(1))


def test_policies_with_memory_from_before_are_read_without_noise(tmp_path):
    config = PPOConfig(**SMALL["ppo"], gru_units=4)
    policy = ppo.PPO.policy(ppo.init(jax.random.key(0), Trivial(), config))
    save_policy(dataclasses.replace(policy, action_std=None), tmp_path)
    assert not any(
        "std" in name
        for name in json.loads((tmp_path / "policy.json").read_text())["leaves"]
    )
    like = untrained_policy(Trivial(), config=config)
    assert load_policy(tmp_path, like).action_std is None


@pytest.mark.parametrize("name", ["max_log_std", "final_max_log_std"])
def test_a_bound_that_is_no_number_is_refused(name):
    config = PPOConfig(**{name: float("nan")})
    with pytest.raises(ValueError, match=f"{name} must be finite, got nan"):
        train(Trivial(), steps=20_000, config=config, progress=False)


@pytest.mark.default_precision
@pytest.mark.parametrize("std", [0.0, 0.5, 7.0])
@pytest.mark.parametrize("mean", [1e3, 3e7, 1e9, np.inf])
def test_the_mean_action_far_outside_the_bounds_is_the_bound(std, mean):
    policy = dataclasses.replace(
        quiet(std=(std, std), bias=(mean, -mean)), quiet_action="mean"
    )
    np.testing.assert_array_equal(policy(jnp.zeros(1)), [1, -1])
