"""A true grid, killed in the middle: it ends as if nothing had happened."""

import csv
import os
import signal
import subprocess
import sys
import time

import pytest


def rows(out):
    with (out / "results.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_a_grid_that_is_killed_ends_as_if_nothing_had_happened(tmp_path):
    words = ["reproduce", "trivial", "--algorithms", "ppo", "sac", "--seeds", "0"]
    command = [sys.executable, "-m", "jaxrod", *words, "--jobs", "2", "--out"]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    subprocess.run([*command, whole], check=True, capture_output=True)
    with subprocess.Popen([*command, cut], stderr=subprocess.DEVNULL) as process:
        # In the middle of both cells.
        while len(list(cut.glob("runs/*/progress.csv"))) < 2:
            assert process.poll() is None
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
    subprocess.run([*command, cut], check=True, capture_output=True)
    scores = [
        [(r["algorithm"], r["seed"], r["env_steps"], r["final_score"]) for r in table]
        for table in (rows(whole), rows(cut))
    ]
    assert scores[0] == scores[1]
    assert len(scores[0]) == 2
