"""A run knows which environment it is of."""

from __future__ import annotations

import dataclasses

import pytest

from jaxrod.cli.runs import open_run
from jaxrod.envs import ActionRepeat, make
from jaxrod.envs.trivial import Trivial, TrivialParams
from jaxrod.training import PPOConfig, train
from jaxrod.training.runs.loop import _origin

SMALL = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)


def test_what_make_was_given_is_what_is_recorded():
    for name, given, recorded in [
        ("trivial", {}, {}),
        ("trivial", {"episode_length": 7}, {"episode_length": 7}),
        ("trivial", {"episode_length": 20}, {}),
        ("tracking", {}, {"variant": "paper"}),
        ("tracking", {"n_elements": 20}, {"n_elements": 20, "variant": "paper"}),
        ("reaching", {"variant": "clean", "substeps": 3}, None),
        ("structured", {"variant": "clean", "controls": 4}, None),
        ("structured", {"controls": None}, {"variant": "paper"}),
        ("unstructured", {"variant": "paper", "nest": 5, "n_elements": 30}, None),
    ]:
        env = make(name, **given)
        found = _origin(env)
        assert found["task"] == name
        assert found["env_options"] == (given if recorded is None else recorded)
        assert found["variant"] == found["env_options"].get("variant")
        assert make(name, **found["env_options"]) == env


def test_an_environment_that_make_did_not_make_is_not_said_to_be_made_by_it():
    made = make("tracking", variant="clean")
    for env in (ActionRepeat(made, 3), dataclasses.replace(made, n_elements=10)):
        found = _origin(env)
        assert found["env_options"] is None
        assert found["environment"] == f"{type(env).__module__}: {env!r}"
    # Equal to one that make made, and yet not that one.
    assert _origin(dataclasses.replace(made))["env_options"] is None
    assert _origin(made)["env_options"] == {"variant": "clean"}


def test_what_is_recorded_of_an_object_is_the_same_in_every_process():
    class Plain(Trivial):
        __repr__ = object.__repr__

    assert " at 0x" not in _origin(Plain())["environment"]


@pytest.mark.slow
@pytest.mark.default_precision
def test_an_object_that_make_did_not_make_trains_and_cannot_be_made_again(tmp_path):
    result = train(Trivial(7), out=tmp_path, steps=256, config=SMALL, progress=False)
    assert result.summary["task"] == "trivial"
    with pytest.raises(
        ValueError, match=r"make did not make .*Trivial\(episode_length=7"
    ):
        open_run(tmp_path)


@pytest.mark.slow
@pytest.mark.default_precision
def test_runs_of_when_a_task_was_a_case_are_read_and_go_on(tmp_path):
    settings = {"steps": 256, "config": SMALL, "progress": False, "out": tmp_path}
    before = train(make("trivial"), **settings)
    for name in ("config.json", "policy/policy.json"):
        text = (tmp_path / name).read_text()
        assert '"task"' in text
        (tmp_path / name).write_text(text.replace('"task"', '"case"'))
    assert open_run(tmp_path).config["task"] == "trivial"
    assert open_run(tmp_path).policy()
    assert train(make("trivial"), resume=True, **settings).summary == before.summary


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_run_goes_on_in_the_environment_it_was_started_in(tmp_path):
    settings = {"steps": 256, "config": SMALL, "progress": False}
    params = TrivialParams(stride=0.3, edge=1.5)
    seven = make("trivial", episode_length=7)
    begun = train(seven, env_params=params, out=tmp_path, **settings)
    again = {"out": tmp_path, "resume": True, **settings}
    with pytest.raises(
        ValueError, match=r"env_options\.episode_length was 7, now None"
    ):
        train(make("trivial"), env_params=params, **again)
    with pytest.raises(ValueError, match=r"env_options was .*, now None, environment"):
        train(Trivial(7), env_params=params, **again)
    with pytest.raises(ValueError, match=r"env_params .*\.stride is another"):
        train(seven, **again)
    ended = train(seven, env_params=params, **again)
    assert ended.summary == begun.summary
