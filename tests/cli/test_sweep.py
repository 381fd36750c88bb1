"""`jaxrod sweep`: what is planned, what is refused, and what it leaves."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from commands import run as run
from jaxrod.cli.sweeps import running
from jaxrod.cli.sweeps.plan import plan
from jaxrod.training.runs.folder import RunFolder
from jaxrod.training.runs.owned_folder import only_process

# A stand-in for `jaxrod train`: fails where the seed is 7 and is killed where it is 9,
# unless it is resumed.
TRAIN = """
import json, os, pathlib, sys
words = sys.argv[1:]
given = {a[2:]: b for a, b in zip(words, words[1:]) if a.startswith("--")}
out, seed, resumed = pathlib.Path(given["out"]), given["seed"], "--resume" in words
with open(out.parent / "called", "a") as called:
    called.write(out.name + (" resumed" if resumed else "") + "\\n")
out.mkdir(exist_ok=True)
config = {"format": "jaxrod training run 1", **json.loads(os.environ["CONFIGS"])[out.name]}
(out / "config.json").write_text(json.dumps(config))
(out / "progress.csv").write_text(
    "env_steps,wall_s,episode_return_mean,flagged_fraction\\n50,1,3,0\\n100,2,4,0\\n")
if seed == "7" and not resumed:
    sys.exit("value_loss is not a number")
if seed == "9" and not resumed:
    os.kill(os.getpid(), 9)
summary = {"status": "finished", "final_score": 10.0 + int(seed), "env_steps": 100,
           "wall_s": 2.0, "steps_per_s": 50.0, "episodes": 3, "flagged_fraction": 0.0,
           "score_window": 50}
