"""`jaxrod train`: what it leaves, what it refuses, and that nothing is lost."""

import argparse
import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxrod import cli
from jaxrod.cli import settings, train
from jaxrod.installation import backend
from jaxrod.training import PPOConfig
from jaxrod.training.progress import ProgressBar

CONTRACT = {
    "final_score",
    "env_steps",
    "wall_s",
    "steps_per_s",
    "flagged_fraction",
    "seed",
    "variant",
    "algorithm",
}
TINY = ["--steps", "2k", "--num-envs", "8", "--set", "rollout_steps=32"]


def contents(folder):
    """Every file of a folder with its bytes."""
    return {
        file: file.read_bytes() for file in Path(folder).rglob("*") if file.is_file()
    }


def test_the_summary_keeps_the_contract_and_is_what_json_prints(trained):
    folder, out = trained
    summary = json.loads((folder / "summary.json").read_text())
    assert set(summary) >= CONTRACT
    assert json.loads(out) == summary | {"run": str(folder)}
    assert summary["task"] == "trivial"
    assert summary["variant"] is None
    assert summary["algorithm"] == "ppo"
    assert summary["seed"] == 3
    assert summary["env_steps"] == 2048
    assert 0 < summary["final_score"] <= 20


def test_steps_that_are_rounded_up_are_announced(told):
    words = "2,000 steps rounded up to 8 updates of 256 control steps"
    assert words in told[2].splitlines()


def test_the_speed_of_the_whole_run_includes_compiling(trained):
    folder, out = trained
    first = train._lines(
        json.loads(out), json.loads((folder / "config.json").read_text())
    )[0]
    assert first.endswith(" steps/s with compiling")


def test_a_task_without_pictures_is_not_reproached(told, run):
    folder, _, said = told
    assert "snapshot" not in said
    code, _, err = run("render", folder)
    assert code == 0 and "no replay: trivial has no pictures" in err.splitlines()
    assert "snapshot" not in err


def test_the_batch_is_spread_over_the_cores_it_divides_into(trained):
    summary = json.loads((trained[0] / "summary.json").read_text())
    cores = backend.available_cores()
    used = max(k for k in range(1, cores + 1) if 8 % k == 0)
    assert summary["device"].startswith(f"{used} x ")


def test_the_run_folder_holds_everything(trained):
    folder, _ = trained
    names = {file.name for file in folder.iterdir()}
    assert names == {
        "config.json",
        "progress.csv",
        "episodes.csv",
        "summary.json",
        "checkpoints",
        "policy",
        "learning_curve.png",
    }
    with (folder / "progress.csv").open() as file:
        row = next(csv.DictReader(file))
    assert {"env_steps", "wall_s", "episode_return_mean"} <= set(row)


def test_a_run_that_is_there_is_refused_and_left_alone(trained, run):
    folder, _ = trained
    before = contents(folder)
    code, out, err = run("train", "trivial", "--out", folder)
    assert (code, out) == (2, "")
    assert "--resume" in err
    assert "--overwrite" in err
    assert err.count("\n") == 1
    assert contents(folder) == before


@pytest.mark.slow
@pytest.mark.default_precision
def test_resuming_takes_over_what_the_run_was_started_with(trained, run_json, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained[0], folder)
    before = json.loads((folder / "summary.json").read_text())
    config = (folder / "config.json").read_bytes()
    after = run_json("train", "trivial", "--resume", "--out", folder, "--json")
    assert after == before | {"run": str(folder)}
    assert (folder / "config.json").read_bytes() == config


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_run_begins_like_another_but_for_what_is_given(trained, run_json, tmp_path):
    folder = tmp_path / "run"
    before = json.loads((trained[0] / "config.json").read_text())
    words = ("train", "trivial", "--like", trained[0], "--out", folder, "--json")
    summary = run_json(*words, "--set", "clip=0.3", "--steps", "1k")
    after = json.loads((folder / "config.json").read_text())
    assert summary["seed"] == before["seed"] == 3
    assert after["settings"] == before["settings"] | {"clip": 0.3}
    assert after["steps"] == 1000
    same = set(before) - {"settings", "steps"}
    assert {n: after[n] for n in same} == {n: before[n] for n in same}


@pytest.mark.slow
def test_overwriting_makes_a_new_run_with_new_pictures(trained, run_json, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained[0], folder)
    (folder / "replay.html").write_text("of the run before")
    (folder / "notes.txt").write_text("mine")
    words = ("train", "trivial", *TINY, "--seed", 4, "--overwrite", "--out", folder)
    assert run_json(*words, "--json")["seed"] == 4
    assert not (folder / "replay.html").exists()
    assert (folder / "notes.txt").read_text() == "mine"


@pytest.mark.slow
def test_a_run_does_not_go_on_in_another_precision(trained, run):
    code, _, err = run("train", "trivial", "--resume", "--out", trained[0])
    assert code == 2
    assert "holds float32" in err and "has JAX_ENABLE_X64 changed?" in err


