"""Runs killed at random moments, and two processes in one folder.

    python tests/extremes/kills.py --kills 100

A run is started, killed (SIGKILL) at a random moment, resumed, killed again, and so on
until it comes to its end; then another one, until there were as many kills as asked
for. A third of the kills wait for a file that is just being written. Every run has to
end as one that was left in peace: the same policy to the last bit, the same bytes in
episodes.csv, the same scores, the same progress but for the clock, and no file more.

Then pairs of processes are started in one folder, at about the same time: one trains,
the other is refused in a sentence, and the run is as if it had been alone.
"""

import argparse
import csv
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

RUN = ["trivial", "--steps", "2M", "--num-envs", "16", "--set", "rollout_steps=32"]
RUN += ["--set", "hidden_sizes=16", "--devices", "1"]
OFTEN = ["--checkpoint-seconds", "0.1"]


def command(folder, *words):
    """A process that trains."""
    words = ["train", *RUN, *OFTEN, *words, "--out", str(folder)]
    return subprocess.Popen(
        [sys.executable, "-m", "jaxrod", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def result(folder):
    """What may not depend on when a run was killed."""
    with np.load(folder / "policy" / "policy.npz") as stored:
        policy = {name: stored[name].tobytes() for name in stored.files}
    with (folder / "progress.csv").open() as stream:
        rows = [
            {k: v for k, v in row.items() if k not in ("wall_s", "steps_per_s")}
            for row in csv.DictReader(stream)
        ]
    summary = json.loads((folder / "summary.json").read_text())
    kept = ("status", "final_score", "evaluation_score", "env_steps", "episodes")
    names = sorted(str(file.relative_to(folder)) for file in folder.rglob("*"))
    # Which of the checkpoints before the last is kept depends on the clock.
    names = [name for name in names if not name.startswith("checkpoints/")]
    episodes = (folder / "episodes.csv").read_bytes()
    return policy, rows, episodes, [summary[name] for name in kept], names


def differences(found, sound):
    """Which parts of two results differ."""
    parts = ("policy", "progress", "episodes", "scores", "files")
    return [name for name, a, b in zip(parts, found, sound, strict=True) if not a == b]


def kill_once(process, folder, chance, longest):
    """Kills a process at a random moment, unless it ends before."""
    until = time.monotonic() + chance.uniform(0, longest)
    writes = chance.choice([math.inf, math.inf, chance.randrange(1, 20)])
    while time.monotonic() < until and process.poll() is None and writes > 0:
        writes -= any(folder.rglob("*.partial"))
        time.sleep(0.001)
    process.kill()


def to_the_end(folder, sound, chance, most, longest):
    """Runs with kills until the run ends; how many there were, and what is wrong."""
    kills = 0
    while True:
        started = (folder / "config.json").exists()
        process = command(folder, *(["--resume"] if started else []))
        if kills < most:
            kill_once(process, folder, chance, longest)
        _, said = process.communicate()
        if process.returncode == -signal.SIGKILL:
            kills += 1
        elif process.returncode == 0:
            return kills, ", ".join(differences(result(folder), sound))
        else:
            return kills, f"code {process.returncode}: {said[-500:]}"


def pair(folder, words, chance):
    """Two processes at about the same time; what is wrong with how they ended."""
    first = command(folder)
    time.sleep(chance.uniform(0, 3))
    second = command(folder, *words)
    said = [process.communicate()[1] for process in (first, second)]
    codes = [first.returncode, second.returncode]
    if codes == [0, 0] and "--overwrite" in words:
        print("one after the other:", end=" ")
        return None
    if sorted(codes) != [0, 2]:
        return f"codes {codes}: {said}"
    loser = said[codes.index(2)]
    sentences = [line for line in loser.splitlines() if line.startswith("jaxrod")]
    known = ("is in use by process", "holds a run already", "no run", "not exist")
    if len(sentences) != 1 or not any(word in sentences[0] for word in known):
        return f"said {loser!r}"
    return None


def main():
    """Prints what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=25)
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--most", type=int, default=6, help="kills of one run")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance, faults, kills, runs = random.Random(options.seed), 0, 0, 0
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", tempfile.mkdtemp())
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    with tempfile.TemporaryDirectory() as there:
        began = time.monotonic()
        whole = Path(there) / "whole"
        process = command(whole)
        said = process.communicate()[1]
        assert process.returncode == 0, said
        longest = time.monotonic() - began
        sound = result(whole)
        while kills < options.kills:
            folder = Path(there) / "killed"
            most = min(options.most, options.kills - kills)
            count, wrong = to_the_end(folder, sound, chance, most, longest)
            kills, runs = kills + count, runs + 1
            faults += bool(wrong)
            print(f"{kills} kills, {runs} runs: {wrong or 'as one left in peace'}")
            sys.stdout.flush()
            shutil.rmtree(folder)
        for k in range(options.pairs):
            words = [["--resume"], ["--overwrite"], []][k % 3]
            folder = Path(there) / "pair"
            wrong = pair(folder, words, chance)
            wrong = wrong or ", ".join(differences(result(folder), sound))
            faults += bool(wrong)
            print(f"pair with {words}: {wrong or 'one trained, one was refused'}")
            sys.stdout.flush()
            shutil.rmtree(folder)
    print(f"{kills} kills in {runs} runs, {options.pairs} pairs, {faults} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
