"""The example of one's own task: trained, evaluated and drawn from the shell."""

import json
from pathlib import Path

import jax
import pytest

import jaxrod
from jaxrod import cli
from jaxrod.envs import check_environment, make

pytestmark = pytest.mark.default_precision

ROOT = Path(__file__).parents[2]
TASK = "examples/own_task.py:make_task"
TINY = ["--num-envs", "2", "--set", "rollout_steps=8", "--set", "hidden_sizes=8"]
TINY += ["--set", "minibatches=2", "--set", "epochs=1"]


@pytest.fixture
def shell(monkeypatch, capsys):
    """Calls a command that must succeed; returns what it printed."""
    monkeypatch.setattr(jaxrod, "configure_cpu", lambda devices=None: None)

    def call(*words):
        code = cli.main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert code == 0, err
        return out

    return call


def test_the_example_is_short_and_keeps_the_protocol(monkeypatch):
    monkeypatch.chdir(ROOT)
    text = (ROOT / "examples" / "own_task.py").read_text()
    assert len(text.splitlines()) <= 60
    env = make(TASK, height=0.2)
    check_environment(env)
    assert env.height == 0.2
    assert make(TASK, height=0.2) == env


def test_bending_up_lifts_the_tip(monkeypatch):
    monkeypatch.chdir(ROOT)
    env = make(TASK)
    params = env.default_params()
    _, state = env.reset(jax.random.key(0), params)
    for _ in range(5):
        step = jax.jit(env.step)
        _, state, reward, *_ = step(None, state, jax.numpy.ones(1), params)
    assert 0.05 < float(state.rod.tip[1]) < 0.5
    assert float(reward) == pytest.approx(-abs(float(state.rod.tip[1] - state.goal)))
    assert float(abs(state.rod.positions[2]).max()) == 0


@pytest.mark.slow
def test_it_trains_goes_on_and_is_evaluated_and_drawn(shell, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    monkeypatch.chdir(ROOT)
    words = ["train", TASK, "--option", "height=0.2", "--out", folder, "--no-replay"]
    shell(*words, "--steps", "32", "--devices", "1", *TINY)
    config = json.loads((folder / "config.json").read_text())
    assert config["task"] == f"{ROOT / 'examples' / 'own_task.py'}:make_task"
    assert config["env_options"] == {"height": 0.2}
    again = shell("train", TASK, "--resume", "--out", folder, "--no-replay", "--json")
    assert json.loads(again)["env_steps"] == 32
    # From another folder, too.
    monkeypatch.chdir(tmp_path)
    trust = ("--trust", ROOT / "examples" / "own_task.py")
    found = json.loads(shell("evaluate", folder, "--episodes", "2", "--json", *trust))
    assert found["task"] == config["task"] and found["lengths"] == [100, 100]
    out = shell("render", folder, "--seconds", "0.1", *trust)
    assert str(folder / "replay.html") in out.split()
    title = "own_task.py:make_task (height = 0.2), ppo, seed 0"
    assert title in (folder / "replay.html").read_text()
