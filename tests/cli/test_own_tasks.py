"""A task of one's own on the command line: found, made again, refused in a sentence."""

import importlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxrod import cli
from jaxrod.cli import settings, train
from jaxrod.envs import make
from jaxrod.envs.gym import GymnasiumEnv
from jaxrod.envs.registry import origin_of
from jaxrod.training.progress import ProgressBar

MODULE = """
import dataclasses
from typing import NamedTuple
from jaxrod.envs.trivial import Trivial

@dataclasses.dataclass(frozen=True)
class Line(Trivial):
    start: tuple = (0,)

def make_task(length=5, *, name="line", start=(0,)):
    if length < 1:
        raise ValueError(f"length must be at least 1, got {length}")
    return Line(length, name, start=start)

def any_name(**options):
    return Line(len(options) or 1)

def must_know(height, width):
    return Line()

def nothing():
    return None

def half():
    return HalfDone()

def breaks():
    return 1 / 0

class HalfDone:
    name, observation_size, action_size = "half", 2, 1
    def reset(self, key, params): ...

class Unhashable(Trivial):
    __hash__ = None

def endless():
    return Line(0)

def wide():
    return Line(observation_size=2)

class Forgetful(Trivial):
    def step(self, *given):
        return super().step(*given)[:4]

class Typo(Trivial):
    def step(self, key, state, action, params):
        return state.postion

class Drifting(Trivial):
    def step(self, *given):
        observation, state, *rest = super().step(*given)
        return observation, dataclasses.replace(state, steps=1.0 * state.steps), *rest

class Undrawn(Trivial):
    control_period = 0.1
    def snapshot(self, state, params):
        return state.position

class Kept(NamedTuple):
    name: str = "kept"
    observation_size: int = 1
    action_size: int = 1
    episode_length: int = 2
    def default_params(self): ...
    def reset(self, key, params): ...
    def step(self, key, state, action, params): ...

number = 3
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A folder with modules of one's own, which is the current one."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    package = tmp_path / "package_of_mine"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "tasks.py").write_text(MODULE)
    (package / "hungry.py").write_text("import nothing_like_it\n")
    (package / "torn.py").write_text("def make_task(:\n")
    (package / "loud.py").write_text("raise RuntimeError('not today')\n")
    importlib.invalidate_caches()
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("package_of_mine")]:
        del sys.modules[name]


TINY = ["--steps", "20k", "--num-envs", "32", "--set", "rollout_steps=32"]
TINY += ["--set", "hidden_sizes=8", "--set", "minibatches=2", "--set", "epochs=1"]


@pytest.mark.default_precision
def test_a_task_is_trained_resumed_and_evaluated_by_its_import_path(
    mine, run, run_json, monkeypatch
):
    task = "package_of_mine.tasks:make_task"
    words = ["train", task, "--option", "length=7", "--option", "start=[1, 2]"]
    real = ProgressBar.update

    def interrupted(self, *args):
        real(self, *args)
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(ProgressBar, "update", interrupted)
        code, _, err = run(*words, *TINY)
    assert code == 130 and f"continue with: jaxrod train {task} --resume" in err
    folder = Path("runs/package_of_mine.tasks-make_task-ppo-0")
    config = json.loads((folder / "config.json").read_text())
    assert config["task"] == task
    assert config["env_options"] == {"length": 7, "start": [1, 2]}
    for command in ("evaluate", "render"):
        code, _, err = run(command, folder)
        assert code == 2 and "pass --trust package_of_mine.tasks, in" in err
    trust = ("--trust", "package_of_mine.tasks")
    found = run_json("evaluate", folder, "--episodes", 2, "--json", *trust)
    assert found["task"] == task and max(found["lengths"]) <= 7
    code, out, err = run("render", folder, *trust)
    assert code == 0 and "learning_curve.png" in out
    assert "no replay: line does not say what to draw" in err
    code, _, err = run("train", task, "--resume", "--option", "length=8")
    assert code == 2 and "env_options.length was 7, now 8" in err
    ended = run_json("train", task, "--resume", "--json")
    assert (ended["status"], ended["task"]) == ("finished", task)
    # What has changed since is told.
    file = mine / "package_of_mine" / "tasks.py"
    file.write_text(MODULE.replace("length=5, *, name", "size=5, *, name"))
    os.utime(file, (1, 1))
    del sys.modules["package_of_mine.tasks"]
    importlib.invalidate_caches()
    code, _, err = run("evaluate", folder, *trust)
    assert code == 2 and err.count("\n") == 1
    assert f"the task of {folder}/config.json cannot be made again: " in err
    assert "has no option 'length', it has size, name, start" in err


SCRIPT = """
import jax.numpy as jnp
import jaxrod
from jaxrod.envs.trivial import Trivial
from jaxrod.training import PPOConfig, train

