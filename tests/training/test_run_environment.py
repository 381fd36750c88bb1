"""A run knows which environment it is of."""

from __future__ import annotations

import dataclasses

import pytest

from jaxrod.cli.runs import open_run
from jaxrod.envs import ActionRepeat, make
from jaxrod.envs.trivial import Trivial, TrivialParams
from jaxrod.files import with_tuples
from jaxrod.training import PPOConfig, RunFolder, train
from jaxrod.training.runs import loop
from jaxrod.training.runs.recorded_environment import described_environment
from jaxrod.training.runs.recorded_environment import recorded_environment as _origin

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


class Kept(Trivial):
    """Attributes are named after arguments, as most classes have them."""

    def __init__(self, length=5, start=(0, 0)):
        super().__init__(length)
        object.__setattr__(self, "length", length)
        object.__setattr__(self, "start", start)


class Renamed(Trivial):
    """An argument is kept under another name."""

    def __init__(self, length):
        super().__init__(length)


class Doubled(Kept):
    """An attribute is not what the argument was."""

    def __init__(self, length):
        super().__init__(2 * length)


@dataclasses.dataclass(frozen=True)
class Fields(Trivial):
    height: object = 0.5


@pytest.mark.parametrize(
    ("env", "options"),
    [
        (Kept(), {}),
        (Kept(7, (1, (2, 3))), {"length": 7, "start": [1, [2, 3]]}),
        (Fields(height=2), {"height": 2}),
        (Fields(7), {"episode_length": 7}),
        (Fields(height=[1]), None),
        (Fields(height=len), None),
        (Renamed(7), None),
        (Doubled(7), None),
    ],
)
def test_a_class_of_ones_own_is_recorded_if_it_makes_the_same_again(env, options):
    found = _origin(env)
    assert found["env_options"] == options
    if options is None:
        assert found["task"] == "trivial" and "environment" in found
        return
    assert found["task"] == f"{__name__}:{type(env).__name__}"
    again = {name: with_tuples(value) for name, value in options.items()}
    assert make(found["task"], **again) == env
    assert _origin(make(found["task"], **again)) == found


@pytest.mark.slow
@pytest.mark.default_precision
def test_an_object_that_make_did_not_make_trains_and_cannot_be_made_again(tmp_path):
    result = train(Trivial(7), out=tmp_path, steps=256, config=SMALL, progress=False)
    assert result.summary["task"] == "trivial"
    with pytest.raises(
        ValueError, match=r"does not say what makes .*Trivial\(episode_length=7"
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
def test_runs_of_when_a_class_was_only_described_go_on(tmp_path):
    settings = {"steps": 256, "config": SMALL, "progress": False, "out": tmp_path}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "recorded_environment", described_environment)
        before = train(Fields(7), **settings)
    assert RunFolder(tmp_path).config()["env_options"] is None
    assert train(Fields(7), resume=True, **settings).summary == before.summary
    with pytest.raises(ValueError, match=r"environment was .*=7.*, now .*=8"):
        train(Fields(8), resume=True, **settings)


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
    with pytest.raises(ValueError, match=r"env_params .*\.stride differs"):
        train(seven, **again)
    ended = train(seven, env_params=params, **again)
    assert ended.summary == begun.summary
