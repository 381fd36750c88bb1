"""`jaxrod reproduce`: grids of runs that stop, die and diverge, and what they leave."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from benchmarks.paper.cell_records import COLUMNS
from benchmarks.paper.plan import plan
from jaxrod import __version__
from jaxrod.cli.sweeps import running
from jaxrod.training.runs.owned_folder import only_process

# A stand-in for `jaxrod train`, which takes seconds to start: its run ends with the
# score 100 seed + 1, diverges where seed is 7, is killed where seed is 9, and has no
# complete episode where seed is 11. Where seed is 5 it waits for another to run beside
# it, where it is 3 to be told to stop.
TRAIN = """
import json, os, pathlib, sys, time
words = sys.argv[1:]
given = {a[2:]: b for a, b in zip(words, words[1:]) if a.startswith("--")}
out, seed = pathlib.Path(given["out"]), int(given["seed"])
resumed = "--resume" in words
asked = json.loads(os.environ["CONFIGS"])[out.name]
(out / "checkpoints").mkdir(parents=True, exist_ok=True)
with open(out.parent / "called", "a") as called:
    called.write(out.name + (" resumed" if resumed else "") + "\\n")
if hasattr(os, "sched_getaffinity"):
    with open(out.parent / "cores", "a") as cores:
        cores.write(json.dumps(sorted(os.sched_getaffinity(0))) + "\\n")
marked = {"format": "jaxrod training run 1", **asked}
(out / "config.json").write_text(json.dumps(marked))
(out / "progress.csv").write_text(
    "env_steps,wall_s,episode_return_mean,flagged_fraction\\n"
    + "".join(f"{k},{k / 10},{k if k > 9 else ''},0.0\\n" for k in range(1, 1001)))
if seed == 7:
    print("value_loss is not a number after 1,000 steps: learning diverged")
    sys.exit(1)
until = time.monotonic() + 60
while seed == 5 and len((out.parent / "called").read_text().splitlines()) < 2:
    if time.monotonic() > until:
        sys.exit("alone")
    time.sleep(0.02)
if seed == 3:
    sys.stdin.buffer.read()
    sys.exit(0)
if seed == 9 and not resumed:
    os.kill(os.getpid(), 9)
summary = {"final_score": None if seed == 11 else 100.0 * seed + 1,
           "env_steps": 1000, "wall_s": 2.5, "steps_per_s": 400.0,
           "flagged_fraction": 0.0, "score_window": 50, "episodes": 9,
           "evaluation_score": 1.0, "jax_version": "1", "device": "2 x cpu",
           "status": "finished"}
