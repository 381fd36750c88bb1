"""The examples of an algorithm and a network of one's own: trained, resumed, evaluated.

They are found from a run's folder by their import paths alone, as users' are.
"""

from __future__ import annotations

import importlib
import json
import signal
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxrod
from jaxrod import cli
from jaxrod.envs import make
from jaxrod.training import (
    NetworkPolicy,
    PPOConfig,
    evaluate,
    load_policy,
    restore_policy,
    train,
    untrained_policy,
)

EXAMPLES = Path(__file__).parents[2] / "examples"
pytestmark = pytest.mark.default_precision


@pytest.fixture
def example(monkeypatch):
    """Imports an example as a user's module."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


@pytest.fixture
def command(monkeypatch, capsys):
    """Calls a command that must succeed: its stdout."""
    # JAX has long started here, too late for CPU settings.
    monkeypatch.setattr(jaxrod, "configure_cpu", lambda devices=None: None)

    def call(*words):
        code = cli.main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert code == 0, err
        return out

    return call


def leaves(tree):
    return [
        np.asarray(jax.random.key_data(leaf) if str(leaf.dtype)[:3] == "key" else leaf)
        for leaf in jax.tree.leaves(tree)
    ]


def assert_same(left, right):
    for a, b in zip(leaves(left), leaves(right), strict=True):
        np.testing.assert_array_equal(a, b)


def whole_and_interrupted(folder, algorithm, steps, config):
    """A run that went through, and one that was stopped half-way."""

    def interrupt(row):
        if row["env_steps"] >= steps // 2:
            signal.raise_signal(signal.SIGINT)

    settings = {"steps": steps, "config": config, "progress": False}
    settings["evaluation_episodes"] = 0
    whole = train(make("trivial"), algorithm, out=folder / "whole", **settings)
    part = train(
        make("trivial"), algorithm, out=folder / "part", log=interrupt, **settings
    )
    assert part.summary["status"] == "interrupted"
    return whole, settings


@pytest.mark.slow
def test_an_algorithm_of_ones_own_learns_and_resumes_bit_by_bit(tmp_path, example):
    search, env = example("own_algorithm").RANDOM_SEARCH, make("trivial")
    whole, settings = whole_and_interrupted(tmp_path, search, 32_000, None)
    resumed = train(env, search, out=tmp_path / "part", resume=True, **settings)
    assert len(resumed.progress) == 1
    assert_same(whole.state, resumed.state)
    assert whole.episodes.returns == resumed.episodes.returns
    with pytest.raises(ValueError, match="--trust own_algorithm"):
        restore_policy(tmp_path / "part", env)
    stored = restore_policy(tmp_path / "part", env, trust=("own_algorithm",))
    assert_same(whole.policy, stored)
    assert whole.summary["final_score"] > env.optimal_return - 0.7
    assert evaluate(env, whole.policy, episodes=200).mean > env.optimal_return - 0.4


@pytest.mark.slow
def test_an_algorithm_of_ones_own_is_found_by_its_import_path(
    tmp_path, example, command
):
    example("own_algorithm")
    path, folder = "own_algorithm:RANDOM_SEARCH", tmp_path / "run"
    words = ["train", "trivial", "--algorithm", path, "--out", folder]
    words += ["--steps", "12k", "--set", "spread=0.4", "--json"]
    summary = json.loads(command(*words))
    assert summary["algorithm"] == path
    assert json.loads((folder / "config.json").read_text())["settings"] == {
        "population": 64,
        "episode_steps": 20,
        "spread": 0.4,
    }
    trust = ("--trust", "own_algorithm", "--json")
    found = json.loads(command("evaluate", folder, "--episodes", 5, *trust))
    policy = restore_policy(folder, make("trivial"), trust=("own_algorithm",))
    scores = evaluate(make("trivial"), policy, episodes=5, seed=1).returns
    assert found["returns"] == scores.tolist()
    words = ("train", "trivial", "--resume", "--out", folder)
    assert json.loads(command(*words, *trust)) == summary
    # Typed once more, it needs no other word.
    typed = ("--algorithm", path, "--json")
    assert json.loads(command(*words, *typed)) == summary


@pytest.mark.slow
def test_a_network_of_ones_own_trains_and_resumes_bit_by_bit(
    tmp_path, example, command
):
    config = PPOConfig(
        num_envs=8,
        rollout_steps=16,
        epochs=2,
        minibatches=2,
        network=example("own_network").residual,
    )
    whole, _ = whole_and_interrupted(tmp_path, "ppo", 32_000, config)
    part = tmp_path / "part"
    settings = json.loads((part / "config.json").read_text())["settings"]
    assert settings["network"] == "own_network:residual"
    # All that is known of the network is its import path.
    trust = ("--trust", "own_network", "--json")
    words = ("train", "trivial", "--resume", "--out", part, *trust)
    resumed = json.loads(command(*words))
    assert resumed["final_score"] == whole.summary["final_score"]
    stored = restore_policy(part, make("trivial"), trust=("own_network",))
    assert isinstance(stored, NetworkPolicy) and "LayerNorm_0" in stored.weights
    assert_same(whole.policy, stored)
    words = ("evaluate", part, "--episodes", 16, "--seed", 0, *trust)
    assert json.loads(command(*words))["score"] == resumed["evaluation_score"]
    assert resumed["evaluation_score"] > make("trivial").optimal_return - 1
    with pytest.raises(ValueError, match=r"not a multilayer perceptron: .*like="):
        load_policy(part / "policy")
    with pytest.raises(ValueError, match=r"policy\.npz is of another .* it lacks"):
        load_policy(part / "policy", untrained_policy(make("trivial"), "ppo"))


@pytest.mark.parametrize("name", ["own_algorithm", "own_network"])
def test_an_example_is_short_and_uses_public_names_only(name):
    text = (EXAMPLES / f"{name}.py").read_text()
    assert len(text.splitlines()) <= 60
    imported = [line for line in text.splitlines() if "jaxrod" in line.split("#")[0]]
    rooms = {line.split()[1] for line in imported if line.startswith("from")}
    assert rooms <= {"jaxrod", "jaxrod.envs", "jaxrod.extend", "jaxrod.training"}
