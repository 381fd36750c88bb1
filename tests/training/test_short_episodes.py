"""Episodes that are cut short in the first part of a run."""

import dataclasses

import jax
import pytest

from jaxrod.envs.trivial import Trivial
from jaxrod.training import find_algorithm, train
from jaxrod.training.algorithms.preparation import restart_phase


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize(
    "algorithm", [pytest.param("ppo", marks=pytest.mark.slow), "td3"]
)
def test_only_whole_episodes_are_scored(algorithm):
    sizes = {"num_envs": 8, "rollout_steps": 16, "short_steps": 1000.0}
    if algorithm == "td3":
        sizes |= {"buffer_size": 512, "gradient_steps": 2}
    config = find_algorithm(algorithm).config_type(short_length=5.0)
    with jax.enable_x64(False):
        found = train(
            # Nothing ends before the time is up.
            Trivial(episode_length=9),
            algorithm,
            steps=2048,
            config=dataclasses.replace(config, **sizes),
            progress=False,
        )
    assert set(found.episodes.lengths) == {9}
    # 1024 control steps are of short episodes; what runs then goes on, uncounted.
    assert 8 * 13 <= len(found.episodes) <= 8 * 14


def test_episodes_are_short_until_so_many_control_steps_are_done():
    env = Trivial(episode_length=20)
    config = find_algorithm("sac").config_type(
        num_envs=10, rollout_steps=5, action_repeat=2, short_steps=1000, short_length=5
    )
    assert [int(restart_phase(env, config, k)) for k in (0, 9, 10)] == [15, 15, 0]
    longer = dataclasses.replace(config, short_length=50.0)
    assert int(restart_phase(env, longer, 0)) == 0
    # More control steps than 32 bits count.
    assert int(restart_phase(env, config, 2**30)) == 0
