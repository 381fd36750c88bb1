"""A run knows which environment it is of."""

from __future__ import annotations

import pytest

from jaxrod.envs import ActionRepeat, make
from jaxrod.envs.trivial import Trivial, TrivialParams
from jaxrod.training import PPOConfig, train
from jaxrod.training.runs.loop import _options

SMALL = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)


def test_how_an_environment_differs_from_the_usual_one_is_recorded():
    for name, options in [
        ("trivial", {}),
        ("trivial", {"episode_length": 7}),
        ("tracking", {"variant": "paper"}),
        ("reaching", {"variant": "clean", "substeps": 3}),
        ("structured", {"variant": "clean", "controls": 4}),
        ("unstructured", {"variant": "paper", "nest": 5, "n_elements": 30}),
    ]:
        env = make(name, **options)
        assert _options(env) == options
        assert make(name, **_options(env)) == env


def test_an_environment_that_make_does_not_make_is_not_taken_for_one_that_it_does():
    options = _options(ActionRepeat(make("tracking", variant="clean"), 3))
    assert options == {"type": "ActionRepeat"}
    with pytest.raises((TypeError, ValueError), match="type"):
        make("tracking", **options)


@pytest.mark.default_precision
def test_a_run_goes_on_in_the_environment_it_was_started_in(tmp_path):
    settings = {"steps": 256, "config": SMALL, "progress": False}
    params = TrivialParams(stride=0.3, edge=1.5)
    begun = train(Trivial(7), env_params=params, out=tmp_path, **settings)
    again = {"out": tmp_path, "resume": True, **settings}
    with pytest.raises(
        ValueError, match=r"env_options\.episode_length was 7, now None"
    ):
        train(Trivial(), env_params=params, **again)
    with pytest.raises(ValueError, match=r"env_params .*\.stride is another"):
        train(Trivial(7), **again)
    ended = train(Trivial(7), env_params=params, **again)
    assert ended.summary == begun.summary
