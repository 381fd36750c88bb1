"""docs/algorithms.md tells every default, ours and the reference's."""

from __future__ import annotations

import dataclasses
import re

import pytest

from algorithms_page import DIFFERENT, SAME, settings_rows
from jaxrod.training import algorithm_names, find_algorithm

# Of Stable Baselines 2.10.1 as the paper ran it; 0 or 1 where it has no such thing.
OFF_POLICY = {"discount": 0.99, "noise_correlation": 0, "reward_scale": 1}
ACTOR_CRITIC = {
    "policy_learning_rate": 3e-4,
    "critic_learning_rate": 3e-4,
    "target_rate": 0.005,
}
REFERENCE = {
    "ppo": {
        "discount": 0.99,
        "trace_decay": 0.95,
        "clip": 0.2,
        "entropy_weight": 0.01,
        "epochs": 4,
        "learning_rate": 1e-3,
        "final_learning_rate": 0,
        "initial_log_std": 0,
        "reward_scale": 1,
    },
    "trpo": {
        "discount": 0.99,
        "trace_decay": 0.98,
        "max_kl": 0.01,
        "final_max_kl": 0.01,
        "conjugate_iterations": 10,
        "damping": 0.01,
        "fisher_stride": 5,
        "line_search_tries": 10,
        "line_search_shrink": 0.5,
        "entropy_weight": 0,
        "value_learning_rate": 3e-4,
        "value_epochs": 3,
        "initial_log_std": 0,
        "reward_scale": 1,
    },
    "sac": OFF_POLICY
    | ACTOR_CRITIC
    | {
        "temperature_learning_rate": 3e-4,
        "batch_size": 64,
        "learning_starts": 100,
        "rollout_steps": 1,
        "gradient_steps": 1,
        "entropy_per_action": -1,
        "initial_temperature": 1,
    },
    "td3": OFF_POLICY
    | ACTOR_CRITIC
    | {
        "batch_size": 128,
        "learning_starts": 50_000,
        "rollout_steps": 100,
        "gradient_steps": 100,
        "policy_delay": 2,
        "critics": 2,
        "target_noise": 0.2,
        "target_noise_limit": 0.5,
        "exploration_decay": 0,
    },
    "ddpg": OFF_POLICY
    | {
        "policy_learning_rate": 1e-4,
        "critic_learning_rate": 1e-3,
        "target_rate": 0.001,
        "batch_size": 128,
        "learning_starts": 0,
        "rollout_steps": 100,
        "gradient_steps": 50,
        "policy_delay": 1,
        "critics": 1,
        "target_noise": 0,
        "target_noise_limit": 0.5,
        "exploration_decay": 0,
    },
}


def of_all_cases():
    """(algorithms, setting, reference, ours) of both tables."""
    for algorithms, case, setting, reference, ours, _ in settings_rows(DIFFERENT):
        if case == "all":
            yield algorithms, setting, reference, ours
    for algorithms, setting, value in settings_rows(SAME):
        yield algorithms, setting, value, value


def told(name):
    """What the page says of one algorithm: (setting, reference, default)."""
    found = []
    for algorithms, setting, reference, ours in of_all_cases():
        names = algorithms.split(", ")
        if names == ["all"]:
            names = list(algorithm_names())
        if name in names:
            each = reference.split("; ")
            own = each[names.index(name)] if len(each) == len(names) else reference
            found.append((setting, own, ours))
    return found


def number(text):
    """The number a cell begins with, None if it begins with none."""
    match = re.match(r"-?\d[\d ]*(\.\d+)?(e-?\d+)?", text)
    return float(match[0].replace(" ", "")) if match else None


@pytest.mark.parametrize("name", algorithm_names())
def test_every_setting_is_documented_once_with_its_default(name):
    config = find_algorithm(name).config_type()
    defaults = {
        field.name: getattr(config, field.name) for field in dataclasses.fields(config)
    }
    assert sorted(setting for setting, _, _ in told(name)) == sorted(defaults)
    for setting, _, value in told(name):
        default = defaults[setting]
        if isinstance(default, bool):
            assert value == str(default).lower(), setting
        elif default is None:
            assert value == "default", setting
        elif isinstance(default, tuple):
            assert tuple(int(part) for part in value.split(",")) == default, setting
        else:
            assert float(value) == default, setting


@pytest.mark.parametrize("name", algorithm_names())
def test_the_reference_is_what_the_paper_ran(name):
    said = {setting: number(reference) for setting, reference, _ in told(name)}
    for setting, value in REFERENCE[name].items():
        assert said[setting] == value, setting
    as_there = {
        setting
        for algorithms, setting, _ in settings_rows(SAME)
        if name in algorithms.split(", ")
    }
    assert as_there <= set(REFERENCE[name])