(out / "summary.json").write_text(json.dumps(summary))
"""


@pytest.fixture
def grid(run, monkeypatch, tmp_path):
    """Runs a grid of stand-ins; `called()` says which were started since."""
    monkeypatch.setattr(running, "LAUNCHER", (sys.executable, "-c", TRAIN))
    monkeypatch.setattr(running, "POLL_SECONDS", 0.02)
    out = tmp_path / "grid"

    def call(*seeds, words=(), algorithms=("ppo", "sac"), case="trivial"):
        chosen = plan([case], algorithms, seeds)
        if "--steps" in words:
            chosen = plan([case], algorithms, seeds, steps=int(words[-1]))
        configs = {cell.name: cell.config for cell in chosen}
        monkeypatch.setenv("CONFIGS", json.dumps(configs))
        more = ["--algorithms", *algorithms, "--seeds", *seeds, "--out", out]
        return run("reproduce", case, *more, *words)

    def called():
        file = out / "runs" / "called"
        lines = file.read_text().splitlines() if file.exists() else []
        file.unlink(missing_ok=True)
        return lines

    call.out, call.called = out, called
    return call


def rows(out):
    with (out / "results.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_a_grid_leaves_a_row_per_cell_and_is_not_run_twice(grid):
    code, _, err = grid(1, 0)
    assert code == 0, err
    assert (grid.out / "results.csv").read_text().splitlines()[0] == ",".join(COLUMNS)
    assert [(r["algorithm"], r["seed"], r["final_score"]) for r in rows(grid.out)] == [
        ("PPO", "0", "1.0"),
        ("PPO", "1", "101.0"),
        ("SAC", "0", "1.0"),
        ("SAC", "1", "101.0"),
    ]
    assert "4 done" in err
    assert len(grid.called()) == 4
    assert not list(grid.out.glob("runs/*/checkpoints"))
    before = (grid.out / "results.csv").read_bytes()
    shutil.rmtree(grid.out / "runs")  # as in a fresh clone
    assert grid(0, 1)[0] == 0
    assert grid.called() == []
    assert (grid.out / "results.csv").read_bytes() == before


def test_results_stand_beside_the_papers(grid):
    assert grid(0, 1, algorithms=("trpo",), case="Case3")[0] == 0
    assert {(r["case"], r["variant"]) for r in rows(grid.out)} == {("Case3", "paper")}
    line = next(
        line
        for line in (grid.out / "results.md").read_text().splitlines()
        if line.startswith("| Case3 TRPO")
    )
    # The mean, every seed, the paper's, the difference; 2.15 h over 2.5 s.
    for text in ("| 51 |", "0: 1, 1: 101", "4,124 ± 564", "-4,073", "3,096"):
        assert text in line
    assert line.endswith("| 0: 1, 1: 1 |"), "what the policies do without noise"
    curve = (grid.out / "curves" / "Case3-TRPO-1.csv").read_text().splitlines()
    assert curve[0] == "env_steps,wall_s,episode_return_mean"
    assert len(curve) == 201
    assert curve[-1] == "1000,100.0,1000"
    assert (grid.out / "Case3.png").read_bytes().startswith(b"\x89PNG")


def test_rows_without_a_record_are_kept(grid):
    grid.out.mkdir()
    row = "Case1,PPO,paper,3,10,7.5,1.0,0.0"
    (grid.out / "results.csv").write_text(f"{','.join(COLUMNS)}\n{row}\n")
    assert grid(0)[0] == 0
    lines = (grid.out / "results.csv").read_text().splitlines()
    assert lines[1] == row
    assert len(lines) == 4


def test_a_cell_that_diverged_is_recorded_and_the_grid_goes_on(grid):
    code, _, err = grid(7, 0)
    assert code == 1
    assert "learning diverged" in err
    scores = {(r["algorithm"], r["seed"]): r["final_score"] for r in rows(grid.out)}
    assert scores["PPO", "7"] == scores["SAC", "7"] == "nan"
    assert scores["PPO", "0"] == scores["SAC", "0"] == "1.0"
    assert "seed 7: value_loss is not" in (grid.out / "results.md").read_text()
    grid.called()
    # It would diverge again.
    assert grid(7, 0)[0] == 1
    assert grid.called() == []


def test_a_cell_without_a_complete_episode_has_no_score_and_did_not_fail(grid):
    code, out, _ = grid(11, 0, algorithms=("ppo",))
    assert code == 0
    assert [row["final_score"] for row in rows(grid.out)] == ["1.0", "nan"]
    assert "0: 1, 11: no episode" in out
    assert "failed" not in out.lower()


def test_a_cell_that_was_killed_is_not_recorded_and_goes_on_later(grid):
    code, _, err = grid(9, 0, algorithms=("ppo",))
    assert code == 1
    assert "killed by signal 9" in err
    assert [r["seed"] for r in rows(grid.out)] == ["0"]
    grid.called()
    assert grid(9, 0, algorithms=("ppo",))[0] == 0
    assert grid.called() == ["trivial-PPO-9 resumed"]
    assert [r["final_score"] for r in rows(grid.out)] == ["1.0", "901.0"]


def test_cells_run_side_by_side_each_on_its_share_of_the_cores(grid):
    code, _, err = grid(5, algorithms=("ppo", "trpo"), words=("--jobs", 2))
    assert code == 0, err
    assert [r["final_score"] for r in rows(grid.out)] == ["501.0", "501.0"]
    if hasattr(os, "sched_getaffinity"):
        text = (grid.out / "runs" / "cores").read_text()
        mine, others = map(json.loads, text.splitlines())
        there = len(os.sched_getaffinity(0))
        if there > 1:
            assert len(mine) == len(others) == there // 2
            assert not set(mine) & set(others)


def test_ctrl_c_stops_all_cells_that_run_and_starts_no_other(grid):
    def interrupt():
        until = time.monotonic() + 60
        called = grid.out / "runs" / "called"
        while time.monotonic() < until:
            if called.exists() and called.read_text().count("\n") == 2:
                break
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    algorithms = ("ppo", "trpo", "sac")
    code, _, err = grid(3, algorithms=algorithms, words=("--jobs", 2))
    assert code == 130
    assert "2 stopped, 1 waiting" in err
    assert len(grid.called()) == 2
    assert not (grid.out / "results.csv").exists()


def test_two_grids_do_not_run_in_one_folder(grid):
    with only_process(grid.out / "runs"):
        code, out, err = grid(0)
    assert (code, out) == (2, "")
    assert f"{grid.out / 'runs'} is in use by process {os.getpid()}" in err
    assert grid.called() == []


def test_a_run_that_a_killed_grid_left_behind_is_waited_for(grid, monkeypatch):
    sleep, left_behind = time.sleep, ExitStack()
    folder = grid.out / "runs" / "trivial-PPO-0"
    left_behind.enter_context(only_process(folder))

    def until_it_has_saved(seconds):
        left_behind.close()
        sleep(seconds)

    monkeypatch.setattr(time, "sleep", until_it_has_saved)
    code, _, err = grid(0, algorithms=("ppo",))
    assert code == 0, err
    assert err.startswith(f"waiting for the process that trains in {folder}\n")
    assert grid.called() == ["trivial-PPO-0"]


def test_a_run_that_does_not_stop_is_not_waited_for_forever(grid, monkeypatch):
    monkeypatch.setattr(running, "WAIT_SECONDS", 0.0)
    with only_process(grid.out / "runs" / "trivial-PPO-0"):
        code, _, err = grid(0, algorithms=("ppo",))
    assert code == 2
    assert "trivial-PPO-0 is in use by process" in err
    assert grid.called() == []


def test_runs_are_of_this_checkout_wherever_the_grid_is_started(tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    # Its standard input stays open: it would stop with it.
    with subprocess.Popen(
        [*running.LAUNCHER, "--version"],
        cwd=tmp_path,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdout.read() == f"jaxrod {__version__}\n"


def test_a_record_without_a_setting_that_came_later_is_still_good(grid):
    assert grid(0, algorithms=("ppo",))[0] == 0
    grid.called()
    file = grid.out / "cells" / "trivial-PPO-0.json"
    record = json.loads(file.read_text())
    del record["config"]["settings"]["action_repeat"]
    file.write_text(json.dumps(record))
    assert grid(0, algorithms=("ppo",))[0] == 0
    assert grid.called() == []


def test_what_was_run_otherwise_is_replaced_only_when_asked(grid):
    assert grid(0, algorithms=("ppo",))[0] == 0
    grid.called()
    words = ("--steps", 512)
    code, _, err = grid(0, algorithms=("ppo",), words=words)
    assert code == 2
    assert "steps was 39936, now 512" in err
    assert err.count("\n") == 1
    assert grid.called() == []
    code = grid(0, algorithms=("ppo",), words=("--overwrite", *words))[0]
    assert code == 0
    assert grid.called() == ["trivial-PPO-0"]
    record = json.loads((grid.out / "cells" / "trivial-PPO-0.json").read_text())
    assert record["config"]["steps"] == 512


def test_a_dry_run_tells_steps_settings_and_the_time_measured(grid, run, run_json):
    grid(0, algorithms=("ppo",))
    words = ("reproduce", "trivial", "--algorithms", "ppo", "--out", grid.out)
    table = run_json(*words, "--dry-run", "--json")
    assert [row["status"] for row in table] == ["finished", "waiting", "waiting"]
    assert table[1]["steps"] == 39_936
    assert table[1]["expected_s"] == pytest.approx(39_936 * 2.5 / 1000)
    assert "num_envs=8" in table[1]["changed"]
    code, out, _ = run(*words, "--dry-run")
    assert code == 0
    assert "2 of 3 cells to run" in out
    words = (*words, "--steps", 512, "--dry-run")
    code, out, _ = run(*words)
    assert "trivial-PPO-0  changed" in out
    assert "run with other settings or steps: 1 (see --overwrite)" in out
    assert "2 of 3 cells to run" in out
    assert "3 of 3 cells to run" in run(*words, "--overwrite")[1]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["Case5"], "case must be one of tracking"),
        (["trivial", "--algorithms", "luck"], "algorithm must be one of ppo"),
        (["trivial", "--seeds", "-1"], "seeds must be an integer from 0"),
        (["tracking", "--variant", "dirty"], "variant must be one of"),
        (["trivial", "--variant", "clean"], "'trivial' has no option 'variant'"),
        (["trivial", "--jobs", "0"], "jobs must be at least 1"),
        (["trivial", "--steps", "3"], "needs at least one update"),
        (["trivial", "--steps-fraction", "2"], "steps-fraction must be in (0, 1]"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(words, sentence, run, tmp_path):
    code, out, err = run("reproduce", *words, "--out", tmp_path / "grid")
    assert (code, out) == (2, "")
    assert sentence in err
    assert err.count("\n") == 1
    assert not (tmp_path / "grid").exists()


@pytest.mark.parametrize("words", [[], ["--dry-run"]])
def test_a_file_is_no_folder_for_a_grid(words, run, tmp_path):
    (tmp_path / "notes").write_text("mine")
    code, out, err = run("reproduce", "trivial", *words, "--out", tmp_path / "notes")
    assert (code, out) == (2, "")
    assert f"out must be a folder, but {tmp_path / 'notes'} is a file" in err


CLEAN = "Case3 Case4 --variant clean --algorithms sac td3 --seeds 0 1 2 3 4"


@pytest.mark.parametrize(
    ("words", "folder", "cells"), [("", "paper", 60), (CLEAN, "clean", 20)]
)
def test_the_benchmarks_that_are_kept_are_of_the_grid_as_it_is(
    words, folder, cells, run
):
    kept = Path(__file__).parents[2] / "benchmarks" / folder / "records"
    code, out, _ = run("reproduce", *words.split(), "--dry-run", "--out", kept)
    assert code == 0
    states = [line.split()[1] for line in out.splitlines() if line.startswith("Case")]
    assert states == ["finished"] * cells