class Mine(Trivial):
    control_period = 0.1
    def step(self, key, state, action, params):
        seen, state, reward, _, over, info = super().step(key, state, action, params)
        return seen, state, reward, False, over, info
    def snapshot(self, state, params):
        nodes = jnp.zeros((3, 3)).at[0].add(state.position + jnp.arange(3.0))
        return jaxrod.envs.Snapshot(nodes, jnp.full(2, 0.1))

if __name__ == "__main__":
    sizes = dict(num_envs=8, rollout_steps=16, epochs=1, minibatches=2)
    config = PPOConfig(hidden_sizes=(8,), **sizes)
    train(Mine(7), steps=512, config=config, out="run", progress=False)
"""


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_task_defined_in_the_script_that_trains_it_is_found_again(
    tmp_path, run, run_json, monkeypatch
):
    script = tmp_path / "my_script.py"
    script.write_text(SCRIPT)
    subprocess.run([sys.executable, script.name], cwd=tmp_path, check=True)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["task"] == f"{script}:Mine"
    assert config["env_options"] == {"episode_length": 7}
    code, _, err = run("evaluate", "../run")
    assert code == 2 and f"pass --trust {script}, in" in err
    trust = ("--trust", "../my_script.py")
    for known in (trust, ("--task", "../my_script.py:Mine")):
        found = run_json("evaluate", "../run", "--episodes", 2, "--json", *known)
        assert found["lengths"] == [7, 7]
    code, _, err = run("export", "../run", "--c", "policy.h", *trust)
    assert code == 0, err
    code, out, err = run("render", "../run", *trust)
    assert code == 0 and "../run/replay.html" in out.split(), err
    words = ("train", "../my_script.py:Mine", "--out", "../run", "--resume", "--json")
    assert run_json(*words)["env_steps"] == 512
    # It has moved.
    script.rename("moved.py")
    # This process has imported it.
    del sys.modules[next(name for name in sys.modules if name.startswith("my_script@"))]
    code, _, err = run("evaluate", "../run", *trust)
    assert code == 2 and "If it has moved, give --task FILE.py:NAME" in err
    named = ("--task", "moved.py:Mine", "--episodes", 2, "--json")
    assert run_json("evaluate", "../run", *named)["lengths"] == [7, 7]
    # It would train again.
    Path("guardless.py").write_text(SCRIPT.replace('__name__ == "__main__"', "True"))
    code, _, err = run("evaluate", "../run", "--task", "guardless.py:Mine")
    assert code == 2 and "guardless.py calls jaxrod.training.train when it is" in err
    assert 'below a line `if __name__ == "__main__":`' in err


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_task_without_a_file_is_named_by_the_user(tmp_path, run, run_json):
    script = SCRIPT.replace(
        "class Mine(Trivial):", "def f(): pass\nclass Mine(Trivial):"
    )
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True)
    folder = tmp_path / "run"
    assert json.loads((folder / "config.json").read_text())["env_options"] is None
    code, _, err = run("evaluate", folder)
    assert code == 2 and "by --task FILE.py:NAME" in err
    code, _, err = run("train", "here.py:Mine", "--resume", "--out", folder)
    assert code == 2 and "resume=True" in err
    (tmp_path / "here.py").write_text(SCRIPT + "\ndef seven():\n    return Mine(7)\n")
    named = ("--task", f"{tmp_path}/here.py:seven", "--episodes", 2, "--json")
    assert run_json("evaluate", folder, *named)["lengths"] == [7, 7]


@pytest.mark.parametrize(
    ("task", "options", "sentence"),
    [
        ("nowhere_at_all:make_task", [], "there is no module 'nowhere_at_all'"),
        ("package_of_mine.no:make_task", [], "no module 'package_of_mine.no'"),
        ("nowhere.py:make_task", [], "there is no file "),
        ("package_of_mine/tasks:make_task", [], "is neither the name of a module nor"),
        ("package_of_mine.tasks:", [], "must look like mypackage.mymodule:make_task"),
        ("package_of_mine.tasks:Line.step", [], "must look like mypackage.mymodule:"),
        (":make_task", [], "must look like mypackage.mymodule:make_task"),
        ("os:system", ["command=true"], "'os' is a module of Python's library"),
        (
            "package_of_mine.tasks:task",
            [],
            "package_of_mine.tasks has no 'task'; it has",
        ),
        ("package_of_mine.py", [], "add its class, package_of_mine.py:NAME"),
        ("package_of_mine.tasks:number", [], "must be callable, got 3"),
        ("package_of_mine.hungry:x", [], "failed: No module named 'nothing_like_it'"),
        ("package_of_mine.torn:x", [], "package_of_mine.torn raised SyntaxError"),
        ("package_of_mine.loud:x", [], "raised RuntimeError: not today"),
        ("{}:make_task", ["length=0"], "length must be at least 1, got 0"),
        ("{}:make_task", ["width=2"], "no option 'width', it has length, name, start"),
        ("{}:make_task", ["length"], "--option needs NAME=VALUE, got 'length'"),
        ("{}:must_know", ["height=2"], "needs the option width"),
        ("{}:breaks", [], "raised ZeroDivisionError: division by zero"),
        ("{}:nothing", [], "got a NoneType without name, observation_size"),
        (
            "{}:half",
            [],
            "must have what jaxrod.envs.Environment asks for, got a HalfDone without "
            "episode_length, default_params(), step()",
        ),
        (
            "{}:Unhashable",
            [],
            "trivial must be hashable, for example a frozen dataclass",
        ),
        ("{}:endless", [], "episode_length of trivial must be a positive integer"),
        (
            "{}:wide",
            [],
            "the observation of reset of trivial must be an array of floats of shape "
            "(2,), got float",
        ),
        ("{}:Forgetful", [], "step of trivial must return (observation, state, reward"),
        ("{}:Typo", [], "step of trivial raised AttributeError"),
        ("{}:Drifting", [], "state like that of reset: state.steps was int"),
        ("{}:Undrawn", [], "snapshot of trivial must return a jaxrod.envs.Snapshot"),
        ("trivial", ["size=2"], "'trivial' has no option 'size'"),
    ],
)
def test_what_is_no_task_is_one_sentence(task, options, sentence, mine, run):
    words = [word for option in options for word in ("--option", option)]
    task = task.format("package_of_mine.tasks")
    code, out, err = run("train", task, *words, *TINY, "--out", mine / "run")
    assert (code, out) == (2, "")
    assert sentence in err
    assert err.startswith("jaxrod train: ") and err.count("\n") == 1
    assert not (mine / "run").exists()


@pytest.mark.default_precision
def test_the_doors_to_other_libraries_take_an_import_path(mine, monkeypatch):
    monkeypatch.syspath_prepend(mine)
    env = GymnasiumEnv("package_of_mine.tasks:make_task", length=2)
    env.reset(seed=0)
    ends = [env.step(np.zeros(1, np.float32))[3] for _ in range(2)]
    assert ends == [False, True]


def test_how_an_environment_was_made_is_known_whatever_it_is(mine, monkeypatch):
    monkeypatch.syspath_prepend(mine)
    options = {"make_task": {"name": "x"}, "any_name": {"a": 1}, "Kept": {"name": "x"}}
    for name, given in options.items():  # No weak reference to the last.
        env = make(f"package_of_mine.tasks:{name}", **given)
        assert origin_of(env).task == f"package_of_mine.tasks:{name}"
        assert origin_of(env).options == given


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("a=3", 3),
        ("a=1e-3", 1e-3),
        ("a=true", True),
        ("a=True", True),
        ("a=none", None),
        ("a=null", None),
        ("a=[1, 2]", [1, 2]),
        ("a=clean", "clean"),
        ("a='3'", "3"),
        ("a=", ""),
        ("a=b=c", "b=c"),
    ],
)
def test_options_are_read_as_what_they_look_like(word, value):
    found = settings.options([word])
    assert found == {"a": value} and type(found["a"]) is type(value)


def test_a_run_is_put_where_its_task_says():
    for task, folder in (
        ("examples/own_task.py:make_task", "own_task-make_task-ppo-0"),
        ("a.b:make", "a.b-make-ppo-0"),
    ):
        for more in ([], ["--resume"]):
            args = cli._parser(["train"])[0].parse_args(["train", task, *more])
            assert train._folder(args, None) == Path("runs") / folder