(out / "summary.json").write_text(json.dumps(summary))
"""  # noqa: E501 (a program)
WORDS = ("--steps", "2k", "--set", "num_envs=8", "learning_rate=1e-3,3e-4")


@pytest.fixture
def sweep(run, monkeypatch, tmp_path):
    """Runs a sweep of stand-ins; `called()` says which were started since."""
    monkeypatch.setattr(running, "LAUNCHER", (sys.executable, "-c", TRAIN))
    monkeypatch.setattr(running, "POLL_SECONDS", 0.02)
    out = tmp_path / "sweep"

    def call(*seeds, words=()):
        runs = plan(["trivial"], ["ppo"], seeds, steps=2000, sets=WORDS[3:])
        configs = {run.name: run.config for run in runs}
        monkeypatch.setenv("CONFIGS", json.dumps(configs))
        return run("sweep", "trivial", *WORDS, "--seeds", *seeds, "--out", out, *words)

    def called():
        file = out / "called"
        lines = file.read_text().splitlines() if file.exists() else []
        file.unlink(missing_ok=True)
        return lines

    call.out, call.called = out, called
    return call


def rows(out):
    with (out / "results.csv").open() as file:
        return list(csv.DictReader(file))


def test_every_combination_is_one_run_with_a_name_that_says_which():
    sets = ["ppo.learning_rate=1e-3,3e-4", "hidden_sizes=8,8", "hidden_sizes=16"]
    runs = plan(["trivial"], ["ppo", "sac"], [0, 1], steps=90_000, sets=sets)
    names = [run.name for run in runs]
    assert len(set(names)) == len(names) == 2 * (2 * 2 + 2)
    assert names[0] == "trivial-ppo-hidden_sizes=8,8-learning_rate=0.001-0"
    assert {run.seed for run in runs[:6]} == {0}, "a seed is complete before the next"
    assert runs[0].config["settings"]["hidden_sizes"] == [8, 8]
    assert runs[0].config["settings"]["learning_rate"] == 1e-3
    # Two words for one value are one run.
    sets = ["learning_rate=1e-3,0.001"]
    assert len(plan(["trivial"], ["ppo"], [0, 0], steps=90_000, sets=sets)) == 1


def test_the_variant_is_in_the_name_and_devices_divide_the_environments():
    sets = ["num_envs=12", "minibatches=1"]
    (one,) = plan(
        ["tracking"], ["ppo"], [3], steps=9000, variant="clean", sets=sets, cores=8
    )
    assert one.name == "tracking-clean-ppo-minibatches=1-num_envs=12-3"
    assert one.devices == 6
    assert one.config["env_options"] == {"variant": "clean"}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["trivial", "--set", "luck=1"], "ppo: there is no setting 'luck'"),
        (["trivial", "--set", "learning_rate=1e-3,high"], "learning_rate must be"),
        (["trivial", "--set", "learning_rate"], "--set needs NAME=VALUE"),
        (["trivial", "--set", "learning_rate=1e-3,"], "learning_rate must be"),
        (["trivial", "--set", "sac.batch_size=3"], "sac of sac.batch_size=3 must be"),
        (["trivial", "--set", "num_envs=0"], "num_envs must be"),
        (["trivial", "--algorithms", "luck"], "luck"),
        (["trivial", "--seeds", "-1"], "seeds must be an integer from 0"),
        (["trivial", "--variant", "clean"], "'trivial' has no option 'variant'"),
        (["nowhere"], "nowhere"),
        (["trivial", "--jobs", "0"], "jobs must be at least 1"),
        (["trivial", "--cpus", "2"], "--cpus and --gpus need --ray"),
        (["trivial", "--ray", "auto", "--cpus", "0"], "cpus must be at least 1"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(words, sentence, run, tmp_path):
    code, out, err = run("sweep", *words, "--out", tmp_path / "sweep")
    assert (code, out) == (2, "")
    assert sentence in err
    assert err.count("\n") == 1
    assert not (tmp_path / "sweep").exists()


def test_a_sweep_leaves_a_row_per_run_and_a_picture_and_is_not_run_twice(sweep):
    code, _, err = sweep(0, 1)
    assert code == 0, err
    found = rows(sweep.out)
    assert [(r["learning_rate"], r["seed"], r["final_score"]) for r in found] == [
        ("0.001", "0", "10.0"),
        ("0.0003", "0", "10.0"),
        ("0.001", "1", "11.0"),
        ("0.0003", "1", "11.0"),
    ]
    assert {row["state"] for row in found} == {"finished"}
    assert (sweep.out / "trivial.png").read_bytes().startswith(b"\x89PNG")
    assert "4 done" in err
    assert len(sweep.called()) == 4
    assert sweep(0, 1)[0] == 0
    assert sweep.called() == []
    # A sweep that grows keeps what it has.
    assert sweep(0, 1, 2)[0] == 0
    assert len(sweep.called()) == 2


def test_runs_that_fail_are_told_of_and_tried_again(sweep):
    code, _, err = sweep(7, 9, 0)
    assert code == 1
    assert "value_loss is not a number (see " in err
    assert "killed by signal 9" in err
    failed = [row for row in rows(sweep.out) if row["state"] == "failed"]
    assert [row["error"] for row in failed] == [
        *["value_loss is not a number"] * 2,
        *["killed by signal 9"] * 2,
    ]
    assert {row["final_score"] for row in failed} == {"nan"}
    assert {row["env_steps"] for row in failed} == {"100"}
    sweep.called()
    assert sweep(7, 9, 0)[0] == 0
    assert len(sweep.called()) == 4
    assert {row["state"] for row in rows(sweep.out)} == {"finished"}


def test_what_was_run_otherwise_is_refused(sweep):
    sweep(0)
    sweep.called()
    code, out, err = sweep(0, words=("--steps", "4k"))
    assert (code, out) == (2, "")
    assert "holds a different run: steps was 2000, now 4000" in err
    assert sweep.called() == []


def test_a_dry_run_lists_states_and_two_sweeps_do_not_share_a_folder(sweep):
    _, out, _ = sweep(0, words=("--dry-run",))
    assert [line.split()[0] for line in out.splitlines()] == ["waiting"] * 2
    assert not sweep.out.exists()
    with only_process(sweep.out):
        code, _, err = sweep(0)
    assert code == 2
    assert f"{sweep.out} is in use by process {os.getpid()}" in err


@pytest.mark.slow
def test_a_sweep_that_is_killed_ends_as_if_nothing_had_happened(tmp_path):
    words = ["trivial", "--steps", "100k", "--set", "num_envs=8", "--seeds", "0", "1"]
    more = ["--jobs", "2", "--checkpoint-seconds", "0", "--out"]
    command = [sys.executable, "-m", "jaxrod", "sweep", *words, *more]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    subprocess.run([*command, whole], check=True, capture_output=True)
    with subprocess.Popen([*command, cut], stderr=subprocess.DEVNULL) as process:
        while len(list(cut.glob("*/checkpoints/*.npz"))) < 2:
            assert process.poll() is None
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
    assert not RunFolder(cut / "trivial-ppo-num_envs=8-0").finished
    subprocess.run([*command, cut], check=True, capture_output=True)
    for name in ("trivial-ppo-num_envs=8-0", "trivial-ppo-num_envs=8-1"):
        files = [RunFolder(out / name).episodes.path for out in (whole, cut)]
        assert files[0].read_bytes() == files[1].read_bytes()
