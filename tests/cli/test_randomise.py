"""`jaxrod train --randomise`: recorded whole, resumed, evaluated without the file."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxrod import cli, envs, training
from jaxrod.cli import runs, train
from jaxrod.envs.registry import origin_of
from jaxrod.training import RunFolder

TINY = ["--steps", "256", "--num-envs", "2", "--set", "rollout_steps=8"]
LONG = ["--steps", "60k", "--num-envs", "8", "--set", "rollout_steps=32"]
FILE = """
delay = [0, 2]          # control steps
lag = [0.0, 1.5]        # control steps

[parameters]
stride = { log_uniform = [0.7, 1.4], scaled = true }

[noise]
position = 0.02         # m
"""
RECORD = {
    "delay": [0, 2],
    "lag": [0.0, 1.5],
    "parameters": {"stride": {"log_uniform": [0.7, 1.4], "scaled": True}},
    "noise": {"position": 0.02},
}


def written(folder, text=FILE):
    file = folder / "reality.toml"
    file.write_text(text)
    return file


def test_the_task_that_is_trained_is_the_one_of_the_file(run, tmp_path, monkeypatch):
    trained = []

    def train(env, *_, **__):
        trained.append(env)
        raise FloatingPointError("enough")

    monkeypatch.setattr(training, "train", train)
    words = ("train", "trivial", "--randomise", written(tmp_path))
    assert run(*words, "--out", tmp_path / "run")[0] == 1
    assert origin_of(trained[0]).options == {"randomise": RECORD}
    assert trained[0] == envs.make("trivial", randomise=RECORD)
    config = {"task": "trivial", "algorithm": "ppo", "seed": 0}
    config |= {"env_options": {"randomise": RECORD}}
    assert runs.describe(config) == "trivial (randomised), ppo, seed 0"


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_run_is_evaluated_exported_and_resumed_without_the_file(
    run, run_json, tmp_path
):
    folder, file = tmp_path / "run", written(tmp_path)
    words = ("train", "trivial", "--out", folder, "--no-replay")
    code, out, err = run(*words, *TINY, "--randomise", file)
    assert code == 0, err
    assert "trivial (randomised), ppo, seed 0" in out
    file.unlink()
    config = json.loads((folder / "config.json").read_text())
    assert config["env_options"] == {"randomise": RECORD}
    summary = json.loads((folder / "summary.json").read_text())
    assert run_json(*words, "--resume", "--json") == summary | {"run": str(folder)}
    played = ("evaluate", folder, "--episodes", 16, "--seed", 1, "--json")
    returns = run_json(*played)["returns"]
    assert run_json(*played)["returns"] == returns
    assert run("export", folder, "--c", tmp_path / "policy.h")[0] == 0
    contract = json.loads((tmp_path / "policy.h.json").read_text())
    assert contract["about"]["env_options"]["randomise"] == RECORD
    other = written(tmp_path, FILE.replace("0.02 ", "0.03 "))
    code, _, err = run(*words, "--resume", "--randomise", other)
    assert code == 2 and "randomise.noise.position was 0.02, now 0.03" in err
    (folder / "config.json").write_text(json.dumps(config | {"env_options": {}}))
    assert run_json(*played)["returns"] != returns


@pytest.mark.slow
def test_a_killed_run_resumes_bit_by_bit(tmp_path):
    """The process is killed after its first checkpoint; the file is gone by then."""
    file, names = written(tmp_path), ("killed", "whole")
    command = [sys.executable, "-m", "jaxrod", "train", "trivial", *LONG]
    command += ["--checkpoint-seconds", "0", "--no-replay"]

    def words(name):
        return [*command, "--out", str(tmp_path / name)]

    whole = [*words("whole"), "--randomise", str(file)]
    assert subprocess.run(whole, capture_output=True).returncode == 0
    folder = RunFolder(tmp_path / "killed")
    process = subprocess.Popen(
        [*words("killed"), "--randomise", str(file)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 300
    while len(folder.progress.read()) < 1 and time.monotonic() < deadline:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not folder.summary_file.exists()
    file.unlink()
    assert subprocess.run([*words("killed"), "--resume"]).returncode == 0
    with (
        np.load(tmp_path / names[0] / "policy" / "policy.npz") as a,
        np.load(tmp_path / names[1] / "policy" / "policy.npz") as b,
    ):
        assert set(a) == set(b)
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])
    first, second = ((tmp_path / name / "episodes.csv").read_bytes() for name in names)
    assert first == second


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "delay = -1",
            "reality.toml: delay must be non-negative, got -1 control steps",
        ),
        ("delay = ", "reality.toml: "),
        ("speed = 1", "reality.toml: there is no option 'speed' of a randomisation"),
        ("[noise]\nspeed = 1", "noise names the channel 'speed'"),
        ("[parameters]\nstrid.uniform = [1, 2]", "the nearest are stride"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(text, sentence, run, tmp_path):
    words = ("train", "trivial", "--randomise", written(tmp_path, text))
    code, _, err = run(*words, "--out", tmp_path / "run")
    assert code == 2 and sentence in err and err.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_missing_file_is_named(run, tmp_path):
    words = ("train", "trivial", "--randomise", tmp_path / "none.toml")
    code, _, err = run(*words, "--out", tmp_path / "run")
    assert code == 2 and "none.toml: No such file" in err


def test_a_randomised_run_has_its_own_folder():
    parser = cli._parser(["train"])[0]
    args = parser.parse_args(["train", "trivial", "--randomise", "f.toml"])
    assert train._folder(args, None) == Path("runs/trivial-randomised-ppo-0")


def test_the_record_of_a_stranger_is_checked(run, tmp_path):
    config = {
        "task": "trivial",
        "variant": None,
        "env_options": {"randomise": RECORD},
        "algorithm": "ppo",
        "steps": 1000,
        "seed": 0,
        "settings": {},
    }
    file = tmp_path / "config.json"
    file.write_text(json.dumps(config))
    env = runs.open_run(tmp_path).env
    np.testing.assert_allclose(env.default_params().actuator["lag"], [0.0, 1.5])
    for bad in (3, [1], {"delay": "x"}, {"parameters": {"stride": []}}, {"noise": []}):
        config["env_options"] = {"randomise": bad}
        file.write_text(json.dumps(config))
        code, _, err = run("evaluate", tmp_path)
        assert code == 2 and "config.json" in err, err
