"""How often policies lift the gripper's ball is counted as the program says."""

import argparse

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.lifted import run as lifted
from jaxrod.envs import make
from jaxrod.envs.tasks.gripper import LIFT, SLACK


def still(observation):
    """Neither pressure nor a way of the wrist."""
    assert observation.shape == (29,)
    return jnp.asarray([SLACK, 0.0, 0.0, 1.0])


@pytest.mark.slow
@pytest.mark.default_precision
def test_the_script_lifts_and_one_that_stays_does_not(monkeypatch):
    monkeypatch.setattr(lifted, "EPISODES", 3)
    env = make("gripper", lowered=0.0)
    returns, heights, flagged = lifted.played(env, None)
    assert heights.shape == (3,) and not np.any(flagged)
    assert np.all(heights >= LIFT) and np.all(returns > 40)
    returns, heights, flagged = lifted.played(env, still)
    assert not np.any(flagged)
    assert np.all(heights < 0) and np.all(returns < 5)


def test_it_prints_a_line_for_each_policy_and_start(monkeypatch, capsys):
    # Height of the first of two episodes, and whether a flag rose in it.
    shown = {None: (0.08, False), still: (0.01, True)}

    def played(env, policy):
        height, flagged = shown[policy]
        returns = jnp.asarray([1.0, 3.0]) + env.lowered
        return returns, jnp.asarray([height, 0.0]), jnp.asarray([flagged, False])

    monkeypatch.setattr(lifted.jaxrod, "configure_cpu", lambda: None)
    monkeypatch.setattr(lifted, "played", played)
    monkeypatch.setattr(lifted, "load_policy", {"RUN/policy": still}.get)
    assert lifted.run(argparse.Namespace(policies=["RUN/policy"])) == 0
    assert capsys.readouterr().out.splitlines() == [
        "scripted, lowered=0: return 2.0 ± 1.0, least 1.0, lifted 50%, flagged 0%",
        "RUN/policy, lowered=0: return 2.0 ± 1.0, least 1.0, lifted 0%, flagged 50%",
        "scripted, lowered=1: return 3.0 ± 1.0, least 2.0, lifted 50%, flagged 0%",
        "RUN/policy, lowered=1: return 3.0 ± 1.0, least 2.0, lifted 0%, flagged 50%",
    ]