def test_ctrl_c_saves_and_says_how_to_go_on(run, run_json, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    words = ("train", "trivial", *TINY, "--steps", "40k", "--out", folder)
    real = ProgressBar.update

    def interrupted(self, *args):
        real(self, *args)
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(ProgressBar, "update", interrupted)
        code, _, err = run(*words)
    assert code == 130
    command = f"jaxrod train trivial --resume --out {folder}"
    assert f"continue with: {command}" in err
    stopped = json.loads((folder / "summary.json").read_text())
    assert stopped["status"] == "interrupted"
    assert 0 < stopped["env_steps"] < 40_000
    finished = run_json(*command.split()[1:], "--json")
    assert finished["status"] == "finished"
    assert finished["env_steps"] >= 40_000


@pytest.mark.slow
def test_no_more_devices_than_cores_are_made_of_them(tmp_path):
    # In a process of its own: devices are made before JAX starts.
    words = ["train", "trivial", "--devices", "99", "--num-envs", "99"]
    words += ["--steps", "13k", "--out", str(tmp_path / "run")]
    done = subprocess.run(
        [sys.executable, "-m", "jaxrod", *words], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "devices must be at most the" in done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["swimming"],
            "task must be one of catheter, following, gripper, insert, lift, octopus, "
            "reaching, snake, structured, tracking, trivial, unstructured, or the "
            "path of your own, such as mypackage.mymodule:make_task; "
            "got 'swimming'",
        ),
        (["tracking", "--variant", "dirty"], "variant must be one of"),
        (["trivial", "--variant", "paper"], "'trivial' has no option 'variant'"),
        (["trivial", "--algorithm", "luck"], "algorithm must be one of"),
        (["trivial", "--steps", "3"], "steps must be at least one update"),
        (
            ["trivial", "--seed", "-1"],
            "seed must be an integer from 0 to 4294967295, got -1",
        ),
        (["trivial", "--num-envs", "0"], "num_envs must be at least 1, got 0"),
        (["trivial", "--set", "clip"], "--set needs NAME=VALUE, got 'clip'"),
        (["trivial", "--set", "clip=-1"], "clip must be positive"),
        (["trivial", "--set", "clip=wide"], "clip must be a number, got 'wide'"),
        (["trivial", "--set", "clib=1"], "there is no setting 'clib'"),
        (["trivial", "--resume"], "does not exist"),
        (["trivial", "--like", "nowhere"], "does not exist"),
        (["trivial", "--like", "here", "--resume"], "give --like to begin a new run"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(words, sentence, run, tmp_path):
    folder = tmp_path / "run"
    code, out, err = run("train", *words, "--out", folder)
    assert (code, out) == (2, "")
    assert err.startswith("jaxrod train: ")
    assert sentence in err
    assert err.count("\n") == 1
    assert not folder.exists()


def test_resuming_another_task_or_other_settings_is_refused(trained, run):
    folder, _ = trained
    before = contents(folder)
    for words in (["tracking"], ["trivial", "--seed", "5"], ["trivial", *TINY, "--set",
                  "clip=0.3"]):  # fmt: skip
        code, out, err = run("train", *words, "--resume", "--out", folder)
        assert (code, out) == (2, "")
        assert err.count("\n") == 1
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("learning_rate=3e-4", 3e-4),
        ("learning_rate=1", 1.0),
        ("hidden_sizes=128,64", (128, 64)),
        ("hidden_sizes=32", (32,)),
        ("spread_phases=false", False),
        ("num_envs=2k", 2000),
    ],
)
def test_settings_are_read_as_their_kind(word, value):
    changed = settings.configure(PPOConfig(), {"clip": 0.1}, [word])
    name = word.partition("=")[0]
    assert getattr(changed, name) == value
    assert type(getattr(changed, name)) is type(getattr(PPOConfig(), name))
    assert changed.clip == 0.1


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("300", 300),
        ("500k", 500_000),
        ("4.1M", 4_100_000),
        ("10M", 10_000_000),
        ("1e7", 10_000_000),
    ],
)
def test_counts_may_be_written_short(text, count):
    assert settings.count(text) == count


@pytest.mark.parametrize("text", ["", "k", "1.5", "inf", "nan", "many"])
def test_what_is_not_a_count_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError):
        settings.count(text)


def test_what_is_no_count_is_told_in_words(run):
    code, _, err = run("train", "trivial", "--steps", "1.5")
    assert code == 2 and "argument --steps: 1.5 is not a whole number" in err
    code, _, err = run("train", "trivial", "--set", "num_envs=1.5")
    assert code == 2 and "num_envs must be an integer, got '1.5'" in err


def test_settings_can_be_listed(run):
    code, out, _ = run("train", "trivial", "--set", "help")
    assert code == 0
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert "learning_rate=0.001 Step size of Adam at the start." in lines
    # Of a base class, and of the learner itself: none without a meaning.
    settings = [line for line in out.splitlines() if "=" in line.split()[0]]
    assert any(line.startswith("hidden_sizes=64,64 ") for line in settings)
    assert all(len(line.split()) > 2 for line in settings)


@pytest.mark.parametrize(
    ("words", "folder"),
    [
        (["tracking"], "runs/tracking-paper-ppo-0"),
        (
            ["tracking", "--variant", "clean", "--seed", "2"],
            "runs/tracking-clean-ppo-2",
        ),
        (["trivial"], "runs/trivial-ppo-0"),
        (["trivial", "--out", "here"], "here"),
    ],
)
def test_a_run_is_found_again_where_it_was_put(words, folder):
    parser = cli._parser(["train"])[0]
    args = parser.parse_args(["train", *words])
    variant = args.variant or train._default_variant(args.task)
    assert train._folder(args, variant) == Path(folder)
    args = parser.parse_args(["train", *words, "--resume"])
    assert train._folder(args, None) == Path(folder)


@pytest.mark.slow
def test_a_run_is_resumed_by_the_words_that_began_it(run, tmp_path):
    """Its stored steps are less than one update of the default settings."""
    words = ["train", "trivial", *TINY, "--out", tmp_path / "run", "--no-replay"]
    for more in ([], ["--resume"]):
        code, _, err = run(*words, *more)
        assert code == 0, err
