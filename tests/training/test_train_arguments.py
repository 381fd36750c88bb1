"""What `train` is asked for is recorded as it is, or refused in words."""

from __future__ import annotations

import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.envs.trivial import Trivial
from jaxrod.training import (
    PPOConfig,
    RunFolder,
    evaluate,
    train,
    train_seeds,
    untrained_policy,
)

SMALL = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)
QUIET = {"progress": False, "evaluation_episodes": 0}


@pytest.mark.slow
@pytest.mark.default_precision
def test_numbers_of_numpy_are_recorded_as_numbers(tmp_path):
    env = make("trivial", episode_length=np.int64(7))
    settings = {"config": SMALL, "out": tmp_path, **QUIET}
    train(env, steps=np.int64(256), seed=np.int64(3), **settings)
    config = RunFolder(tmp_path).config()
    assert (config["steps"], config["seed"]) == (256, 3)
    assert config["env_options"] == {"episode_length": 7}
    # What cannot be recorded does not cost the run that is there.
    with pytest.raises(TypeError, match="not JSON serializable"):
        unknown = make("trivial", name=object())
        train(unknown, steps=256, overwrite=True, **settings)
    assert RunFolder(tmp_path).config() == config


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"steps": 100}, "steps must be at least one update, 128 .* got 100"),
        ({"steps": 1e6}, "steps must be an integer, got 1000000.0"),
        ({"steps": 10**30}, "steps must be at most 2,147,483,647 updates of 128"),
        (
            {"config": PPOConfig(epochs=2**63)},
            "epochs must be at most 2147483647, got 9223372036854775808",
        ),
        (
            {"config": PPOConfig(hidden_sizes=(2**63,))},
            "each of hidden_sizes .* must be at most 2147483647",
        ),
        ({"seed": -1}, "seed must be an integer from 0 to 4294967295, got -1"),
        ({"seed": 2**32}, "seed must be .* got 4294967296"),
        ({"checkpoint_seconds": float("nan")}, "checkpoint_seconds .* got nan s"),
        ({"algorithm": "magic"}, "algorithm must be one of .*ppo.*; got 'magic'"),
        ({"score_window": 0}, "score_window .* got 0"),
        ({"evaluation_episodes": -1}, "evaluation_episodes .* got -1"),
        ({"chunk_steps": 0}, "chunk_steps .* got 0"),
        ({"devices": []}, "devices"),
        ({"config": 3}, "config must be a PPOConfig .* got int"),
        (
            {"config": PPOConfig(hidden_sizes=[8])},
            r"hidden_sizes .* tuple .* got \[8\]",
        ),
        (
            {"config": PPOConfig(hidden_sizes=(8.0,))},
            r"each of hidden_sizes \(8.0,\) must be an integer, got 8.0",
        ),
        (
            {"config": PPOConfig(rollout_steps=128.0)},
            "rollout_steps must be an integer, got 128.0",
        ),
        ({"resume": True}, "out=None"),
    ],
)
def test_bad_argument_is_refused_by_name_and_value(changes, words):
    arguments = {"steps": 256, "config": SMALL, "progress": False} | changes
    with pytest.raises(ValueError, match=words):
        train(Trivial(), **arguments)


@pytest.mark.parametrize("name", ["trivial", "reach.py:Reach"])
def test_name_of_a_task_is_answered_with_what_makes_it(name):
    words = f"must be an object, got '{name}': jaxrod.envs.make\\('{name}'\\) makes it"
    rest = lambda observation: 0 * observation
    for use in (
        lambda: train(name, steps=256),
        lambda: train_seeds(name, steps=256, seeds=[0]),
        lambda: evaluate(name, rest),
        lambda: untrained_policy(name),
    ):
        with pytest.raises(ValueError, match=words):
            use()


def test_class_of_a_task_is_answered_with_its_object():
    with pytest.raises(ValueError, match="must be an object, got the class"):
        train(Trivial, steps=256)


def test_resume_without_a_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no config\.json"):
        train(Trivial(), steps=256, config=SMALL, out=tmp_path, resume=True)
